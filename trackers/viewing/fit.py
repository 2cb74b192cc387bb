"""The joints from which the camera sees the feature best: bounded least squares over the whole pose.

With the camera's position p and axes x, z, the feature f, c = f - p, the world's up w, all in the arm's base frame, the
residuals, each over its tolerance, are

- gaze: ``z - c / |c|``,
- level: ``x . w``,
- distance: ``|c| - d``,
- place: ``p - p_wanted``, with Huber's loss, so that a far place pulls no harder than a near one,
- rules: how far p is past the floor, the preferred side's plane through the feature, the pole above the feature, and
  the nearest face of the no-go zone, each with its margin; zero where it is not.

The article's costs (C_v = 1 - cos, under a Huber loss) are of fourth order in the angle, and so flat that its optimiser
stops degrees away; residuals in the angle itself are quadratic and Gauss-Newton steps converge in a few. Minimised by
Levenberg and Marquardt's method with joints that stand at a bound, and want beyond it, held there.
"""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.viewpoint.kinematics import forward, jacobian, solve

RESIDUALS = 12
# Where the tolerances stand in ``weights``; an infinite tolerance leaves a residual out.
GAZE, LEVEL, DISTANCE, PLACE, RULE, HUBER = range(6)
SMALLEST_STEP = 1e-9
LARGEST_DAMPING = 1e6
# Closer to the camera than this, the feature has no direction.
CLOSEST_M = 1e-6


@compiled(makes_arrays=True, calls="viewpoint")
def residuals(
    arm: FloatArray,
    reach_m: float,
    joints: FloatArray,
    feature: FloatArray,
    distance_m: float,
    wanted: FloatArray,
    rules: FloatArray,
    faces: FloatArray,
    weights: FloatArray,
    r: FloatArray,
    J: FloatArray,
) -> float:
    """Residuals at ``joints``, their derivatives, and half their squared sum (Huber's where that applies).

    Args:
        arm: ``(3,)`` of the kinematics.
        reach_m: From tool to camera.
        joints: ``(6,)``.
        feature: ``(3,)``, base frame as all that follows.
        distance_m: Wanted.
        wanted: ``(3,)`` place.
        rules: ``(4, 4)``: up and the cosine of the pole's cap; the floor's normal and offset; the side's normal and
            margin; the margin of the zone's faces in the last row's last number.
        faces: ``(n, 4)`` inward normals and offsets of the zone.
        weights: ``(6,)`` one over the tolerances; Huber's threshold in tolerances.
        r: ``(12,)``, filled.
        J: ``(12, 6)``, filled.
    """
    pose = np.empty((4, 4))
    motion = np.empty((6, 6))
    forward(arm, joints, pose)
    jacobian(arm, joints, reach_m, motion)
    p = np.empty(3)
    c = np.empty(3)
    length = 0.0
    for k in range(3):
        p[k] = pose[k, 3] + reach_m * pose[k, 2]
        c[k] = feature[k] - p[k]
        length += c[k] * c[k]
    length = max(math.sqrt(length), CLOSEST_M)
    for k in range(3):
        c[k] /= length
    x_up = z_side = 0.0
    for k in range(3):
        x_up += pose[k, 0] * rules[0, k]
    r[3] = weights[LEVEL] * x_up
    r[4] = weights[DISTANCE] * (length - distance_m)
    for k in range(3):
        r[k] = weights[GAZE] * (pose[k, 2] - c[k])
    for joint in range(6):
        wx, wy, wz = motion[3, joint], motion[4, joint], motion[5, joint]
        vx, vy, vz = motion[0, joint], motion[1, joint], motion[2, joint]
        along = c[0] * vx + c[1] * vy + c[2] * vz
        J[0, joint] = weights[GAZE] * (wy * pose[2, 2] - wz * pose[1, 2] + (vx - along * c[0]) / length)
        J[1, joint] = weights[GAZE] * (wz * pose[0, 2] - wx * pose[2, 2] + (vy - along * c[1]) / length)
        J[2, joint] = weights[GAZE] * (wx * pose[1, 2] - wy * pose[0, 2] + (vz - along * c[2]) / length)
        J[3, joint] = weights[LEVEL] * (
            (wy * pose[2, 0] - wz * pose[1, 0]) * rules[0, 0]
            + (wz * pose[0, 0] - wx * pose[2, 0]) * rules[0, 1]
            + (wx * pose[1, 0] - wy * pose[0, 0]) * rules[0, 2]
        )
        J[4, joint] = -weights[DISTANCE] * along
    # The place, its pull limited.
    miss = 0.0
    for k in range(3):
        r[5 + k] = weights[PLACE] * (p[k] - wanted[k])
        miss += r[5 + k] * r[5 + k]
    miss = math.sqrt(miss)
    huber = 1.0 if miss <= weights[HUBER] else math.sqrt(weights[HUBER] / miss)
    cost = 0.5 * miss * miss if miss <= weights[HUBER] else weights[HUBER] * (miss - 0.5 * weights[HUBER])
    for k in range(3):
        r[5 + k] *= huber
        for joint in range(6):
            J[5 + k, joint] = huber * weights[PLACE] * motion[k, joint]
    # The rules: floor, side, pole, zone.
    floor = rules[1, 3] - (p[0] * rules[1, 0] + p[1] * rules[1, 1] + p[2] * rules[1, 2])
    for k in range(3):
        z_side -= length * c[k] * rules[2, k]  # of the camera from the feature, along the preferred side
    side = rules[2, 3] * length - z_side
    pole = -rules[0, 3]
    for k in range(3):
        pole -= c[k] * rules[0, k]
    nearest, depth = -1, math.inf
    for face in range(len(faces)):
        behind = faces[face, 0] * p[0] + faces[face, 1] * p[1] + faces[face, 2] * p[2] - faces[face, 3]
        if behind < depth:
            nearest, depth = face, behind
    depth += rules[3, 3]
    for row in range(8, RESIDUALS):
        r[row] = 0.0
        for joint in range(6):
            J[row, joint] = 0.0
    if floor > 0.0:
        r[8] = weights[RULE] * floor
    if side > 0.0:
        r[9] = weights[RULE] * side
    if pole > 0.0:
        r[10] = weights[RULE] * distance_m * pole
    if depth > 0.0:
        r[11] = weights[RULE] * depth
    for joint in range(6):
        vx, vy, vz = motion[0, joint], motion[1, joint], motion[2, joint]
        if floor > 0.0:
            J[8, joint] = -weights[RULE] * (vx * rules[1, 0] + vy * rules[1, 1] + vz * rules[1, 2])
        along = c[0] * vx + c[1] * vy + c[2] * vz
        if side > 0.0:
            across = vx * rules[2, 0] + vy * rules[2, 1] + vz * rules[2, 2]
            J[9, joint] = -weights[RULE] * (across + rules[2, 3] * along)
        if pole > 0.0:
            up = vx * rules[0, 0] + vy * rules[0, 1] + vz * rules[0, 2]
            c_up = c[0] * rules[0, 0] + c[1] * rules[0, 1] + c[2] * rules[0, 2]
            J[10, joint] = weights[RULE] * distance_m * (up - along * c_up) / length
        if depth > 0.0:
            J[11, joint] = weights[RULE] * (vx * faces[nearest, 0] + vy * faces[nearest, 1] + vz * faces[nearest, 2])
    for row in range(RESIDUALS):
        if row < 5 or row > 7:
            cost += 0.5 * r[row] * r[row]
    return cost


