"""How far the camera's place is from breaking each rule; written once, for goals, ways, steps and braking."""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.trackers.viewing.world import World

# Rules of place, then of the direction in which the feature sees the camera; the last is a wish and no rule.
FLOOR, ZONE, SPHERE, SIDE, ABOVE, POLE, CONE = range(7)
RULES = 7
# A feature closer than this to the camera has no direction.
CLOSEST_M = 1e-6


@compiled
def best_face(world: World, p: FloatArray) -> int:
    """The face of the zone that a place is farthest outside of, or least inside of."""
    best, most = 0, -math.inf
    for face in range(len(world.faces)):
        out = world.faces[face, 3]
        for k in range(3):
            out -= world.faces[face, k] * p[k]
        if out > most:
            best, most = face, out
    return best


@compiled
def clearances(
    world: World, p: FloatArray, feature: FloatArray, tool: FloatArray, face: int, c: FloatArray, G: FloatArray
) -> None:
    """Metres to where each rule is broken, negative beyond, and how they change with the camera's place.

    With the ray ``r = p - f`` from feature to camera: floor ``n . p - o``; zone ``o - n . p`` of one face; sphere
    ``|r| - r_min``; side ``s . r - sin |r|``; above ``up . r - sin |r|``; pole ``cos |r| - up . r``; cone
    ``(sqrt((x/a)^2 + (y/b)^2) - |z|) / 2`` with r's components in the feature's frame, z along the tool, y along the
    normal, and the tangents a, b of its angles. The margins of angles are in them, those in metres are not.

    Args:
        world: The rules.
        p: ``(3,)`` the camera.
        feature: ``(3,)``.
        tool: ``(2, 3)`` unit vectors along the tool that holds the feature, and along its normal, as measured.
        face: Of the zone; the rule is kept outside of any.
        c: ``(7,)``, filled.
        G: ``(7, 3)``, filled.
    """
    length = along = level = high = across = 0.0
    floor, zone = -world.floor[3], world.faces[face, 3]
    for k in range(3):
        r = p[k] - feature[k]
        length += r * r
        along += tool[0, k] * r
        level += tool[1, k] * r
        high += world.up[k] * r
        across += world.side[k] * r
        floor += world.floor[k] * p[k]
        zone -= world.faces[face, k] * p[k]
    length = max(math.sqrt(length), CLOSEST_M)
    sided = world.sine[1] > -1.0
    sign = 1.0 if along > 0.0 else -1.0
    c[FLOOR], c[ZONE], c[SPHERE] = floor, zone, length - world.proximity_m
    c[SIDE] = across - world.sine[0] * length if sided else 1.0
    c[ABOVE] = high - world.sine[1] * length if sided else 1.0
    c[POLE] = world.sine[3] * length - high
    coned = world.cone[0] > 0.0 and world.cone[1] > 0.0
    flat = 1.0
    if coned:
        wide = max(length * length - along * along - level * level, 0.0) / world.cone[0] ** 2
        flat = max(math.sqrt(wide + (level / world.cone[1]) ** 2), CLOSEST_M)
    c[CONE] = (flat - abs(along)) / 2 if coned else 1.0
    for k in range(3):
        unit = (p[k] - feature[k]) / length
        G[FLOOR, k] = world.floor[k]
        G[ZONE, k] = -world.faces[face, k]
        G[SPHERE, k] = unit
        G[SIDE, k] = world.side[k] - world.sine[0] * unit if sided else 0.0
        G[ABOVE, k] = world.up[k] - world.sine[1] * unit if sided else 0.0
        G[POLE, k] = world.sine[3] * unit - world.up[k]
        G[CONE, k] = 0.0
        if coned:
            aside = (unit * length - level * tool[1, k] - along * tool[0, k]) / world.cone[0] ** 2
            G[CONE, k] = ((aside + level * tool[1, k] / world.cone[1] ** 2) / flat - sign * tool[0, k]) / 2


@compiled(makes_arrays=True)
def worst(world: World, p: FloatArray, feature: FloatArray, tool: FloatArray, margin_m: float) -> tuple[float, float]:
    """The least clearance of all rules, metres, floor, zone and sphere less a margin; and that of the cone."""
    c, G = np.empty(RULES), np.empty((RULES, 3))
    clearances(world, p, feature, tool, best_face(world, p), c, G)
    return min(c[FLOOR] - margin_m, c[ZONE] - margin_m, c[SPHERE] - margin_m, c[SIDE], c[ABOVE], c[POLE]), c[CONE]
