"""What is in the way: tissue, spots where a mask drops out, a third tool; and arms that are partly outside.

Each has a level, and depends on it and on the sequence alone: all else is drawn alike whatever the level, so that a
curve over levels shows what the level does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.dataset.masks import Mask
from surgbench.generators.absences import ease, inwards_of, way_out_m, way_past_m
from surgbench.generators.place import Place, clearance_m
from surgbench.generators.sections import Occluders
from surgbench.geometry import FloatArray, look_at_rotation, wrap_angle
from surgbench.instrument import Instrument
from surgbench.randomness import generator
from surgbench.state import ALPHA, ANGLES, BETA, GAMMA, JOINTS, POSITION, STATE_SIZE

# An arm's end: points from wrist to tips, and on the shaft.
END_SHARES = np.linspace(0.25, 1.0, 4)
END_SHAFT_M = np.linspace(0.0, 0.03, 6)
# Outlines of blobs: how much radii differ, by how many waves a turn, and corners of the polygon.
WAVES = np.array([2, 3, 4])
WAVINESS = np.array([0.18, 0.1, 0.06])
OUTLINE_CORNERS = 96
# Blobs grow no larger than this many pictures' widths, which hides everything.
LARGEST = 3.0
# Seconds over which the arms' mean place moves the tissue, and in which it sways.
TISSUE_FOLLOWS_S = 4.0
TISSUE_SWAYS_S = (5.0, 12.0)
# One spot an arm begins every so many frames; how long it lasts.
SPOT_EVERY_FRAMES = 12
SPOT_FRAMES = (15, 60)
# Frames of a third tool's visit, of its ways in and out, and how far its aim is from between the arms.
VISIT_FRAMES = (60, 140)
VISIT_TRAVEL = (18, 30)
VISIT_AIM = 0.12
VISIT_DISTANCE_M = (0.065, 0.085)
VISIT_TRIES = 12
# Frames for which arms are in their place, on each way, and drawn back.
OUTSIDE_IN_FRAMES = (15, 45)
OUTSIDE_TRAVEL = (20, 40)
OUTSIDE_FRAMES = (40, 100)


@dataclass(frozen=True)
class Blobs:
    """Blobs with wavy outlines.

    Attributes:
        centres: ``(frames, n, 2)`` pixels.
        radii: ``(frames, n)`` pixels; 0 where there is none.
        phases: ``(n, 3)`` of the waves.
    """

    centres: FloatArray
    radii: FloatArray
    phases: FloatArray

    def scaled(self, scale: float) -> Blobs:
        """The same, larger."""
        return Blobs(self.centres, self.radii * scale, self.phases)

    def covers(self, points: FloatArray) -> NDArray[np.bool_]:
        """Which of ``(frames, p, 2)`` points a blob covers, ``(frames, p)``."""
        way = points[:, None] - self.centres[:, :, None]
        angle = np.arctan2(way[..., 1], way[..., 0])
        radius = self.radii[..., None] * _waves(angle, self.phases[:, None])
        covered: NDArray[np.bool_] = (np.linalg.norm(way, axis=-1) < radius).any(axis=1)
        return covered

    def draw(self, frame: int, hidden: Mask) -> None:
        """Paint one frame's into a mask ``(height, width)``."""
        angle = np.linspace(0.0, 2.0 * np.pi, OUTLINE_CORNERS, endpoint=False)
        picture = hidden.view(np.uint8)
        for centre, radius, phases in zip(self.centres[frame], self.radii[frame], self.phases, strict=True):
            if radius > 0.5:
                ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
                outline = centre + (radius * _waves(angle, phases))[:, None] * ray
                cv2.fillPoly(picture, [np.rint(outline).astype(np.int32)], 1)


@dataclass(frozen=True)
class ThirdTool:
    """An instrument that nobody tracks.

    Attributes:
        states: ``(frames, 9)``; NaN where it is away.
        taken_for: ``(frames,)`` which arm's its mask is taken for: 0, 1, or -1 for none's.
    """

    states: FloatArray
    taken_for: NDArray[np.int64]


