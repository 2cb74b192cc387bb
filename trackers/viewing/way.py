"""The way to the goal: an arc around the feature, and a point to go round by where it is blocked.

The camera goes along great circles of the sphere about the feature, so that it keeps its distance and never comes
near. Where it may be, on the preferred side, above the feature and the floor, is nearly convex on that sphere; what is
left to go round are the tool's cone, the zone, and what the joints cannot reach.
"""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.trackers.viewing.look import look
from surgbench.trackers.viewing.rules import worst
from surgbench.trackers.viewing.world import World

# Places of a way are looked at so far apart, radians, but no more of them than this.
LOOK_RAD, LOOKS = 0.12, 24
# No direction is nearer than another to the opposite of one.
OPPOSITE = -0.98
# What counts as within the rules on the way; the goal itself may lie on a border.
SLACK_RAD = 0.02
# From one such place to the next roll and wrist may turn so far: where they need more, they pass a place outside their
# limits, or one where they turn too fast to follow.
TURN_RAD = 1.0


@compiled
def arc(start: FloatArray, end: FloatArray, across: FloatArray) -> float:
    """The angle between unit vectors ``(3,)``, and the unit vector ``across`` (filled) in which ``start`` turns."""
    cosine = length = 0.0
    for k in range(3):
        cosine += start[k] * end[k]
    for k in range(3):
        across[k] = end[k] - cosine * start[k]
        length += across[k] ** 2
    length = math.sqrt(length)
    for k in range(3):
        across[k] = across[k] / length if length > 1e-12 else 0.0
    return math.atan2(length, cosine)


@compiled(makes_arrays=True, calls="viewpoint")
def clear(
    world: World,
    feature: FloatArray,
    tool: FloatArray,
    start: FloatArray,
    start_m: float,
    end: FloatArray,
    end_m: float,
    near: FloatArray,
    cone: bool,
    slack_m: float,
) -> bool:
    """Whether the arm can go along an arc around the feature within the rules.

    Args:
        world: Arm and rules.
        feature: ``(3,)``.
        tool: ``(2, 3)``.
        start: ``(3,)`` unit vector from the feature; the place itself is not looked at.
        start_m: Distance there.
        end: ``(3,)`` likewise, not looked at either.
        end_m: There.
        near: ``(6,)`` joints at the start.
        cone: Also not through the tool's cone.
        slack_m: So far beyond a rule the way may go.
    """
    across, u, p, joints, last = np.empty(3), np.empty(3), np.empty(3), np.empty(6), near.copy()
    angle = arc(start, end, across)
    if angle > math.acos(OPPOSITE):
        return False
    looks = min(int(angle / LOOK_RAD) + 1, LOOKS)
    for k in range(3):
        p[k] = feature[k] + end_m * end[k]
    at_end = worst(world, p, feature, tool, world.margin_m)[1]
    for k in range(3):
        p[k] = feature[k] + start_m * start[k]
    before = worst(world, p, feature, tool, world.margin_m)[1]
    leaving, entered = before < 0.0, False
    for n in range(1, looks):
        share = n / looks
        for k in range(3):
            u[k] = math.cos(share * angle) * start[k] + math.sin(share * angle) * across[k]
        if look(world, feature, u, start_m + share * (end_m - start_m), last, p, joints) < -SLACK_RAD:
            return False
        rules, aside = worst(world, p, feature, tool, world.margin_m)
        if rules < -slack_m:
            return False
        for joint in range(3, 6):
            if abs(joints[joint] - last[joint]) > TURN_RAD:
                return False
        last[:] = joints
        if not cone:
            continue
        # Out of the cone if it starts in there, into it if it ends there, but not through.
        if leaving and aside < before - slack_m and aside < at_end - slack_m:
            return False
        leaving = leaving and aside < 0.0
        if not leaving and aside < -slack_m:
            entered = True
        if entered and (aside > 0.0 or aside < at_end - abs(slack_m)):
            return False
        before = aside
    return not (entered and at_end >= 0.0)


@compiled(makes_arrays=True, calls="viewpoint")
def go_round(
    world: World,
    feature: FloatArray,
    tool: FloatArray,
    start: FloatArray,
    start_m: float,
    end: FloatArray,
    end_m: float,
    near: FloatArray,
    cone: bool,
    slack_m: float,
    by: FloatArray,
) -> bool:
    """The direction (``by``, ``(3,)``, filled) by which the way is shortest of those that are clear; false if none."""
    across, p, joints = np.empty(3), np.empty(3), np.empty(6)
    best = math.inf
    for n in range(len(world.starts)):
        middle = world.starts[n]
        length = arc(start, middle, across) + arc(middle, end, across)
        if length >= best:
            continue
        if look(world, feature, middle, world.distance_m, near, p, joints) < 0.0:
            continue
        rules, aside = worst(world, p, feature, tool, world.margin_m)
        if rules < 0.0 or (cone and aside < 0.0):
            continue
        if not clear(world, feature, tool, start, start_m, middle, world.distance_m, near, cone, slack_m):
            continue
        if clear(world, feature, tool, middle, world.distance_m, end, end_m, joints, cone, slack_m):
            best = length
            by[:] = middle
    return best < math.inf
