"""Camera poses in compiled code: the naive one, level views, and the joints for them.

The same poses as in :mod:`surgbench.viewpoint.placement`, one at a time and without making arrays for each. World
frame: metres, z up; poses ``(4, 4)``.
"""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.viewpoint.kinematics import forward, inverse

ROLL = 3
VERTICAL = 1e-9
# A feature farther away than this, or nearer to the camera, says nothing on where to look.
FARTHEST_M = 1e3
NEAREST_M = 1e-6


@compiled
def is_usable(feature: FloatArray) -> bool:
    """Whether a feature's pose ``(4, 4)`` is finite, within reason, and has a normal."""
    length = 0.0
    for row in range(3):
        for column in range(4):
            if not abs(feature[row, column]) < FARTHEST_M:  # NaN included
                return False
        length += feature[row, 1] ** 2
    return length > 1e-6


@compiled
def compose(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """``out = a @ b`` of rigid transforms ``(4, 4)``; ``out`` is neither of them."""
    for row in range(3):
        for column in range(4):
            total = a[row, 3] if column == 3 else 0.0
            for k in range(3):
                total += a[row, k] * b[k, column]
            out[row, column] = total
        out[3, row] = 0.0
    out[3, 3] = 1.0


@compiled
def look_along(x: float, y: float, z: float, pose: FloatArray) -> None:
    """Turn a pose along a unit vector, its x axis level (``x = up x z``; straight up or down it is the world's -y)."""
    level = math.sqrt(x * x + y * y)
    a, b = (-y / level, x / level) if level > VERTICAL else (0.0, -1.0)
    pose[0, 0], pose[1, 0], pose[2, 0] = a, b, 0.0
    pose[0, 1], pose[1, 1], pose[2, 1] = -z * b, z * a, x * b - y * a
    pose[0, 2], pose[1, 2], pose[2, 2] = x, y, z
    pose[3, 0] = pose[3, 1] = pose[3, 2] = 0.0
    pose[3, 3] = 1.0


@compiled
def look_from(position: FloatArray, feature: FloatArray, pose: FloatArray) -> bool:
    """Turn a pose as a level camera at ``position`` (``(3,)``) has to be turned to look at a feature ``(4, 4)``.

    Returns:
        False where the camera is in the feature, and nothing was done.
    """
    x, y, z = feature[0, 3] - position[0], feature[1, 3] - position[1], feature[2, 3] - position[2]
    length = math.sqrt(x * x + y * y + z * z)
    if length < NEAREST_M:
        return False
    look_along(x / length, y / length, z / length, pose)
    return True


@compiled
def naive(feature: FloatArray, distance_m: float, pose: FloatArray) -> None:
    """The camera at a distance along the feature's normal, looking back along it, level."""
    length = 0.0
    for k in range(3):
        length += feature[k, 1] ** 2
    length = math.sqrt(length)
    look_along(-feature[0, 1] / length, -feature[1, 1] / length, -feature[2, 1] / length, pose)
    for k in range(3):
        pose[k, 3] = feature[k, 3] - distance_m * pose[k, 2]


@compiled(makes_arrays=True, calls="viewpoint")
def tool_pose(arm: FloatArray, base: FloatArray, joints: FloatArray, pose: FloatArray) -> None:
    """T_world_tool of joints ``(6,)`` of an arm whose base is at ``base`` (``(4, 4)`` T_world_base)."""
    local = np.empty((4, 4))
    forward(arm, joints, local)
    compose(base, local, pose)


@compiled
def shift(pose: FloatArray, reach_m: float) -> None:
    """Move a pose along its z axis: from the tool to the camera by ``reach_m``, back by ``-reach_m``."""
    for k in range(3):
        pose[k, 3] += reach_m * pose[k, 2]


@compiled
def nearest_turn(angle: float, near: float) -> float:
    """An angle, whole turns added, nearest to another."""
    return angle + 2 * math.pi * round((near - angle) / (2 * math.pi))


@compiled(makes_arrays=True, calls="viewpoint")
def naive_joints(
    arm: FloatArray,
    reach_m: float,
    limits: FloatArray,
    frames: FloatArray,
    distance_m: float,
    feature: FloatArray,
    near: FloatArray,
    joints: FloatArray,
) -> bool:
    """The joints for the naive pose, in closed form, clipped to the limits.

    Args:
        arm: ``(3,)`` of the kinematics.
        reach_m: From tool to camera.
        limits: ``(2, 6)`` lower and upper.
        frames: ``(2, 4, 4)`` T_world_base and its inverse.
        distance_m: d_t.
        feature: ``(4, 4)``.
        near: ``(6,)``; of the roll's turns within the limits the nearest to its roll is taken.
        joints: ``(6,)``, filled.

    Returns:
        Whether they are within the limits without clipping.
    """
    pose, local = np.empty((4, 4)), np.empty((4, 4))
    naive(feature, distance_m, pose)
    shift(pose, -reach_m)
    compose(frames[1], pose, local)
    inverse(arm, local, near, joints)
    if joints[ROLL] > limits[1, ROLL]:
        joints[ROLL] -= 2 * math.pi
    elif joints[ROLL] < limits[0, ROLL]:
        joints[ROLL] += 2 * math.pi
    inside: bool = clip(limits, joints)
    return inside


@compiled
def clip(limits: FloatArray, joints: FloatArray) -> bool:
    """Bring joints ``(6,)`` within the limits; whether they already were."""
    inside = True
    for joint in range(6):
        if not joints[joint] >= limits[0, joint]:
            joints[joint], inside = limits[0, joint], False
        elif joints[joint] > limits[1, joint]:
            joints[joint], inside = limits[1, joint], False
    return inside


@compiled(makes_arrays=True)
def shaft_joints(
    arm: FloatArray,
    reach_m: float,
    limits: FloatArray,
    frames: FloatArray,
    feature: FloatArray,
    distance_m: float,
    depth_m: float,
    near: FloatArray,
    joints: FloatArray,
) -> float:
    """The joints that point the shaft from the remote centre at the feature, wrist straight and camera level.

    Args:
        arm: ``(3,)`` of the kinematics.
        reach_m: From tool to camera.
        limits: ``(2, 6)`` lower and upper.
        frames: ``(2, 4, 4)`` T_world_base and its inverse.
        feature: ``(4, 4)``.
        distance_m: From camera to feature; NaN where ``depth_m`` says how deep the camera is.
        depth_m: From the remote centre to the camera, where ``distance_m`` is NaN.
        near: ``(6,)``; the roll is taken in the turn nearest to its.
        joints: ``(6,)``, filled, within the limits.

    Returns:
        How far the feature is from the remote centre, metres; nothing is filled where that is next to nothing.
    """
    axis = np.empty(3)
    length = 0.0
    for k in range(3):
        axis[k] = frames[1, k, 3]
        for i in range(3):
            axis[k] += frames[1, k, i] * feature[i, 3]
        length += axis[k] ** 2
    length = math.sqrt(length)
    if length < NEAREST_M:
        return length
    axis /= length
    yaw, pitch = math.atan2(axis[0], -axis[2]), math.asin(min(1.0, max(-1.0, -axis[1])))
    s1, c1, s2, c2 = math.sin(yaw), math.cos(yaw), math.sin(pitch), math.cos(pitch)
    level, world = np.empty((4, 4)), np.empty(3)
    for k in range(3):
        world[k] = 0.0
        for i in range(3):
            world[k] += frames[0, k, i] * axis[i]
    look_along(world[0], world[1], world[2], level)
    x = np.zeros(3)  # the level axis in the frame of the base
    for k in range(3):
        for i in range(3):
            x[k] += frames[1, k, i] * level[i, 0]
    # With the wrist straight the tool's x axis is -(cos q4 x3 + sin q4 y3).
    along = -s1 * s2 * x[0] - c2 * x[1] + c1 * s2 * x[2]
    across = -c1 * x[0] - s1 * x[2]
    if not math.isnan(distance_m):
        depth_m = length - distance_m
    joints[0], joints[1], joints[2] = yaw, pitch, depth_m - reach_m - arm[0] - arm[1] - arm[2]
    joints[3], joints[4], joints[5] = nearest_turn(math.atan2(-across, -along), near[ROLL]), 0.0, 0.0
    if joints[ROLL] > limits[1, ROLL]:
        joints[ROLL] -= 2 * math.pi
    elif joints[ROLL] < limits[0, ROLL]:
        joints[ROLL] += 2 * math.pi
    clip(limits, joints)
    return length