@dataclass(frozen=True)
class InTheWay:
    """All that hides a sequence's arms.

    Attributes:
        blobs: Tissue and spots.
        third: ``None`` where there is none.
    """

    blobs: tuple[Blobs, ...] = ()
    third: ThirdTool | None = None

    def hidden(self, frame: int, camera: Camera) -> Mask:
        """``(height, width)`` where blobs hide what is there."""
        hidden: Mask = np.zeros((camera.height, camera.width), dtype=bool)
        for blobs in self.blobs:
            blobs.draw(frame, hidden)
        return hidden

    def third_state(self, frame: int) -> FloatArray | None:
        """``(9,)`` of the third tool; ``None`` where it is away."""
        if self.third is None or np.isnan(self.third.states[frame, 0]):
            return None
        state: FloatArray = self.third.states[frame]
        return state

    def taken_for(self, frame: int) -> int:
        """Which arm's the third tool's mask is taken for: 0, 1, or -1 for none's."""
        return -1 if self.third is None else int(self.third.taken_for[frame])


def put_in_the_way(
    settings: Occluders, states: FloatArray, instrument: Instrument, camera: Camera, dt_s: float, **axes: str | int
) -> InTheWay:
    """Occluders of a sequence, but for arms that are outside, which :func:`drawn_outside` moves.

    Args:
        settings: Levels.
        states: ``(frames, 2, 9)``, where the arms are.
        instrument: Of both.
        camera: Without or with distortion.
        dt_s: Seconds between frames.
        axes: Name the sequence, for :func:`surgbench.randomness.generator`.
    """
    ends = _ends_px(states, instrument, camera)
    blobs = []
    if settings.tissue:
        blobs.append(
            _to_level(_tissue(ends, camera, dt_s, generator(**axes, purpose="tissue")), ends, settings.tissue, camera)
        )
    if settings.dropout:
        blobs.append(
            _to_level(_spots(ends, camera, generator(**axes, purpose="dropout")), ends, settings.dropout, camera)
        )
    third = None
    if settings.third_tool:
        third = _third_tool(settings.third_tool, states, instrument, camera, generator(**axes, purpose="third tool"))
    return InTheWay(tuple(blobs), third)


def drawn_outside(
    share: float, places: Sequence[Place], states: FloatArray, rng: np.random.Generator
) -> FloatArray | None:
    """How far each arm is drawn back in each frame, ``(frames, 2)`` metres along its shaft.

    Args:
        share: Of wrist and jaws, by their vertices, that is outside where it is drawn back.
        places: Of the arms.
        states: ``(frames, 2, 9)``.
        rng: The only source of randomness.

    Returns:
        ``None`` where the arms would come too near to each other.
    """
    back = np.zeros(states.shape[:2])
    for index, place in enumerate(places):
        spec = place.instrument.spec
        links = [link.name for link in spec.links[1:]]
        inwards = inwards_of(place.camera, place.arm)
        way = way_past_m(place.instrument, states[:, index], inwards, links, share).clip(min=0.0)
        back[:, index] = np.minimum(way, way_out_m(place, states[:, index])) * _outside_course(len(states), rng)
    moved = drawn_back_by(states, back)
    apart = clearance_m(places[0].instrument, moved[:, 0], moved[:, 1])
    return back if apart.min() >= places[0].workspace.clearance_m else None


def drawn_back_by(states: FloatArray, back_m: FloatArray) -> FloatArray:
    """States ``(..., 9)`` drawn back along their shafts by ``(...)`` metres."""
    moved = states.copy()
    moved[..., POSITION] -= back_m[..., None] * look_at_rotation(states[..., ANGLES])[..., 2]
    return moved


def _outside_course(frames: int, rng: np.random.Generator) -> FloatArray:
    """From 0, in its place, to 1, drawn back, ``(frames,)``."""
    course: list[float] = []
    while len(course) < frames:
        inside, there, out, again = (
            int(rng.integers(*bounds, endpoint=True))
            for bounds in (OUTSIDE_IN_FRAMES, OUTSIDE_TRAVEL, OUTSIDE_FRAMES, OUTSIDE_TRAVEL)
        )
        course += [*np.zeros(inside), *ease(there), *np.ones(out), *ease(again)[::-1]]
    return np.array(course[:frames])


