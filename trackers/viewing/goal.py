"""Where the camera should be in the end: the naive pose where it can be had, else the best fit of several starts."""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.trackers.viewing.fit import fit
from surgbench.trackers.viewing.residuals import DIRECTION, HUBER
from surgbench.trackers.viewing.rules import worst
from surgbench.trackers.viewing.world import LOWER, UPPER, World
from surgbench.viewpoint.kinematics import forward, inverse

# Between neighbouring starts, radians; by less than this share of its cost no other goal is left for.
APART_RAD = 0.35
BETTER = 0.85
# A start is fitted so many times longer than the goal, which is nearly there.
LONGER = 3
VERTICAL = 1e-6
ROLL = 3


@compiled(makes_arrays=True, calls="viewpoint")
def level_pose(up: FloatArray, position: FloatArray, axis: FloatArray, reach_m: float, pose: FloatArray) -> bool:
    """The tool's pose for a level camera that looks along ``axis``; false where that is straight up or down."""
    length = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        pose[k, 0] = up[i] * axis[j] - up[j] * axis[i]
        length += pose[k, 0] ** 2
    length = math.sqrt(length)
    if length < VERTICAL:
        return False
    for k in range(3):
        pose[k, 0] /= length
        pose[k, 2] = axis[k]
        pose[k, 3] = position[k] - reach_m * axis[k]
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        pose[k, 1] = pose[i, 2] * pose[j, 0] - pose[j, 2] * pose[i, 0]
    return True


@compiled(makes_arrays=True, calls="viewpoint")
def look(
    world: World,
    feature: FloatArray,
    direction: FloatArray,
    distance_m: float,
    near: FloatArray,
    p: FloatArray,
    joints: FloatArray,
) -> float:
    """The joints of a level camera that looks at the feature from a direction.

    Args:
        world: The arm.
        feature: ``(3,)``.
        direction: ``(3,)`` unit vector from the feature to the camera.
        distance_m: From it.
        near: ``(6,)`` whose turn of the roll is taken.
        p: ``(3,)``, filled: the camera.
        joints: ``(6,)``, filled.

    Returns:
        By how much the worst of them is within its limits (rad or m), negative beyond.
    """
    tool, axis = np.empty((4, 4)), np.empty(3)
    for k in range(3):
        axis[k] = -direction[k]
        p[k] = feature[k] + distance_m * direction[k]
    if not level_pose(world.up, p, axis, world.reach_m, tool):
        joints[:] = near
        return -math.inf
    inverse(world.arm, tool, near, joints)
    inside = math.inf
    for joint in range(6):
        inside = min(inside, joints[joint] - world.limits[LOWER, joint], world.limits[UPPER, joint] - joints[joint])
    return inside


@compiled(makes_arrays=True, calls="viewpoint")
def look_nearly(
    world: World,
    feature: FloatArray,
    direction: FloatArray,
    distance_m: float,
    tool: FloatArray,
    weights: FloatArray,
    iterations: int,
    near: FloatArray,
    p: FloatArray,
    joints: FloatArray,
) -> bool:
    """As :func:`look`, but the joints within their limits that come nearest where it is beyond them; whether it is not.

    Args:
        world: Arm and rules.
        feature: ``(3,)``.
        direction: ``(3,)``.
        distance_m: From the feature.
        tool: ``(2, 3)``.
        weights: ``(7,)`` of the residuals.
        iterations: Of the fit.
        near: ``(6,)`` where that begins.
        p: ``(3,)``, filled: the camera, if it could be had.
        joints: ``(6,)``, filled.
    """
    if look(world, feature, direction, distance_m, near, p, joints) >= 0.0:
        return True
    for joint in range(6):
        joints[joint] = min(world.limits[UPPER, joint], max(world.limits[LOWER, joint], near[joint]))
    fit(world, joints, world.limits[LOWER], world.limits[UPPER], feature, direction, tool, weights, iterations)
    return False


@compiled(makes_arrays=True, calls="viewpoint")
def place(world: World, joints: FloatArray, p: FloatArray) -> None:
    """The camera's place ``(3,)``."""
    pose = np.empty((4, 4))
    forward(world.arm, joints, pose)
    for k in range(3):
        p[k] = pose[k, 3] + world.reach_m * pose[k, 2]


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
    if look(world, feature, normal, world.distance_m, near, p, joints) >= 0.0:
        if worst(world, p, feature, tool, world.margin_m)[0] >= 0.0:
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
    if look(world, feature, start, world.distance_m, near, p, joints) < 0.0:
        return False
    if min(worst(world, p, feature, tool, world.margin_m)) < 0.0:
        return False
    for joint in range(6):
        joints[joint] = min(upper[joint], max(lower[joint], joints[joint]))
    if fit(world, joints, lower, upper, feature, normal, tool, weights, LONGER * iterations) < BETTER * cost:
        goal[:] = joints
    return False
