"""Pictures of an instrument's body: four views, and each joint swept over its limits; orthographic, to scale."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.instrument.measures import summary
from surgbench.instrument.model import Instrument
from surgbench.instrument.spec import JOINT_NAMES
from surgbench.state import JOINTS, STATE_SIZE

Picture = NDArray[np.uint8]

# Rows: what is to the right, what is down, what is away from the eye; in the wrist-pitch frame.
_X, _Y, _Z = np.eye(3)
VIEWS: dict[str, FloatArray] = {
    "along x: yaw and jaws": np.stack([_Z, _Y, -_X]),
    "along y: pitch": np.stack([_Z, -_X, -_Y]),
    "askew": np.stack([_Z, _Y, -_X])
    @ cv2.Rodrigues(np.array([0.0, 0.0, 0.55]))[0]
    @ cv2.Rodrigues(np.array([0.0, 0.75, 0.0]))[0].T,
    "from the tips": np.stack([_Y, -_X, -_Z]),
}
_OPEN_AS = {"wrist_pitch": "along y: pitch", "wrist_yaw": "along x: yaw and jaws"}
# How much of the shaft is drawn, back from the pitch axis.
SHAFT_SHOWN_M = 0.018
_INK, _GREY = (33, 37, 41), (120, 126, 132)
_LINKS = np.array([[134, 142, 150], [173, 181, 189], [120, 144, 156], [206, 212, 218], [190, 203, 216]])
_LIGHT = np.array([-0.35, -0.55, -0.76])
_FINER = 2  # each pixel is drawn as this many by this many


def posed(instrument: Instrument, joints: FloatArray) -> tuple[FloatArray, NDArray[np.intp]]:
    """Its triangles in the wrist-pitch frame.

    Args:
        instrument: It.
        joints: ``(3,)``: wrist pitch, wrist yaw and half jaw angle, radians.

    Returns:
        ``(F, 3, 3)`` corners, metres, and ``(F,)`` the number of each triangle's link.
    """
    state = np.zeros(STATE_SIZE)
    state[JOINTS] = joints
    transforms = instrument.link_transforms(state)
    corners, links = [], []
    for name, mesh in instrument.meshes.items():
        index = instrument.link_index[name]
        vertices = mesh.vertices_m @ transforms[index, :3, :3].T + transforms[index, :3, 3]
        vertices[:, 2] = np.maximum(vertices[:, 2], -SHAFT_SHOWN_M)
        corners.append(vertices[mesh.faces])
        links.append(np.full(len(mesh.faces), index))
    return np.concatenate(corners), np.concatenate(links)


class Sheet:
    """A white picture that instruments are drawn on."""

    def __init__(self, width: int, height: int) -> None:
        self.pixels: Picture = np.full((height, width, 3), 255, dtype=np.uint8)

    def text(
        self, words: str, place: tuple[int, int], size: float = 0.5, bold: bool = False, faint: bool = False
    ) -> None:
        """Write, from the left end of the base line."""
        colour = _GREY if faint else _INK
        cv2.putText(self.pixels, words, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 2 if bold else 1, cv2.LINE_AA)

    def bar(self, place: tuple[int, int], per_m: float, length_m: float = 0.01) -> None:
        """A scale bar from its left end, with its length."""
        x, y = place
        end = x + round(per_m * length_m)
        cv2.line(self.pixels, (x, y), (end, y), _INK, 2)
        for tick in (x, end):
            cv2.line(self.pixels, (tick, y - 4), (tick, y + 4), _INK, 2)
        self.text(f"{1000 * length_m:g} mm", (end + 8, y + 5), 0.42)

    def draw(
        self,
        triangles: FloatArray,
        links: NDArray[np.intp],
        view: FloatArray,
        box: tuple[int, int, int, int],
        centre: tuple[float, float],
        per_m: float,
        opacity: float = 1.0,
    ) -> None:
        """Draw triangles into a box of the picture.

        Args:
            triangles: ``(F, 3, 3)`` metres.
            links: ``(F,)``; decides the colour.
            view: Rows: right, down, away.
            box: Left, top, width and height, pixels.
            centre: What is in the middle of the box, metres to the right and down.
            per_m: Pixels a metre.
            opacity: Of what is drawn, over what is there.
        """
        left, top, width, height = box
        seen, colours = _raster(triangles @ view.T, links, (width, height), centre, per_m)
        share = opacity * seen[..., None]
        there = self.pixels[top : top + height, left : left + width]
        there[:] = np.round(share * colours + (1 - share) * there).astype(np.uint8)


def _raster(
    corners: FloatArray, links: NDArray[np.intp], size: tuple[int, int], centre: tuple[float, float], per_m: float
) -> tuple[FloatArray, FloatArray]:
    """Coverage ``(H, W)`` of each pixel, and its colour ``(H, W, 3)``: a depth buffer, nearest wins."""
    width, height = (_FINER * side for side in size)
    points = (corners[..., :2] - centre) * per_m * _FINER + np.array([width, height]) / 2
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-30)[:, None]
    shades = 0.5 + 0.5 * np.clip(normals @ (_LIGHT / np.linalg.norm(_LIGHT)), 0, 1)
    depth = np.full((height, width), np.inf)
    owner = np.full((height, width), -1)
    for index in np.flatnonzero(normals[:, 2] < 0):
        (ax, ay), (bx, by), (cx, cy) = points[index]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        low = np.maximum(np.floor(points[index].min(axis=0)).astype(int), 0)
        high = np.minimum(np.ceil(points[index].max(axis=0)).astype(int) + 1, (width, height))
        if area == 0 or (low >= high).any():
            continue
        x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
        u = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
        v = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
        a, b, c = corners[index, :, 2]
        away = a + u * (b - a) + v * (c - a)
        here = (slice(low[1], high[1]), slice(low[0], high[0]))
        nearer = (u >= 0) & (v >= 0) & (u + v <= 1) & (away < depth[here])
        depth[here][nearer] = away[nearer]
        owner[here][nearer] = index
    seen = (owner >= 0).astype(np.float64)
    colours = np.full((height, width, 3), 255.0)
    hit = owner >= 0
    colours[hit] = (_LINKS[links % len(_LINKS)] * shades[:, None])[owner[hit]]
    # An edge where another link begins: jaws before jaws stay apart.
    parts = np.where(hit, links[owner], -1)
    edge = np.zeros_like(hit)
    edge[:, 1:] |= parts[:, 1:] != parts[:, :-1]
    edge[1:] |= parts[1:] != parts[:-1]
    colours[edge & hit] *= 0.45
    coarse = (height // _FINER, _FINER, width // _FINER, _FINER)
    covered = seen.reshape(coarse).sum(axis=(1, 3))
    mixed = (colours * seen[..., None]).reshape(*coarse, 3).sum(axis=(1, 3)) / np.maximum(covered, 1)[..., None]
    return covered / _FINER**2, mixed


def resting(instrument: Instrument) -> FloatArray:
    """Joints to draw it with, ``(3,)``: straight, its jaws a third open."""
    limits = instrument.generate_limits
    joints = np.clip(np.zeros(3), limits.lower_rad, limits.upper_rad)
    if "jaw" in instrument.observable:
        joints[2] = limits.lower_rad[2] + 0.35 * (limits.upper_rad[2] - limits.lower_rad[2])
    return joints


def span(instrument: Instrument, joints: FloatArray, view: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least and most of what is drawn, to the right and down, metres."""
    points = posed(instrument, joints)[0].reshape(-1, 3) @ view.T
    return points[:, :2].min(axis=0), points[:, :2].max(axis=0)