def _ends_px(states: FloatArray, instrument: Instrument, camera: Camera) -> FloatArray:
    """Points of the arms' ends in the picture, ``(frames, 2, p, 2)``; NaN outside it."""
    wrist, tips = states[..., POSITION], instrument.tips_cam(states)
    axis = look_at_rotation(states[..., ANGLES])[..., 2]
    shaft = wrist[..., None, :] - END_SHAFT_M[:, None] * axis[..., None, :]
    jaws = wrist[..., None, None, :] + END_SHARES[:, None, None] * (tips - wrist[..., None, :])[..., None, :, :]
    points = camera.see(np.concatenate([shaft, jaws.reshape(*jaws.shape[:-3], -1, 3)], axis=-2))
    points[~camera.contains(points)] = np.nan
    return points


def _waves(angle: FloatArray, phases: FloatArray) -> FloatArray:
    """Radii at angles ``(...)`` for phases ``(..., 3)``, relative to their mean."""
    waves: FloatArray = 1.0 + (WAVINESS * np.cos(WAVES * angle[..., None] + phases)).sum(axis=-1)
    return waves


def _to_level(blobs: Blobs, ends: FloatArray, level: float, camera: Camera) -> Blobs:
    """Blobs so large that they cover a share of all that is seen of the arms' ends."""
    points = ends.reshape(len(ends), -1, 2)
    seen = np.isfinite(points[..., 0])
    low, high = 0.0, LARGEST * camera.width / max(float(blobs.radii.max()), 1.0)
    for _ in range(16):
        middle = 0.5 * (low + high)
        share = blobs.scaled(middle).covers(points)[seen].mean() if seen.any() else 1.0
        low, high = (middle, high) if share < level else (low, middle)
    return blobs.scaled(high)


def _tissue(ends: FloatArray, camera: Camera, dt_s: float, rng: np.random.Generator) -> Blobs:
    frames = len(ends)
    middle = _between(ends, camera, max(1, round(TISSUE_FOLLOWS_S / dt_s)))
    period = rng.uniform(*TISSUE_SWAYS_S, 2) / dt_s
    sway = np.sin(2.0 * np.pi * (np.arange(frames)[:, None] / period + rng.random(2)))
    centres = middle + camera.height * (rng.normal(0.0, 0.06, 2) + 0.05 * sway)
    breath = 1.0 + 0.1 * np.sin(
        2.0 * np.pi * (np.arange(frames) / (rng.uniform(*TISSUE_SWAYS_S) / dt_s) + rng.random())
    )
    return Blobs(centres[:, None], 0.1 * camera.height * breath[:, None], rng.uniform(0.0, 2.0 * np.pi, (1, 3)))


