"""Wires: smooth splines in a box that a ring can be led along, and how a tool would hold the ring on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import solveh_banded

from surgbench.generators.wire_chaser.presets import WireSettings
from surgbench.geometry import FloatArray
from surgbench.viewpoint.motion import extents_m

# Between the points of a wire's polyline.
STEP_M = 0.0005
# Where a candidate is checked, between its ends.
CHECKED = 80
# Whither the first points climb: the mean azimuth of the camera arm, and the deviation from it.
HEADING_RAD = (-0.62, 0.3)
# The first and the last step of a control point in the search for a wire.
FIRST_STEP_M, LAST_STEP_M = 0.006, 0.0004
# A wire that is out of its bounds by this lacks as much as one that is bent twice too much.
UNIT_M = 0.01
# How much the tool rather turns with the wire than points away from its trocar, metres.
STIFFNESS_M = 0.02


@dataclass(frozen=True)
class WireShape:
    """A wire, by places along it.

    Attributes:
        along_m: ``(n,)`` lengths of wire from its start.
        points_m: ``(n, 3)`` there, in the world.
        tangent: ``(n, 3)`` of unit length.
        curvature: ``(n,)`` per metre.
    """

    along_m: FloatArray
    points_m: FloatArray
    tangent: FloatArray
    curvature: FloatArray

    @property
    def length_m(self) -> float:
        """From end to end."""
        return float(self.along_m[-1])

    def moved(self, transform: FloatArray) -> WireShape:
        """The same, carried along by a ``(4, 4)`` rigid transform."""
        rotation = transform[:3, :3]
        return WireShape(
            self.along_m, self.points_m @ rotation.T + transform[:3, 3], self.tangent @ rotation.T, self.curvature
        )


def search_wire(
    settings: WireSettings, lack: Callable[[WireShape], float], tries: int, rng: np.random.Generator
) -> tuple[WireShape | None, int]:
    """Look for a wire in its box, whose base is centred on the origin and whose height goes along z.

    Control points are drawn anywhere, and then moved by ever other small steps, of which those are kept that bring the
    wire nearer to what it should be.

    Args:
        settings: What it should be.
        lack: What else it lacks, in any unit: 0 for a good one. Asked of wires that need nothing else or little.
        tries: How many may be looked at.
        rng: The only source of randomness.

    Returns:
        The wire, or ``None``, and how many were looked at.
    """
    count = int(rng.integers(settings.control_points[0], settings.control_points[1] + 1))
    points = _first_points(count, settings, rng)
    step, best = FIRST_STEP_M, np.inf
    for tried in range(tries):
        moved = points if tried == 0 else points + step * rng.standard_normal(points.shape)
        wire = _glimpse(moved)
        score = shortcoming(wire, settings)
        if score < best:
            score += lack(wire)
        if score < best:
            points, best = moved, score
            step = min(1.6 * step, FIRST_STEP_M)
        else:
            # Steps grow as much where one in six succeeds as they shrink where five fail.
            step = max(step * 1.6**-0.2, LAST_STEP_M)
        if best == 0.0:
            return _sample(points, int(np.ceil(wire.length_m / STEP_M)) + 1), tried + 1
    return None, tries


def _first_points(count: int, settings: WireSettings, rng: np.random.Generator) -> FloatArray:
    """``(count, 3)`` control points that climb towards the camera arm, and then go anywhere."""
    low, high = room(settings)
    azimuth = rng.normal(*HEADING_RAD)
    level = np.array([np.cos(azimuth), np.sin(azimuth)])
    half = (high - low)[:2] / 2
    reach = 0.8 * (half / np.maximum(np.abs(level), 1e-9)).min() * level
    middle = (high + low)[:2] / 2
    top = rng.uniform(*settings.climb)
    places = [np.append(middle - reach, low[2]), np.append(middle + reach, high[2]), rng.uniform(low, high)]
    way = np.linspace(0.0, 1.0, count)
    points = np.stack([np.interp(way, [0.0, top, 1.001], coordinate) for coordinate in np.array(places).T], axis=1)
    return np.asarray(np.clip(points + settings.wander_m * rng.standard_normal(points.shape), low, high))


def room(settings: WireSettings) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest coordinates, ``(3,)`` each, of the wire's centre line in its box."""
    box = np.array(settings.box_m)
    low = np.append(-box[:2] / 2 + settings.margin_m, settings.base_m)
    return low, np.append(box[:2] / 2 - settings.margin_m, box[2] - settings.margin_m)


