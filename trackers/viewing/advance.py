"""One step of the controller `gaze`: from what is measured to the next set point."""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.trackers.viewing.approach import chase, track
from surgbench.trackers.viewing.fit import fit
from surgbench.viewpoint.kinematics import inverse

AT_ONCE, LATER, FITTED = range(3)


@compiled(makes_arrays=True, calls="viewpoint")
def level_pose(up: FloatArray, position: FloatArray, axis: FloatArray, reach_m: float, pose: FloatArray) -> bool:
    """The tool's pose for a level camera that looks along ``axis``; false where that is straight up or down."""
    length = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        pose[k, 0] = up[i] * axis[j] - up[j] * axis[i]
        length += pose[k, 0] ** 2
    length = math.sqrt(length)
    if length < 1e-6:
        return False
    for k in range(3):
        pose[k, 0] /= length
        pose[k, 2] = axis[k]
        pose[k, 3] = position[k] - reach_m * axis[k]
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        pose[k, 1] = pose[i, 2] * pose[j, 0] - pose[j, 2] * pose[i, 0]
    return True


@compiled
def allowed(position: FloatArray, feature: FloatArray, rules: FloatArray, faces: FloatArray) -> bool:
    """Whether a camera's place respects floor, side, pole and zone, margins included."""
    height = side = rise = length = 0.0
    for k in range(3):
        height += rules[1, k] * position[k]
        side += rules[2, k] * (position[k] - feature[k])
        rise += rules[0, k] * (position[k] - feature[k])
        length += (position[k] - feature[k]) ** 2
    length = math.sqrt(length)
    if height < rules[1, 3] or side < rules[2, 3] * length or rise > rules[0, 3] * length:
        return False
    for face in range(len(faces)):
        behind = rules[3, 3] - faces[face, 3]
        for k in range(3):
            behind += faces[face, k] * position[k]
        if behind < 0.0:
            return True
    return False


@compiled
def reachable(limits: FloatArray, setpoint: FloatArray, velocity: FloatArray, dt_s: float, box: FloatArray) -> None:
    """What every joint can reach in one step, and still stop before its limit: ``box``, ``(2, 6)``, is filled."""
    for joint in range(6):
        a = limits[3, joint]
        room_up, room_down = max(limits[1, joint] - setpoint[joint], 0.0), max(setpoint[joint] - limits[0, joint], 0.0)
        fast_up = math.sqrt(a * a * dt_s * dt_s + 2 * a * room_up) - a * dt_s
        fast_down = math.sqrt(a * a * dt_s * dt_s + 2 * a * room_down) - a * dt_s
        least = max(velocity[joint] - a * dt_s, -limits[2, joint])
        most = min(velocity[joint] + a * dt_s, limits[2, joint])
        # Where both cannot be had, braking as hard as possible comes nearest.
        box[0, joint] = setpoint[joint] + min(max(least, -fast_down), most) * dt_s
        box[1, joint] = setpoint[joint] + max(min(most, fast_up), least) * dt_s


