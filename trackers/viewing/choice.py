"""Which goal: the naive pose where it can be had, else the best fit of several starts."""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.trackers.viewing.fit import fit
from surgbench.trackers.viewing.look import look, place
from surgbench.trackers.viewing.residuals import DIRECTION, HUBER
from surgbench.trackers.viewing.rules import CLOSEST_M, worst
from surgbench.trackers.viewing.way import clear
from surgbench.trackers.viewing.world import LOWER, UPPER, World

# Between neighbouring starts, radians; by less than this share of its cost no other goal is left for, and to one that
# the way leads to behind the tool, or through a rule, by less than that.
APART_RAD = 0.35
BETTER, MUCH_BETTER = 0.85, 0.4
WAY_SLACK_M = 1e-3
# A start is fitted so many times longer than the goal, which is nearly there.
LONGER = 3
# A start may be so far beyond a joint's limit, and a rule: there may be room beside it.
BEYOND_RAD, BEYOND_M = 0.4, 0.025
ROLL = 3


@compiled(makes_arrays=True, calls="viewpoint")
def ray(world: World, joints: FloatArray, feature: FloatArray, direction: FloatArray) -> float:
    """The camera's distance from the feature, and the unit vector to it (``(3,)``, filled)."""
    p = np.empty(3)
    place(world, joints, p)
    length = 0.0
    for k in range(3):
        direction[k] = p[k] - feature[k]
        length += direction[k] ** 2
    length = max(math.sqrt(length), CLOSEST_M)
    for k in range(3):
        direction[k] /= length
    return float(length)


@compiled(makes_arrays=True, calls="viewpoint")
def seek(
    world: World,
    feature: FloatArray,
    normal: FloatArray,
    tool: FloatArray,
    weights: FloatArray,
    iterations: int,
    turn: int,
    near: FloatArray,
    goal: FloatArray,
) -> bool:
    """Where the camera should be in the end.

    Args:
        world: Arm and rules.
        feature: ``(3,)``.
        normal: ``(3,)``.
        tool: ``(2, 3)``.
        weights: ``(7,)`` of the residuals.
        iterations: Of the fit from the last goal.
        turn: Which of the world's starts is tried besides; all come round.
        near: ``(6,)`` the present set point, whose turn of the roll is taken.
        goal: ``(6,)`` the last step's, replaced or improved.

    Returns:
        Whether it is the naive pose.
    """
    p, joints = np.empty(3), np.empty(6)
    inside = look(world, feature, normal, world.distance_m, near, p, joints)
    if inside >= 0.0 and worst(world, p, feature, tool, world.margin_m)[0] >= 0.0:
        goal[:] = joints
        return True
    lower, upper = world.inner[LOWER], world.inner[UPPER]
    for joint in range(6):
        goal[joint] = min(upper[joint], max(lower[joint], goal[joint]))
    # The turn of the roll that is nearest, if the joint has it.
    turned = goal[ROLL] + 2 * math.pi * round((near[ROLL] - goal[ROLL]) / (2 * math.pi))
    if lower[ROLL] <= turned <= upper[ROLL]:
        goal[ROLL] = turned
    cost = fit(world, goal, lower, upper, feature, normal, tool, weights, iterations)
    if len(world.starts) == 0:
        return False
    start = world.starts[turn % len(world.starts)]
    off = 0.0
    for k in range(3):
        off += start[k] * normal[k]
    off = max(math.acos(min(1.0, max(-1.0, off))) - APART_RAD, 0.0)
    if weights[HUBER] * (weights[DIRECTION] * 2 * math.sin(off / 2) - 0.5 * weights[HUBER]) > BETTER * cost:
        return False
    if look(world, feature, start, world.distance_m, near, p, joints) < -BEYOND_RAD:
        return False
    if min(worst(world, p, feature, tool, world.margin_m)) < -BEYOND_M:
        return False
    for joint in range(6):
        joints[joint] = min(upper[joint], max(lower[joint], joints[joint]))
    other = fit(world, joints, lower, upper, feature, normal, tool, weights, LONGER * iterations)
    if other < BETTER * cost:
        here, there = np.empty(3), np.empty(3)
        here_m, there_m = ray(world, near, feature, here), ray(world, joints, feature, there)
        if other < MUCH_BETTER * cost or clear(
            world, feature, tool, here, here_m, there, there_m, near, True, WAY_SLACK_M
        ):
            goal[:] = joints
    return False