@compiled(makes_arrays=True, calls="viewpoint")
def fit(
    arm: FloatArray,
    reach_m: float,
    joints: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    feature: FloatArray,
    distance_m: float,
    wanted: FloatArray,
    rules: FloatArray,
    faces: FloatArray,
    weights: FloatArray,
    iterations: int,
) -> float:
    """Improve ``joints`` within bounds.

    Args:
        arm: As in :func:`residuals`.
        reach_m: As there.
        joints: ``(6,)``, within the bounds; improved in place.
        lower: ``(6,)``; a joint whose bounds are one stays where it is.
        upper: ``(6,)``.
        feature: As in :func:`residuals`, and all that follows.
        distance_m: There.
        wanted: There.
        rules: There.
        faces: There.
        weights: There.
        iterations: At most so many.

    Returns:
        The cost that remains.
    """
    r, J = np.empty(RESIDUALS), np.empty((RESIDUALS, 6))
    r_try, J_try = np.empty(RESIDUALS), np.empty((RESIDUALS, 6))
    A, b, held = np.empty((6, 6)), np.empty(6), np.empty(6, dtype=np.bool_)
    trial = np.empty(6)
    cost: float = residuals(arm, reach_m, joints, feature, distance_m, wanted, rules, faces, weights, r, J)
    damping = 1e-4
    for _ in range(iterations):
        for row in range(6):
            b[row] = 0.0
            for k in range(RESIDUALS):
                b[row] -= J[k, row] * r[k]
            held[row] = (joints[row] <= lower[row] and b[row] < 0.0) or (joints[row] >= upper[row] and b[row] > 0.0)
        for row in range(6):
            for column in range(row + 1):
                total = 0.0
                if not (held[row] or held[column]):
                    for k in range(RESIDUALS):
                        total += J[k, row] * J[k, column]
                A[row, column] = total
            if held[row]:
                A[row, row] = 1.0
                b[row] = 0.0
            else:
                A[row, row] += damping * A[row, row] + 1e-9
        if not solve(A, b):
            damping *= 10.0
            continue
        moved = 0.0
        for k in range(6):
            trial[k] = min(upper[k], max(lower[k], joints[k] + b[k]))
            moved = max(moved, abs(trial[k] - joints[k]))
        better = residuals(arm, reach_m, trial, feature, distance_m, wanted, rules, faces, weights, r_try, J_try)
        if better < cost:
            cost = better
            joints[:] = trial
            r[:] = r_try
            J[:] = J_try
            damping = max(damping * 0.1, 1e-9)
            if moved < SMALLEST_STEP:
                break
        else:
            if moved < SMALLEST_STEP:
                break
            damping *= 10.0
            if damping > LARGEST_DAMPING:
                break
    return cost
