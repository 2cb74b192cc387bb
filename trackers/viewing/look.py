"""The joints of a camera that looks at the feature from a direction, and where the camera is."""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.trackers.viewing.fit import fit
from surgbench.trackers.viewing.world import LOWER, UPPER, World
from surgbench.viewpoint.kinematics import forward, inverse

# An axis is vertical where its level part is shorter.
VERTICAL = 1e-6


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
