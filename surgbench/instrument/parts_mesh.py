"""Parts of an instrument file as closed meshes that face outward."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import singledispatch

import numpy as np
from numpy.typing import ArrayLike

from surgbench.geometry import FloatArray
from surgbench.instrument.meshes import edge_defects, signed_volume
from surgbench.instrument.model import LinkMesh
from surgbench.instrument.parts import (
    Bar,
    Clevis,
    Hole,
    Jaw,
    Measures,
    Part,
    Pin,
    Pulley,
    Tube,
    Wrist,
    hole_half_width,
    mm,
)
from surgbench.instrument.shapes import join_meshes, loft_mesh, round_vertices, strip
from surgbench.instrument.spec import CrossSection, Loft

# A long tube has rings this far from its end, so that its triangles are not needles.
_RINGS_M = (0.15, 0.05)
# Pieces that meet reach so far into each other: no seam between them is ever seen through.
_OVERLAP_M = 5e-5


def parts_mesh(parts: Sequence[Part]) -> LinkMesh:
    """The body of a link from its parts, metres in its frame; their union.

    Raises:
        ValueError: A part's lengths make no closed body; the message says which part and where.
    """
    bodies = []
    for number, part in enumerate(parts, start=1):
        try:
            pieces = solids(part)
            for piece in pieces:
                _check(piece)
        except ValueError as error:
            raise ValueError(f"part {number} ({part.kind}) is no closed body: {error}") from None
        bodies += pieces
    return join_meshes(bodies)


def _check(piece: LinkMesh) -> None:
    defects = edge_defects(piece.faces)
    if not defects.closed:
        raise ValueError(str(defects))
    a, b, c = np.moveaxis(piece.vertices_m[piece.faces], 1, 0)
    if not np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 0 or not signed_volume(*_about_middle(piece)) > 0:
        raise ValueError("it has no thickness somewhere; its lengths are too small or cancel out")


def _about_middle(piece: LinkMesh) -> tuple[FloatArray, np.ndarray]:
    return piece.vertices_m - piece.vertices_m.mean(axis=0), piece.faces


@singledispatch
def solids(part: Part) -> list[LinkMesh]:
    """A part as closed meshes that face outward; they may interpenetrate."""
    raise TypeError(f"no part: {part!r}")


@solids.register
def _tube(part: Tube) -> list[LinkMesh]:
    straight = part.to_m - part.nose_m
    places = [part.from_m, *(straight - ring for ring in _RINGS_M if straight - ring > part.from_m + 0.01), straight]
    rings = [(place, part.radius_m) for place in places]
    if part.nose_m:
        end = part.radius_m if part.nose_radius_m is None else part.nose_radius_m
        # Three quarters of the way it is drawn in by less than half: rounded, not a cone.
        rings += [(part.to_m - part.nose_m / 4, end + 0.55 * (part.radius_m - end)), (part.to_m, end)]
    return [_turned(part.axis, rings, part.sides)]


@solids.register
def _pin(part: Pin) -> list[LinkMesh]:
    half = part.length_m / 2
    return [_turned(part.axis, [(-half, part.radius_m), (half, part.radius_m)], part.sides)]


@solids.register
def _pulley(part: Pulley) -> list[LinkMesh]:
    low, high, rim, face = part.from_m, part.to_m, part.radius_m, part.radius_m - part.chamfer_m
    rings = [(low, face), (low + part.chamfer_m, rim), (high - part.chamfer_m, rim), (high, face)]
    if part.side == "right":
        rings = [(-place, radius) for place, radius in reversed(rings)]
    return [_turned("z", rings, part.sides)]


def _turned(axis: str, rings: Sequence[tuple[float, float]], sides: int) -> LinkMesh:
    """A body of revolution about an axis from places along it and radii."""
    sections = tuple(CrossSection(at_m=place, radii_m=(radius, radius)) for place, radius in rings)
    return loft_mesh(Loft(axis=axis, sides=sides, sections=sections))  # type: ignore[arg-type]


@solids.register
def _clevis(part: Clevis) -> list[LinkMesh]:
    middle, half_length = (part.reach_m - part.root_m) / 2, (part.reach_m + part.root_m) / 2
    inner, outer = part.gap_m / 2, 0.995 * part.radius_m
    sections = []
    for share in (0.0, 0.6, 1.0):
        place = inner + share * (outer - inner)
        half_width = max(np.sqrt(part.radius_m**2 - place**2), 0.15 * part.radius_m)
        sections.append(
            CrossSection(at_m=place, radii_m=(half_length, half_width), centre_m=(middle, 0.0), exponent=2.6)
        )
    other = [section.model_copy(update={"at_m": -section.at_m}) for section in reversed(sections)]
    return [loft_mesh(Loft(axis="y", sides=part.sides, sections=tuple(lug))) for lug in (sections, other)]


@solids.register
def _wrist(part: Wrist) -> list[LinkMesh]:
    end, bottom = part.length_m + part.reach_m, part.length_m - part.slot_depth_m
    bulge = end - part.belly_m

    def half_depth(x: float) -> float:
        round_ = 1 - ((x - part.belly_m) / bulge) ** 2
        least = part.tongue_depth_m / 2 if x < part.belly_m else 0.04 * part.depth_m
        return max(float(part.depth_m / 2 * np.sqrt(max(round_, 0.0))), least)

    cheeks_from = part.length_m - 0.7 * part.slot_depth_m

    def half_width(x: float) -> float:
        wide = part.width_m / 2
        if x < 0:  # the tongue's end is round
            return max(float(part.tongue_width_m / 2 * np.sqrt(max(1 - (x / part.tongue_m) ** 2, 0.0))), 0.2 * wide)
        if x < part.belly_m:
            return float(wide - (wide - part.tongue_width_m / 2) * (1 - x / part.belly_m) ** 2)
        drawn_in = max(x - cheeks_from, 0.0) / (end - cheeks_from)
        return float(wide - (wide - part.end_width_m / 2) * drawn_in**2)

    tongue = [-part.tongue_m * share for share in (1.0, 0.9, 0.6)]
    body = [part.belly_m * share for share in (0.0, 0.12, 0.25, 0.5)]
    rest = [place for place in (part.belly_m, bottom) if place <= bottom]
    rings = [
        _rounded((x, 0.0, 0.0), (0, half_width(x), 0), (0, 0, half_depth(x)), part.corner_m)
        for x in sorted({*tongue, *(place for place in body if place < bottom), *rest, bottom})
    ]
    solid = [sweep(rings)]
    inner = part.slot_m / 2
    for side in (1, -1):
        cheek = []
        for share in (0.0, 0.4, 0.7, 0.9, 1.0):
            x = bottom - _OVERLAP_M + share * (end - bottom + _OVERLAP_M)
            outer = max(half_width(x), inner + 2e-4)
            middle, half = (outer + inner) / 2, (outer - inner) / 2
            cheek.append(_rounded((x, side * middle, 0.0), (0, half, 0), (0, 0, half_depth(x)), 0.0))
        solid.append(sweep(cheek))
    return solid


@solids.register
def _jaw(part: Jaw) -> list[LinkMesh]:
    pieces, start = [], part.from_m
    for hole in sorted(part.holes, key=lambda hole: hole.from_m):
        pieces.append(_jaw_piece(part, start, hole.from_m, None, 0))
        pieces += [_jaw_piece(part, hole.from_m - _OVERLAP_M, hole.to_m + _OVERLAP_M, hole, side) for side in (1, -1)]
        start = hole.to_m
    return [*pieces, _jaw_piece(part, start, part.length_m, None, 0)]


def _jaw_piece(part: Jaw, start: float, end: float, hole: Hole | None, rail: int) -> LinkMesh:
    """A jaw between two places: all of its width, or the rail on one side (1, -1) of a hole."""
    places = {start, end, *(place for place in part.places() if start < place < end)}
    if hole is not None:
        radius = hole.width_m / 2
        for share in (0.0, 0.1, 0.4, 1.0):
            places |= {hole.from_m + share * radius, hole.to_m - share * radius}
    outward, own = (-1.0, 1.0) if part.side == "left" else (1.0, -1.0)
    rings = []
    for place in _apart(sorted(places)):
        at: Measures = part.measures(place)
        middle, half = at.curve_m + own * at.stagger_m, at.width_m / 2
        if hole is not None:
            inner = hole_half_width(hole, place)
            middle, half = middle + rail * (half + inner) / 2, (half - inner) / 2
        x = outward * (at.gap_m + at.thickness_m / 2)
        rings.append(_rounded((x, place, middle), (0, 0, half), (at.thickness_m / 2, 0, 0), part.corner_m))
    return sweep(rings)


def _apart(places: Sequence[float]) -> list[float]:
    """Places without those that are nearer than a hundredth of a millimetre to the one before."""
    kept = [places[0]]
    for place in places[1:-1]:
        if place - kept[-1] > 1e-5 and places[-1] - place > 1e-5:
            kept.append(place)
    return [*kept, places[-1]]


@solids.register
def _bar(part: Bar) -> list[LinkMesh]:
    points = np.array([knot.point_m for knot in part.path])
    along = np.diff(points, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    across = np.eye(3)["xyz".index(part.across)]
    rings, width, thickness = [], 0.0, 0.0
    for index, (point, knot) in enumerate(zip(points, part.path, strict=True)):
        width = width if knot.width_m is None else knot.width_m
        thickness = thickness if knot.thickness_m is None else knot.thickness_m
        before = along[max(index - 1, 0)]
        after = along[min(index, len(along) - 1)]
        b = across - before * (across @ before)
        b /= np.linalg.norm(b)
        n = np.cross(before, b)
        ring = _rounded((0, 0, 0), width / 2 * b, thickness / 2 * n, part.corner_m)
        # The bend's plane halves its angle: the bar is as thick before it as behind.
        bend = before + after
        if bend @ before < 0.1:
            raise ValueError(f"its path turns back at corner {index + 1}")
        rings.append(point + ring - np.outer(ring @ bend / (before @ bend), before))
    return [sweep(rings)]


def _rounded(centre: ArrayLike, first: ArrayLike, second: ArrayLike, corner_m: float) -> FloatArray:
    """A rectangle, ``(4, 3)``, or one with its corners cut off, ``(8, 3)``: half sides as vectors from its centre."""
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    half_a, half_b = float(np.linalg.norm(a)), float(np.linalg.norm(b))
    if min(half_a, half_b) <= 0:
        raise ValueError("a side has no length")
    cut = min(corner_m, 0.6 * half_a, 0.6 * half_b)
    s, t = 1 - cut / half_a, 1 - cut / half_b
    signs: list[tuple[float, float]] = [(1, -1), (1, 1), (-1, 1), (-1, -1)]
    if cut > 0:
        signs = [(1, -t), (1, t), (s, 1), (-s, 1), (-1, t), (-1, -t), (-s, -1), (s, -1)]
    ring: FloatArray = np.asarray(centre, dtype=np.float64) + np.array([u * a + v * b for u, v in signs])
    return ring


def sweep(rings: Sequence[FloatArray]) -> LinkMesh:
    """A closed solid through convex rings of as many corners each, one behind the other.

    Args:
        rings: At least two, ``(k, 3)`` metres each.

    Returns:
        ``k`` vertices a ring and ``2 k (rings - 1) + 2 (k - 2)`` triangles, facing outward.

    Raises:
        ValueError: Neighbouring rings cut through each other, so that no body lies between them.
    """
    for before, after in itertools.pairwise(rings):
        step = after.mean(axis=0) - before.mean(axis=0)
        if not ((after - before) @ step).min() > 0:
            x, y, z = (mm(value) for value in before.mean(axis=0))
            raise ValueError(f"it folds over itself about ({x}, {y}, {z}); its lengths there are too near or too wide")
    sides, here = len(rings[0]), np.arange(len(rings[0]))
    there = (here + 1) % sides
    faces = []
    for index in range(len(rings) - 1):
        low, high = index * sides, (index + 1) * sides
        faces.append(np.stack([low + here, low + there, high + there], axis=1))
        faces.append(np.stack([low + here, high + there, high + here], axis=1))
    cap = np.array(strip(sides))
    faces += [cap[:, ::-1], cap + (len(rings) - 1) * sides]
    mesh = LinkMesh(round_vertices(np.concatenate(rings)), np.concatenate(faces).astype(np.int32))
    if signed_volume(*_about_middle(mesh)) < 0:
        mesh = LinkMesh(mesh.vertices_m, np.ascontiguousarray(mesh.faces[:, ::-1]))
    return mesh