@compiled(makes_arrays=True, calls="viewpoint")
def advance(
    arm: FloatArray,
    reach_m: float,
    limits: FloatArray,
    options: FloatArray,
    goal_weights: FloatArray,
    step_weights: FloatArray,
    iterations: FloatArray,
    rules: FloatArray,
    faces: FloatArray,
    pose: FloatArray,
    motion: FloatArray,
    last: FloatArray,
    goal: FloatArray,
    setpoint: FloatArray,
    velocity: FloatArray,
    out: FloatArray,
) -> int:
    """One step; everything in the frame of the arm's base.

    Args:
        arm: ``(3,)`` of the kinematics.
        reach_m: From tool to camera.
        limits: ``(4, 6)`` lower and upper joint limits, largest velocities and accelerations.
        options: ``(7,)`` period, time ahead, distance, the two filter gains, the share fed forward, and by how
            much roll and wrist are behind when the others go at half their pace.
        goal_weights: ``(6,)``.
        step_weights: ``(6,)``.
        iterations: ``(2,)`` of the two fits.
        rules: ``(4, 4)``, as :func:`surgbench.trackers.viewing.fit.residuals` has them.
        faces: ``(n, 4)``.
        pose: ``(4, 4)`` the feature as measured.
        motion: ``(4, 3)`` filtered feature and its velocity, normal and its velocity.
        last: ``(6,)`` what the joints followed in the last step, updated.
        goal: ``(6,)`` joints where the camera should be in the end; the last step's, improved.
        setpoint: ``(6,)``.
        velocity: ``(6,)``.
        out: ``(6,)`` the next set point.

    Returns:
        ``AT_ONCE`` where the naive pose can be had in this step, ``LATER``, or ``FITTED`` where it cannot be had.
    """
    dt_s, ahead_s, distance_m = options[0], options[1], options[2]
    track(pose[:3, 3].copy(), options[3], dt_s, motion[0], motion[1])
    track(pose[:3, 1].copy(), options[4], dt_s, motion[2], motion[3])
    up = rules[0, :3]
    feature, naive, axis, tool, box = np.empty(3), np.empty(3), np.empty(3), np.empty((4, 4)), np.empty((2, 6))
    length = 0.0
    for k in range(3):
        feature[k] = motion[0, k] + ahead_s * motion[1, k]
        axis[k] = -motion[2, k] - ahead_s * motion[3, k]
        length += axis[k] ** 2
    length = math.sqrt(length)
    for k in range(3):
        axis[k] = axis[k] / length if length > 1e-9 else -pose[k, 1]
        naive[k] = feature[k] - distance_m * axis[k]
    reachable(limits, setpoint, velocity, dt_s, box)
    free = allowed(naive, feature, rules, faces) and level_pose(up, naive, axis, reach_m, tool)
    if free:
        inverse(arm, tool, setpoint, out)
        for joint in range(6):
            free = free and limits[0, joint] <= out[joint] <= limits[1, joint]
    if free:
        goal[:] = out
    else:
        fit(
            arm, reach_m, goal, limits[0], limits[1], feature, distance_m, naive, rules, faces, goal_weights,
            int(iterations[0]),
        )  # fmt: skip
    # Yaw, pitch and insertion bring the camera to its place; roll and wrist turn it to the feature on the way.
    speed = np.empty(6)
    for joint in range(3):
        speed[joint] = (goal[joint] - last[joint]) / dt_s
        if abs(speed[joint]) > limits[2, joint]:  # another goal
            speed[:3] = 0.0
            break
        speed[joint] *= options[5]
    last[:3] = goal[:3]
    # No faster than these can follow: what they are behind by tells.
    behind = 0.0
    for joint in range(3, 6):
        behind = max(behind, abs(last[joint] - setpoint[joint]))
    pace = 1.0 / (1.0 + (behind / options[6]) ** 2)
    at_once = chase(setpoint[:3], goal[:3], speed[:3], box[:, :3], limits[3, :3], dt_s, pace, out[:3])
    view = goal.copy()
    if not at_once:
        view[:3], view[3:] = out[:3], last[3:]
        bounds = limits[:2].copy()
        bounds[0, :3] = bounds[1, :3] = out[:3]
        fit(
            arm, reach_m, view, bounds[0], bounds[1], feature, distance_m, naive, rules, faces, step_weights,
            int(iterations[1]),
        )  # fmt: skip
    for joint in range(3, 6):
        speed[joint] = (view[joint] - last[joint]) / dt_s
        if abs(speed[joint]) > limits[2, joint]:
            speed[joint] = 0.0
        last[joint] = view[joint]
    at_once = chase(setpoint[3:], view[3:], speed[3:], box[:, 3:], limits[3, 3:], dt_s, 1.0, out[3:]) and at_once
    return FITTED if not free else (AT_ONCE if at_once else LATER)
