"""One step of AutoCam up to the optimiser, as the article has it and as its published code has it.

Both tell by flags which rules were against the pose; where the last two are among them the optimiser has the next word.
World frame throughout, except for ``points``, which are what :class:`ConstrainedIK` takes.
"""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.trackers.hierarchical.poses import (
    ROLL,
    compose,
    look_from,
    naive,
    nearest_turn,
    shift,
    tool_pose,
)
from surgbench.viewpoint.kinematics import newton
from surgbench.viewpoint.placement import CONSTRAINTS

# In the order of CONSTRAINTS; UNSEEN: the camera is in the feature, and looks nowhere.
NO_GO, FLOOR, ORIENTATION, PROXIMITY, JOINT_LIMIT, UNSEEN = (1 << k for k in range(6))
NAMES = tuple(tuple(name for k, name in enumerate(CONSTRAINTS) if flags >> k & 1) for flags in range(1 << 6))


@compiled
def height_above(plane: FloatArray, position: FloatArray) -> float:
    """How far a point lies on the side that a plane ``(4,)`` (unit normal and offset) looks to."""
    height: float = plane[0] * position[0] + plane[1] * position[1] + plane[2] * position[2] - plane[3]
    return height


@compiled
def is_inside(faces: FloatArray, position: FloatArray) -> bool:
    """Whether a point lies behind all faces of the no-go zone."""
    inside = True
    for face in range(len(faces)):
        inside = inside and height_above(faces[face], position) >= 0.0
    return inside


@compiled
def onto(plane: FloatArray, position: FloatArray) -> None:
    """Eq. 1 as it must be meant: ``p - [(p - p_plane) . n] n``."""
    height = height_above(plane, position)
    for k in range(3):
        position[k] -= height * plane[k]


@compiled
def to_boundary(faces: FloatArray, floor: FloatArray, position: FloatArray) -> None:
    """Bring a point out of the no-go zone and above the floor, by the shortest way to each.

    First up to the floor, which lies above the zone's base; then, from inside the zone, to the nearest of its other
    faces. To a side that is level, to the top it is higher: the floor stays below. The sides of a base whose normal is
    the floor's are upright, always.
    """
    if height_above(floor, position) < 0.0:
        onto(floor, position)
    if is_inside(faces, position):
        nearest, least = 1, math.inf
        for face in range(1, len(faces)):
            depth = height_above(faces[face], position)
            if depth < least:
                nearest, least = face, depth
        onto(faces[nearest], position)


@compiled
def step_towards(now: FloatArray, pose: FloatArray, beyond_m: float, share: float) -> None:
    """Bring a pose nearer, ``share`` of the way from ``now``, where it is farther than ``beyond_m``."""
    way = 0.0
    for k in range(3):
        way += (pose[k, 3] - now[k, 3]) ** 2
    if math.sqrt(way) > beyond_m:
        for k in range(3):
            pose[k, 3] = now[k, 3] + share * (pose[k, 3] - now[k, 3])


@compiled
def points_of(back: FloatArray, feature: FloatArray, pose: FloatArray, points: FloatArray) -> None:
    """Feature and desired position in the frame of the base (``back``: T_base_world) into ``points[:2]``."""
    for row in range(3):
        points[0, row] = points[1, row] = back[row, 3]
        for k in range(3):
            points[0, row] += back[row, k] * feature[k, 3]
            points[1, row] += back[row, k] * pose[k, 3]


@compiled(makes_arrays=True, calls="viewpoint")
def reach(
    arm: FloatArray, back: FloatArray, bounds: FloatArray, tool: FloatArray, start: FloatArray, joints: FloatArray
) -> bool:
    """Newton's inverse kinematics for a tool's pose in the world.

    Args:
        arm: ``(3,)`` of the kinematics.
        back: ``(4, 4)`` T_base_world.
        bounds: ``(2, 6)`` of the joints.
        tool: ``(4, 4)`` T_world_tool.
        start: ``(6,)`` the present joints; the roll is given in the turn nearest to theirs.
        joints: ``(6,)``, filled.

    Returns:
        Whether it converged, to joints within the bounds.
    """
    local = np.empty((4, 4))
    compose(back, tool, local)
    if not newton(arm, local, start, joints):
        return False
    joints[ROLL] = nearest_turn(joints[ROLL], start[ROLL])
    within = True
    for joint in range(6):
        within = within and bounds[0, joint] <= joints[joint] <= bounds[1, joint]
    return within


