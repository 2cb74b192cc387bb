"""Painted markers: twelve colours on shaft, wrist and jaws, one of a kind each; those of the jaws are asymmetric.

How many there are, and how they lie on the jaws, is as for published painted instruments (7.5 and 6.5 or 9 mm from the
yaw axis); the places on shaft and wrist and the colours are ours. An instrument whose file lists markers has those.
"""

from __future__ import annotations

import colorsys

import numpy as np
from numpy.typing import NDArray

from surgbench.generators.looks.surface import Surface
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.instrument.plausibility import least_distance, on_body
from surgbench.instrument.spec import LinkPoint, Marker

# Triangles near a marker are divided until their edges are shorter.
FINEST_M = 1.2e-4


def _colour(number: int) -> tuple[float, float, float]:
    """Twelve that are told apart: hues all around, every other one darker."""
    red, green, blue = colorsys.hsv_to_rgb(number / 12.0, 1.0, 0.35 if number % 2 else 0.85)
    return (max(red, 0.01), max(green, 0.01), max(blue, 0.01))


_PLACES: tuple[tuple[str, str, tuple[float, float, float], float], ...] = (
    ("shaft_1", "shaft", (0.00415, 0.0, -0.0075), 0.0014),
    ("shaft_2", "shaft", (-0.00415, 0.0, -0.0075), 0.0014),
    ("shaft_3", "shaft", (0.0, 0.00415, -0.0125), 0.0014),
    ("shaft_4", "shaft", (0.0, -0.00415, -0.0125), 0.0014),
    ("wrist_1", "wrist", (0.0030, 0.00315, 0.0), 0.0011),
    ("wrist_2", "wrist", (0.0030, -0.00315, 0.0), 0.0011),
    ("wrist_3", "wrist", (0.0045, 0.0, 0.0030), 0.0011),
    ("wrist_4", "wrist", (0.0045, 0.0, -0.0030), 0.0011),
    ("yaw_1", "jaw_left", (0.0, 0.0, 0.00195), 0.0011),
    ("yaw_2", "jaw_right", (0.0, 0.0, -0.00195), 0.0011),
    ("jaw_left", "jaw_left", (-0.0003, 0.0090, -0.0006), 0.0010),
    ("jaw_right", "jaw_right", (0.0003, 0.0065, 0.0006), 0.0010),
)
MARKERS = tuple(
    Marker(
        name=name,
        point=LinkPoint(link=link, point_m=place),
        radius_m=radius,
        colour=_colour((5 * number) % 12),
    )
    for number, (name, link, place, radius) in enumerate(_PLACES)
)


def with_markers(instrument: Instrument, paint: tuple[Marker, ...] = MARKERS) -> Instrument:
    """The instrument as it is once it is painted: with the markers that its file lists, or else with these.

    Args:
        instrument: Painted or not.
        paint: For one whose file lists none; those on which it has a surface.
    """
    if instrument.spec.markers:
        return instrument
    own = tuple(marker for marker in paint if on_body(marker, instrument.meshes))
    return Instrument(instrument.spec.model_copy(update={"markers": own}), instrument.meshes)


def without_markers(instrument: Instrument) -> Instrument:
    """The instrument as it is before it is painted."""
    if not instrument.spec.markers:
        return instrument
    return Instrument(instrument.spec.model_copy(update={"markers": ()}), instrument.meshes)


def painted(surface: Surface, markers: tuple[Marker, ...]) -> tuple[Surface, dict[str, Surface]]:
    """A link's surface in parts, divided finely about its markers, which leaves its shape as it is.

    Args:
        surface: Of one link.
        markers: That are on it.

    Returns:
        What is not painted; and each marker's name with what is, where that is anything.
    """
    if not markers:
        return surface, {}
    corners = _divided(surface, markers)
    middles = corners[0].mean(axis=1)
    bare = np.ones(len(middles), dtype=bool)
    spots = {}
    for marker in markers:
        own = bare & (np.linalg.norm(middles - marker.point.point_m, axis=1) < marker.radius_m)
        bare &= ~own
        if own.any():
            spots[marker.name] = _surface([part[own] for part in corners])
    return _surface([part[bare] for part in corners]), spots


def _surface(corners: list[FloatArray]) -> Surface:
    vertices, normals, places = (part.reshape(-1, part.shape[2]) for part in corners)
    return Surface(vertices, normals, places)


def _divided(surface: Surface, markers: tuple[Marker, ...]) -> list[FloatArray]:
    """``(F, 3, ...)`` vertices, normals and places; triangles within reach of a marker are cut until they are small."""
    corners = [part.reshape(-1, 3, part.shape[1]) for part in (surface.vertices_m, surface.normals, surface.places)]
    while True:
        long = _to_be_cut(corners[0], markers)
        if not long.any():
            return corners
        # Along the longest edge.
        edges = np.linalg.norm(corners[0][long] - np.roll(corners[0][long], -1, axis=1), axis=2)
        longest = edges.argmax(axis=1)
        # The longest edge first: its ends are corners 0 and 1.
        order = (longest[:, None] + np.arange(3)) % 3
        cut = []
        for part in corners:
            turned = np.take_along_axis(part[long], order[..., None], axis=1)
            middle = (turned[:, 0] + turned[:, 1]) / 2
            halves = [
                np.stack([turned[:, 0], middle, turned[:, 2]], axis=1),
                np.stack([middle, turned[:, 1], turned[:, 2]], axis=1),
            ]
            cut.append(np.concatenate([part[~long], *halves]))
        corners = cut


def _to_be_cut(corners: FloatArray, markers: tuple[Marker, ...]) -> NDArray[np.bool_]:
    edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
    near = np.zeros(len(corners), dtype=bool)
    for marker in markers:
        near |= least_distance(np.array(marker.point.point_m), corners) < marker.radius_m
    return np.asarray(near & (edges > FINEST_M))