def draw_instrument(instrument: Instrument) -> Picture:
    """What ``surgbench instrument show`` writes: title, four views, and what each joint sweeps; RGB."""
    moves = any(name in instrument.observable for name in JOINT_NAMES)
    width, head, row, sweep_row = 1500, 76, 300, 400 if moves else 0
    sheet = Sheet(width, head + 2 * row + sweep_row)
    sheet.text(instrument.spec.title, (24, 36), 0.85, bold=True)
    sheet.text(f"{instrument.name}   {summary(instrument)}", (24, 62), 0.5, faint=True)
    _draw_views(sheet, instrument, (0, head, width, 2 * row))
    if moves:
        _draw_sweeps(sheet, instrument, (0, head + 2 * row, width, sweep_row))
    return sheet.pixels


def _draw_views(sheet: Sheet, instrument: Instrument, area: tuple[int, int, int, int]) -> None:
    left, top, width, height = area
    joints = resting(instrument)
    box_width, box_height = width // 2, height // 2
    spans = {name: span(instrument, joints, view) for name, view in VIEWS.items()}
    widest = np.max([high - low for low, high in spans.values()], axis=0)
    per_m = float(min((box_width - 70) / widest[0], (box_height - 80) / widest[1]))
    triangles, links = posed(instrument, joints)
    for number, (name, view) in enumerate(VIEWS.items()):
        box = (left + number % 2 * box_width, top + number // 2 * box_height, box_width, box_height)
        low, high = spans[name]
        sheet.draw(triangles, links, view, box, tuple((low + high) / 2), per_m)
        sheet.text(name, (box[0] + 24, box[1] + 22), 0.48)
    sheet.bar((left + 24, top + box_height - 14), per_m)


def _draw_sweeps(sheet: Sheet, instrument: Instrument, area: tuple[int, int, int, int]) -> None:
    """Each joint at both limits, faint, and in the middle."""
    left, top, width, height = area
    limits, box_width = instrument.generate_limits, width // len(JOINT_NAMES)
    shown = []
    for number, name in enumerate(JOINT_NAMES):
        low, high = limits.lower_rad[number], limits.upper_rad[number]
        joints = resting(instrument)
        poses = []
        for angle in (low, high, (low + high) / 2):
            joints[number] = angle
            poses.append(joints.copy())
        view = VIEWS[_OPEN_AS.get(name, _OPEN_AS["wrist_yaw"])]
        spans = [span(instrument, pose, view) for pose in poses]
        shown.append((poses, view, np.min([low for low, _ in spans], 0), np.max([high for _, high in spans], 0)))
    widest = np.max([high - low for _, _, low, high in shown], axis=0)
    per_m = float(min((box_width - 60) / widest[0], (height - 90) / widest[1]))
    for number, (name, (poses, view, low, high)) in enumerate(zip(JOINT_NAMES, shown, strict=True)):
        box = (left + number * box_width, top, box_width, height)
        words = name.replace("_", " ")
        if name not in instrument.observable:
            sheet.text(f"{words}: it has none", (box[0] + 24, top + 22), 0.48, faint=True)
            continue
        degrees = np.degrees([limits.lower_rad[number], limits.upper_rad[number]])
        each = " each" if name == "jaw" else ""
        sheet.text(f"{words}: {degrees[0]:.0f} to {degrees[1]:.0f} degrees{each}", (box[0] + 24, top + 22), 0.48)
        for pose, opacity in zip(poses, (0.4, 0.4, 1.0), strict=True):
            sheet.draw(*posed(instrument, pose), view, box, tuple((low + high) / 2), per_m, opacity)
    sheet.bar((left + 24, top + height - 14), per_m)


def draw_catalogue(instruments: Sequence[Instrument], columns: int = 3) -> Picture:
    """One sheet of several, each seen along x and along y, all to one scale; RGB."""
    cell, view_height = 500, 150
    height = 2 * view_height + 64
    rows = -(-len(instruments) // columns)
    sheet = Sheet(columns * cell, rows * height + 16)
    names = list(VIEWS)[:2]
    widest = max(float(np.ptp(np.stack(span(one, resting(one), VIEWS[names[0]])), axis=0)[0]) for one in instruments)
    per_m = (cell - 60) / widest
    for number, instrument in enumerate(instruments):
        left, top = number % columns * cell, number // columns * height + 8
        sheet.text(instrument.name, (left + 20, top + 24), 0.6, bold=True)
        sheet.text(summary(instrument), (left + 20, top + 44), 0.4, faint=True)
        joints = resting(instrument)
        triangles, links = posed(instrument, joints)
        for place, name in enumerate(names):
            box = (left, top + 52 + place * view_height, cell, view_height)
            low, high = span(instrument, joints, VIEWS[name])
            # All shafts begin at the same distance from the left.
            centre = (-SHAFT_SHOWN_M + (cell / 2 - 20) / per_m, float(low[1] + high[1]) / 2)
            sheet.draw(triangles, links, VIEWS[name], box, centre, per_m)
        sheet.bar((left + 20, top + height - 18), per_m)
    return sheet.pixels