def shortcoming(wire: WireShape, settings: WireSettings) -> float:
    """By how much a wire is not what it should be, 0 for a good one: a sum of shares and centimetres."""
    low, high = room(settings)
    outside = np.maximum(low - wire.points_m.min(axis=0), wire.points_m.max(axis=0) - high).clip(0.0).sum() / UNIT_M
    bent = max(wire.curvature.max() * settings.bend_radius_m - 1.0, 0.0)
    spans = zip(extents_m(wire.points_m), settings.extent_m, strict=True)
    extent = sum(_outside(float(value), bounds) for value, bounds in spans) / UNIT_M
    length = _outside(wire.length_m, settings.length_m) / UNIT_M
    inner = wire.points_m @ wire.points_m.T
    square = np.diag(inner)[:, None] + np.diag(inner) - 2.0 * inner
    # Not within half a turn of the tightest bend.
    apart = np.abs(wire.along_m[:, None] - wire.along_m) > np.pi * max(settings.bend_radius_m, settings.apart_m / 2)
    nearest = np.sqrt(max(square.min(where=apart, initial=np.inf), 0.0))
    return float(outside + bent + extent + length + max(1.0 - nearest / settings.apart_m, 0.0))


def _outside(value: float, bounds: tuple[float, float]) -> float:
    return max(bounds[0] - value, value - bounds[1], 0.0)


def tool_axes(wire: WireShape, trocar_m: FloatArray) -> FloatArray:
    """Where the tool that holds the ring points, at every place of a wire.

    The ring's plane holds the tool. In it, the tool would point away from its trocar, as far as it does not have to
    turn quickly: where the wire itself points to the trocar, all directions are as good. The angle from a frame that
    does not turn about the wire solves a least-squares problem with both wishes.

    Args:
        wire: In the world.
        trocar_m: ``(3,)`` in the world.

    Returns:
        ``(n, 3)`` unit vectors square to the tangents.
    """
    tangent = wire.tangent
    axis = np.empty_like(tangent)
    away = wire.points_m - trocar_m
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    wanted = away - (away * tangent).sum(axis=1, keepdims=True) * tangent
    start = int(np.argmax((wanted**2).sum(axis=1)))
    axis[start] = wanted[start] / np.linalg.norm(wanted[start])
    for step in (1, -1):
        for place in range(start + step, len(tangent) if step > 0 else -1, step):
            moved = axis[place - step] - (axis[place - step] @ tangent[place]) * tangent[place]
            axis[place] = moved / np.linalg.norm(moved)
    other = np.cross(tangent, axis)
    angle = np.unwrap(np.arctan2((wanted * other).sum(axis=1), (wanted * axis).sum(axis=1)))
    angle -= angle[start]
    weight = (wanted**2).sum(axis=1)
    coupling = (STIFFNESS_M / np.diff(wire.along_m).mean()) ** 2
    bands = np.full((2, len(angle)), -coupling)
    bands[1] = weight + 2 * coupling
    bands[1, [0, -1]] -= coupling
    smooth = solveh_banded(bands, weight * angle)[:, None]
    return np.asarray(np.cos(smooth) * axis + np.sin(smooth) * other)


@cache
def _basis(count: int) -> FloatArray:
    """``(3, CHECKED, count)``: what makes places on a spline, and their first two derivatives, of control points."""
    spline = CubicSpline(np.linspace(0.0, 1.0, count), np.eye(count))
    way = np.linspace(0.0, 1.0, CHECKED)
    return np.stack([spline(way), spline(way, 1), spline(way, 2)])


def _glimpse(points: FloatArray) -> WireShape:
    """A wire through control points ``(n, 3)``, at few places, which are not evenly spaced."""
    place, velocity, acceleration = _basis(len(points)) @ points
    return _shape(place, velocity, acceleration)


def _sample(points: FloatArray, count: int) -> WireShape:
    """A wire through control points ``(n, 3)``, at ``count`` places evenly along it."""
    spline = CubicSpline(np.linspace(0.0, 1.0, len(points)), points)
    fine = np.linspace(0.0, 1.0, 2 * count)
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(spline(fine), axis=0), axis=1)))
    way = np.interp(np.linspace(0.0, length[-1], count), length, fine)
    shape = _shape(spline(way), spline(way, 1), spline(way, 2))
    return WireShape(np.linspace(0.0, length[-1], count), shape.points_m, shape.tangent, shape.curvature)


def _shape(place: FloatArray, velocity: FloatArray, acceleration: FloatArray) -> WireShape:
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1)))
    speed = np.maximum(np.linalg.norm(velocity, axis=1), 1e-9)
    curvature = np.linalg.norm(np.cross(velocity, acceleration), axis=1) / speed**3
    return WireShape(along, place, velocity / speed[:, None], curvature)