@compiled(makes_arrays=True, calls="viewpoint")
def article_step(
    arm: FloatArray,
    reach_m: float,
    limits: FloatArray,
    frames: FloatArray,
    faces: FloatArray,
    rules: FloatArray,
    options: FloatArray,
    feature: FloatArray,
    start: FloatArray,
    points: FloatArray,
    joints: FloatArray,
) -> int:
    """Placement, interpolation, rules, and Newton's inverse kinematics of the article (II-A1 to II-A4).

    Args:
        arm: This and the next five as in :class:`surgbench.trackers.hierarchical.world.World`.
        reach_m: From tool to camera.
        limits: ``(2, 6)``.
        frames: ``(2, 4, 4)``.
        faces: ``(n, 4)``.
        rules: ``(2, 4)``.
        options: ``(3,)`` d_t, and the distance beyond which a share of the way is gone at once, and that share.
        feature: ``(4, 4)``.
        start: ``(6,)`` measured joints.
        points: ``(3, 3)``, the first two filled.
        joints: ``(6,)``, filled; of use where neither of the optimiser's rules is against them.

    Returns:
        Flags.
    """
    now, pose = np.empty((4, 4)), np.empty((4, 4))
    tool_pose(arm, frames[0], start, now)
    shift(now, reach_m)
    naive(feature, options[0], pose)
    step_towards(now, pose, options[1], options[2])
    position = pose[:3, 3]
    flags = 0
    if is_inside(faces, position):
        flags |= NO_GO
    if height_above(rules[0], position) < 0.0:
        flags |= FLOOR
    if rules[1, 0] * pose[0, 2] + rules[1, 1] * pose[1, 2] + rules[1, 2] * pose[2, 2] > 0.0:
        flags |= ORIENTATION
    if flags & ORIENTATION:
        position[:] = now[:3, 3]
    elif flags:
        to_boundary(faces, rules[0], position)
    if flags and not look_from(position, feature, pose):
        return flags | UNSEEN
    points_of(frames[1], feature, pose, points)
    if flags and not flags & ORIENTATION:
        distance = 0.0
        for k in range(3):
            distance += (feature[k, 3] - position[k]) ** 2
        if math.sqrt(distance) < rules[1, 3]:
            return flags | PROXIMITY
    shift(pose, -reach_m)
    if not reach(arm, frames[1], limits, pose, start, joints):
        flags |= JOINT_LIMIT
    return flags


@compiled(makes_arrays=True, calls="viewpoint")
def published_step(
    arm: FloatArray,
    reach_m: float,
    frames: FloatArray,
    faces: FloatArray,
    rules: FloatArray,
    options: FloatArray,
    feature: FloatArray,
    start: FloatArray,
    points: FloatArray,
    tool: FloatArray,
    look: FloatArray,
) -> int:
    """Placement, interpolation and rules of the published code.

    Args:
        arm: This and the next four as in :class:`surgbench.trackers.hierarchical.world.World`.
        reach_m: From tool to camera.
        frames: ``(2, 4, 4)``.
        faces: ``(n, 4)``.
        rules: ``(2, 4)``.
        options: ``(3,)`` d_t, and the distance beyond which a share of the way is gone at once, and that share.
        feature: ``(4, 4)``, filtered.
        start: ``(6,)`` measured joints.
        points: ``(3, 3)``, the first two filled; the desired position is the tool's.
        tool: ``(4, 4)``, filled: where the tool should be.
        look: ``(4, 4)``, filled: turned as the camera, were it to stay in its place, would look at the feature.

    Returns:
        Flags; of the last two only the proximity, and whether the feature can be looked at.
    """
    now = np.empty((4, 4))
    tool_pose(arm, frames[0], start, now)
    camera, position = np.empty(3), np.empty(3)
    naive(feature, options[0], tool)
    shift(tool, -reach_m)
    step_towards(now, tool, options[1], options[2])
    for k in range(3):
        camera[k] = now[k, 3] + reach_m * now[k, 2]
        position[k] = tool[k, 3] + reach_m * tool[k, 2]
    if not look_from(camera, feature, look):
        return UNSEEN
    flags = 0
    if is_inside(faces, position):
        flags |= NO_GO
    if height_above(rules[0], position) < 0.0:
        flags |= FLOOR
    if rules[1, 0] * tool[0, 1] + rules[1, 1] * tool[1, 1] + rules[1, 2] * tool[2, 1] > 0.0:
        flags |= ORIENTATION
    if flags & ORIENTATION:
        tool[:3, 3] = now[:3, 3]
    elif flags:
        onto(faces[1], tool[:3, 3])  # always the top, and the tool's origin, not the camera's
    if flags:
        tool[:3, :3] = look[:3, :3]
    if flags and not flags & ORIENTATION:
        distance = 0.0
        for k in range(3):
            distance += (feature[k, 3] - tool[k, 3] - reach_m * tool[k, 2]) ** 2
        if math.sqrt(distance) < rules[1, 3]:
            flags |= PROXIMITY
    points_of(frames[1], feature, tool, points)
    return flags
