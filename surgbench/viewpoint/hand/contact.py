"""Ring and wire: how near they are, where the wire lets the ring be, and when they count as touching.

The ring is a torus: a circle of ``ring_radius_m`` about its normal with a tube of ``tube_radius_m``. The wire is a
polyline with ``radius_m``. They touch where circle and polyline are nearer than the sum of the two radii. Against a
straight wire that passes through the ring's centre at an offset d square to it, the gap of an untilted ring is
``ring_radius_m - d`` less that sum; that of a centred ring tilted by theta is ``ring_radius_m cos(theta)`` less it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.viewpoint.trial import Wire

# The wire's piece that is looked at, either way from where the ring is: beyond, it is no more within the ring.
NEARBY_M = 0.012
# Points of each segment at which its distance to the circle is looked at; the segments are half a millimetre long.
PARTS = 4
# How often a ring is pushed out of the wire; each time by how deep it is.
PUSHES = 8


@compiled
def nearest_place(points: FloatArray, low: int, high: int, point: FloatArray, found: FloatArray) -> int:
    """The place of a polyline that is nearest to a point.

    Args:
        points: ``(n, 3)``.
        low: First segment that is looked at.
        high: One after the last.
        point: ``(3,)``.
        found: ``(7,)``, filled: the place, the direction of its segment (of unit length), how far along the segment it
            is, as a share.

    Returns:
        The segment.
    """
    best, nearest = low, math.inf
    for segment in range(low, high):
        along = toward = 0.0
        for k in range(3):
            step = points[segment + 1, k] - points[segment, k]
            along += step * step
            toward += step * (point[k] - points[segment, k])
        share = min(1.0, max(0.0, toward / along)) if along > 0.0 else 0.0
        distance = 0.0
        for k in range(3):
            place = points[segment, k] + share * (points[segment + 1, k] - points[segment, k])
            distance += (point[k] - place) ** 2
        if distance < nearest:
            best, nearest = segment, distance
            found[6] = share
    length = 0.0
    for k in range(3):
        step = points[best + 1, k] - points[best, k]
        found[k] = points[best, k] + found[6] * step
        found[3 + k] = step
        length += step * step
    length = math.sqrt(length)
    for k in range(3):
        found[3 + k] = found[3 + k] / length if length > 0.0 else 0.0
    return best


@compiled
def circle_distance(
    points: FloatArray,
    low: int,
    high: int,
    centre: FloatArray,
    normal: FloatArray,
    radius: float,
    away: FloatArray,
) -> float:
    """How near a circle comes to a polyline.

    The distance of a point from a circle is known in closed form; along a polyline it is looked at ``PARTS`` times a
    segment: for segments of half a millimetre, too much by about a micrometre where ring and wire are about to touch.

    Args:
        points: ``(n, 3)``.
        low: First segment that is looked at.
        high: One after the last.
        centre: ``(3,)`` of the circle.
        normal: ``(3,)`` of unit length.
        radius: Of the circle.
        away: ``(3,)``, filled: unit vector from the polyline to the circle, where they are nearest; along it the circle
            must move to come free. Zero where they meet.
    """
    nearest = math.inf
    for segment in range(low, high):
        for part in range(PARTS if segment + 1 < high else PARTS + 1):
            share = part / PARTS
            height = reach = 0.0
            for k in range(3):
                place = points[segment, k] + share * (points[segment + 1, k] - points[segment, k]) - centre[k]
                height += place * normal[k]
                reach += place * place
            level = math.sqrt(max(reach - height * height, 0.0))
            distance = math.hypot(level - radius, height)
            if distance < nearest:
                nearest = distance
                for k in range(3):
                    if level <= 0.0:  # on the circle's axis, from where every part of it is as near
                        away[k] = 0.0
                        continue
                    place = points[segment, k] + share * (points[segment + 1, k] - points[segment, k]) - centre[k]
                    # From the place to the circle's point that is nearest to it.
                    on_circle = radius * (place - height * normal[k]) / level
                    away[k] = (on_circle - place) / distance if distance > 0.0 else 0.0
    return nearest


@compiled
def allowed_offset(
    offset: FloatArray, tangent: FloatArray, normal: FloatArray, radius: float, thickness: float
) -> float:
    """How far a ring's centre may be from a straight wire, in the direction in which it is.

    Seen along the wire, the ring is an ellipse with half axes ``radius`` and ``radius |cos|`` of its tilt.

    Args:
        offset: ``(3,)`` from the wire to the centre, square to the wire.
        tangent: ``(3,)`` of the wire, unit length.
        normal: ``(3,)`` of the ring, unit length.
        radius: Of the circle in the middle of its tube.
        thickness: Radii of tube and wire.
    """
    cosine = length = into_tilt = tilt = 0.0
    for k in range(3):
        cosine += tangent[k] * normal[k]
        length += offset[k] * offset[k]
    for k in range(3):
        across = normal[k] - cosine * tangent[k]  # whither it is tilted
        into_tilt += across * offset[k]
        tilt += across * across
    cosine = min(abs(cosine), 1.0)
    if length <= 0.0 or tilt <= 0.0:
        return max(radius * (1.0 if tilt <= 0.0 else cosine) - thickness, 0.0)
    along = into_tilt * into_tilt / (length * tilt)
    return max(radius * cosine / math.sqrt(along + cosine * cosine * (1.0 - along)) - thickness, 0.0)


@compiled(makes_arrays=True)
def settle(
    points: FloatArray, low: int, high: int, normal: FloatArray, radius: float, thickness: float, centre: FloatArray
) -> float:
    """Put a ring where the wire lets it be.

    A hand that wants it elsewhere presses it against the wire, along which it slides without friction: it can't turn,
    and nothing gives.

    Args:
        points: ``(n, 3)`` of the wire's centre line.
        low: First segment that is near enough to matter.
        high: One after the last.
        normal: ``(3,)`` of the ring, unit length.
        radius: Of the circle in the middle of its tube.
        thickness: Radii of tube and wire.
        centre: ``(3,)`` where the hand wants it; overwritten with where it is.

    Returns:
        How far beyond the wire the hand wants it, metres; less than 0 where they do not touch: the gap between them.
    """
    place, offset, away = np.empty(7), np.empty(3), np.empty(3)
    nearest_place(points, low, high, centre, place)
    ahead = moved = length = 0.0
    for k in range(3):
        offset[k] = centre[k] - place[k]
        ahead += offset[k] * place[3 + k]
    for k in range(3):
        offset[k] -= ahead * place[3 + k]
        length += offset[k] * offset[k]
    length = math.sqrt(length)
    # The wire stays within the ring, however far the hand would have it: pushing alone might have it pass through.
    allowed = allowed_offset(offset, place[3:6], normal, radius, thickness)
    if length > allowed:
        moved = length - allowed
        for k in range(3):
            centre[k] -= moved * offset[k] / length
    gap = 0.0
    for _ in range(PUSHES):
        gap = circle_distance(points, low, high, centre, normal, radius, away) - thickness
        if gap >= 0.0:
            break
        moved -= gap
        for k in range(3):
            centre[k] -= gap * away[k]
    return moved if moved > 0.0 else -gap


@dataclass(frozen=True, eq=False)
class RingOnWire:
    """A wire and the ring on it, as the functions above take them.

    Attributes:
        points_m: ``(n, 3)``.
        along_m: ``(n,)`` length of wire from its start.
        radius_m: Of the circle in the middle of the ring's tube.
        thickness_m: Radii of tube and wire.
    """

    points_m: FloatArray
    along_m: FloatArray
    radius_m: float
    thickness_m: float

    @classmethod
    def of(cls, wire: Wire) -> RingOnWire:
        """Of a trial's wire."""
        points = np.ascontiguousarray(wire.points_m, dtype=np.float64)
        along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        return cls(points, along, wire.ring_radius_m, wire.tube_radius_m + wire.radius_m)

    @property
    def clearance_m(self) -> float:
        """How far the centre of a ring that is square to the wire may be from the wire's."""
        return self.radius_m - self.thickness_m

    def gap_m(self, T_world_ring: FloatArray) -> float:
        """Between the surfaces of ring and wire, wherever the ring is; negative where they overlap.

        Args:
            T_world_ring: ``(4, 4)``; y axis along the normal.
        """
        pose = np.asarray(T_world_ring, dtype=np.float64)
        centre, normal, away = pose[:3, 3].copy(), pose[:3, 1].copy(), np.empty(3)
        last = len(self.points_m) - 1
        return float(circle_distance(self.points_m, 0, last, centre, normal, self.radius_m, away)) - self.thickness_m

    def near(self, along_m: float) -> tuple[int, int]:
        """First and one after the last of the segments within :data:`NEARBY_M` of a place along the wire."""
        low, high = np.searchsorted(self.along_m, [along_m - NEARBY_M, along_m + NEARBY_M])
        last = len(self.points_m) - 1
        first = min(max(int(low) - 1, 0), last - 1)
        return first, max(min(int(high), last), first + 1)


def lasting_contacts(pressed_m: FloatArray, dt_s: float, release_m: float, shortest_s: float) -> NDArray[np.bool_]:
    """When ring and wire count as touching.

    Args:
        pressed_m: ``(T,)`` how far beyond the wire the hand would have the ring; below 0 where they do not touch.
        dt_s: Seconds between samples.
        release_m: A contact ends when they are this far apart.
        shortest_s: Shorter contacts, and shorter gaps between them, do not count.
    """
    known = np.where(pressed_m >= 0, 1, np.where(pressed_m < -release_m, 0, -1))
    known[0] = max(known[0], 0)
    latest = np.maximum.accumulate(np.where(known >= 0, np.arange(len(known)), 0))
    contact = known[latest] == 1
    shortest = round(shortest_s / dt_s)
    for value in (False, True):  # first short gaps, then short contacts
        edges = np.flatnonzero(np.diff(contact)) + 1
        for begin, end in pairwise(edges):
            if contact[begin] == value and end - begin < shortest:
                contact[begin:end] = not value
    return np.asarray(contact)