def _spots(ends: FloatArray, camera: Camera, rng: np.random.Generator) -> Blobs:
    frames, arms, points = ends.shape[:3]
    count = -(-(frames + SPOT_FRAMES[1]) // SPOT_EVERY_FRAMES) * arms
    first = np.sort(rng.integers(-SPOT_FRAMES[1], frames, count))
    lasts = rng.integers(*SPOT_FRAMES, count, endpoint=True)
    share = (np.arange(frames)[:, None] - first) / lasts
    size = camera.height * rng.uniform(0.03, 0.09, count)
    radii = size * np.where((share > 0) & (share < 1), np.sin(np.pi * share), 0.0)
    # Half of them stick to the arm, as blood does; the others stay where they are.
    where = ends[:, rng.integers(arms, size=count), rng.integers(points, size=count)]
    middle = np.clip(first + lasts // 2, 0, frames - 1)
    still = np.repeat(where[middle, np.arange(count)][None], frames, axis=0)
    centres = np.where((rng.random(count) < 0.5)[:, None], where, still)
    return Blobs(
        np.nan_to_num(centres),
        np.where(np.isnan(centres[..., 0]), 0.0, radii),
        rng.uniform(0.0, 2.0 * np.pi, (count, 3)),
    )


def _between(ends: FloatArray, camera: Camera, frames: int) -> FloatArray:
    """Where the arms' ends are in the mean of so many frames, ``(frames, 2)``; else the picture's centre."""
    seen = np.isfinite(ends[..., 0])
    total, count = np.nan_to_num(ends).sum(axis=(1, 2)), seen.sum(axis=(1, 2))
    window = np.ones(frames)
    many = np.convolve(count, window, mode="same")
    mean = np.stack([np.convolve(total[:, k], window, mode="same")[: len(ends)] for k in range(2)], axis=1)
    many = many[: len(ends), None]
    centre = 0.5 * np.array([camera.width, camera.height])
    return np.where(many > 0, mean / np.maximum(many, 1.0), centre)


def _third_tool(
    level: float, states: FloatArray, instrument: Instrument, camera: Camera, rng: np.random.Generator
) -> ThirdTool:
    """Visits of a third tool, which comes in over the lower edge."""
    frames = len(states)
    moves = np.full((frames, STATE_SIZE), np.nan)
    taken_for = np.full(frames, -1)
    aim = _between(_ends_px(states, instrument, camera), camera, VISIT_FRAMES[0])
    at = -int(rng.integers(VISIT_FRAMES[0]))
    while at < frames:
        length = int(rng.integers(*VISIT_FRAMES, endpoint=True))
        away, taken = rng.uniform(0.7, 1.3) * length * (1.0 / level - 1.0), rng.integers(-2, 2)
        # Drawn whole, also where it begins before the first frame or ends after the last.
        shown = np.arange(max(at, 0), min(at + length, frames))
        stays = np.clip(np.arange(at, at + length), 0, frames - 1)
        tries = [_visit(aim[stays], instrument, camera, rng) for _ in range(VISIT_TRIES)]
        if len(shown):
            gaps = [min(clearance_m(instrument, one, states[stays, arm]).min() for arm in range(2)) for one in tries]
            moves[shown] = tries[int(np.argmax(gaps))][shown - at]
            taken_for[shown] = max(int(taken), -1)
        at += length + round(away)
    return ThirdTool(moves, taken_for)


def _visit(aim: FloatArray, instrument: Instrument, camera: Camera, rng: np.random.Generator) -> FloatArray:
    """``(n, 9)`` of one visit: in, about a place between the arms, and out again."""
    count = len(aim)
    direction, elevation = rng.uniform(-2.2, -0.9), rng.uniform(0.4, 0.9)
    axis = np.array([np.cos(direction) * np.cos(elevation), np.sin(direction) * np.cos(elevation), np.sin(elevation)])
    share = np.arange(count) / count
    sway = np.sin(2.0 * np.pi * (rng.uniform(0.5, 1.5, 3) * share[:, None] + rng.random(3)))
    pixel = aim + camera.height * (rng.normal(0.0, VISIT_AIM, 2) + 0.03 * sway[:, :2])
    ray = np.column_stack([(pixel - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(count)])
    visit = np.empty((count, STATE_SIZE))
    visit[:, ALPHA], visit[:, GAMMA] = -np.arcsin(axis[1]), np.arctan2(axis[0], axis[2])
    visit[:, BETA] = wrap_angle(rng.uniform(-np.pi, np.pi) + 0.3 * sway[:, 2])
    limits = instrument.generate_limits
    visit[:, JOINTS] = limits.clip(rng.uniform(0.5 * limits.lower_rad, 0.5 * limits.upper_rad) + 0.1 * sway)
    visit[:, POSITION] = ray / np.linalg.norm(ray, axis=1, keepdims=True) * rng.uniform(*VISIT_DISTANCE_M)
    links = [link.name for link in instrument.spec.links]
    way = way_past_m(instrument, visit, inwards_of(camera, "bottom"), links, 1.0).clip(min=0.0).max()
    there, again = (int(rng.integers(*VISIT_TRAVEL, endpoint=True)) for _ in range(2))
    course = np.concatenate([1.0 - ease(there), np.zeros(count - there - again), ease(again)])
    visit[:, POSITION] -= (way * course)[:, None] * axis
    return visit
