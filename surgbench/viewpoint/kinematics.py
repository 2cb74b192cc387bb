"""Kinematics of all six joints of a patient-side manipulator: forward, Jacobian, and two inverses.

The first four joints are those of :mod:`surgbench.instrument.arm`, whose frames this continues with two of the wrist
(modified Denavit-Hartenberg parameters, jhu-dvrk/sawIntuitiveResearchKit, share/kinematic/PSM.json, share/tool):

==  ===========  =====  ===============  =========  =
i   joint        alpha  a                theta      d
==  ===========  =====  ===============  =========  =
5   wrist pitch  -pi/2  0                q5 - pi/2  0
6   wrist yaw    -pi/2  wrist_length_m   q6 - pi/2  0
==  ===========  =====  ===============  =========  =

and the turn of the tool tip: its z points out of the jaws. These are compiled functions of plain arrays, so that a
controller can call them from its own; ``arm`` is always ``(3,)``: insertion offset, roll offset, wrist length, metres
(:attr:`surgbench.viewpoint.camera_arm.CameraArm.packed`).
"""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray

JOINTS = 6
ITERATIONS = 500
DAMPING = 1e-3
TOLERANCE = 1e-12


@compiled(makes_arrays=True)
def axes(joints: FloatArray, out: FloatArray) -> None:
    """The unit vectors that everything here is made of, in the base frame.

    Args:
        joints: ``(6,)`` yaw, pitch (radians), insertion (metres), roll, wrist pitch, wrist yaw (radians).
        out: ``(5, 3)``, filled: the pitch axis, the shaft's, the wrist pitch axis, x of frame 5 (from the wrist to the
            yaw axis), the wrist yaw axis.
    """
    s1, c1, s2, c2 = math.sin(joints[0]), math.cos(joints[0]), math.sin(joints[1]), math.cos(joints[1])
    s4, c4, s5, c5 = math.sin(joints[3]), math.cos(joints[3]), math.sin(joints[4]), math.cos(joints[4])
    x3 = (-s1 * s2, -c2, c1 * s2)
    y3 = (-c1, 0.0, -s1)
    z3 = (s1 * c2, -s2, -c1 * c2)
    for k in range(3):
        x4 = c4 * x3[k] + s4 * y3[k]
        out[0, k] = y3[k]
        out[1, k] = z3[k]
        out[2, k] = c4 * y3[k] - s4 * x3[k]
        out[3, k] = s5 * x4 + c5 * z3[k]
        out[4, k] = c5 * x4 - s5 * z3[k]


@compiled(makes_arrays=True)
def forward(arm: FloatArray, joints: FloatArray, pose: FloatArray) -> None:
    """Forward kinematics.

    Args:
        arm: ``(3,)``.
        joints: ``(6,)``.
        pose: ``(4, 4)``, filled with T_base_tool.
    """
    unit = np.empty((5, 3))
    axes(joints, unit)
    s6, c6 = math.sin(joints[5]), math.cos(joints[5])
    depth = joints[2] + arm[0] + arm[1]
    for k in range(3):
        along = unit[3, k]
        across = unit[2, k]
        pose[k, 0] = -unit[4, k]
        pose[k, 1] = -(s6 * along + c6 * across)
        pose[k, 2] = c6 * along - s6 * across
        pose[k, 3] = depth * unit[1, k] + arm[2] * along
    pose[3, 0] = pose[3, 1] = pose[3, 2] = 0.0
    pose[3, 3] = 1.0


@compiled(makes_arrays=True)
def jacobian(arm: FloatArray, joints: FloatArray, reach_m: float, out: FloatArray) -> None:
    """Geometric Jacobian of a point on the tool's z axis.

    Args:
        arm: ``(3,)``.
        joints: ``(6,)``.
        reach_m: How far from the tool's origin the point is; 0 for the tool itself.
        out: ``(6, 6)``, filled: velocity of the point (m/s), then angular velocity (rad/s), both in the base frame, per
            unit of joint velocity.
    """
    unit = np.empty((5, 3))
    axes(joints, unit)
    s6, c6 = math.sin(joints[5]), math.cos(joints[5])
    depth = joints[2] + arm[0] + arm[1]
    wrist = np.empty(3)  # from the wrist pitch axis to the point
    yaw = np.empty(3)  # from the wrist yaw axis to the point
    point = np.empty(3)
    for k in range(3):
        yaw[k] = reach_m * (c6 * unit[3, k] - s6 * unit[2, k])
        wrist[k] = arm[2] * unit[3, k] + yaw[k]
        point[k] = depth * unit[1, k] + wrist[k]
        out[3 + k, 0] = 0.0
        out[3 + k, 1] = unit[0, k]
        out[3 + k, 2] = 0.0
        out[3 + k, 3] = unit[1, k]
        out[3 + k, 4] = unit[2, k]
        out[3 + k, 5] = unit[4, k]
        out[k, 2] = unit[1, k]
    out[4, 0] = -1.0
    for column in range(JOINTS):
        if column == 2:
            continue
        lever = point if column < 4 else (wrist if column == 4 else yaw)
        x, y, z = out[3, column], out[4, column], out[5, column]
        out[0, column] = y * lever[2] - z * lever[1]
        out[1, column] = z * lever[0] - x * lever[2]
        out[2, column] = x * lever[1] - y * lever[0]


@compiled(makes_arrays=True)
def inverse(arm: FloatArray, pose: FloatArray, near: FloatArray, joints: FloatArray) -> None:
    """The joints that reach a pose, in closed form; unique where the wrist's joints are within ±pi/2.

    The shaft passes through the remote centre, so that the centre, seen from the tool, tells the wrist's two angles and
    the insertion.

    Args:
        arm: ``(3,)``.
        pose: ``(4, 4)`` T_base_tool.
        near: ``(6,)`` joints; the roll is given in the turn that is nearest to theirs.
        joints: ``(6,)``, filled; they may lie outside the limits.
    """
    u = v = w = 0.0  # the remote centre in frame 6
    for k in range(3):
        u += pose[k, 1] * pose[k, 3]
        v -= pose[k, 2] * pose[k, 3]
        w += pose[k, 0] * pose[k, 3]
    rho = math.hypot(u, v)
    joints[5] = math.atan2(-u, -v)
    joints[4] = math.atan2(w, rho - arm[2])
    joints[2] = math.hypot(rho - arm[2], w) - arm[0] - arm[1]
    s5, c5, s6, c6 = math.sin(joints[4]), math.cos(joints[4]), math.sin(joints[5]), math.cos(joints[5])
    x4, z4 = np.empty(3), np.empty(3)
    for k in range(3):
        along = -s6 * pose[k, 1] + c6 * pose[k, 2]
        yaw = -pose[k, 0]
        z4[k] = c5 * along - s5 * yaw
        x4[k] = s5 * along + c5 * yaw
    joints[0] = math.atan2(z4[0], -z4[2])
    joints[1] = math.asin(min(1.0, max(-1.0, -z4[1])))
    s1, c1, s2, c2 = math.sin(joints[0]), math.cos(joints[0]), math.sin(joints[1]), math.cos(joints[1])
    roll = math.atan2(-c1 * x4[0] - s1 * x4[2], -s1 * s2 * x4[0] - c2 * x4[1] + c1 * s2 * x4[2])
    joints[3] = roll + 2 * math.pi * round((near[3] - roll) / (2 * math.pi))


@compiled(makes_arrays=True)
def forward_all(arm: FloatArray, joints: FloatArray, poses: FloatArray) -> None:
    """:func:`forward` of ``(n, 6)`` joints into ``(n, 4, 4)`` poses."""
    for n in range(len(joints)):
        forward(arm, joints[n], poses[n])


@compiled(makes_arrays=True)
def inverse_all(arm: FloatArray, poses: FloatArray, near: FloatArray, joints: FloatArray) -> None:
    """:func:`inverse` of ``(n, 4, 4)`` poses, each near ``near`` (``(6,)``), into ``(n, 6)`` joints."""
    for n in range(len(joints)):
        inverse(arm, poses[n], near, joints[n])


@compiled(makes_arrays=True)
def newton(arm: FloatArray, pose: FloatArray, start: FloatArray, joints: FloatArray) -> bool:
    """The joints that reach a pose, by damped Newton steps as cisst takes them (robManipulator::InverseKinematics).

    ``dq = J' (J J' + lambda I)^-1 e`` with lambda = 1e-3 and the error e of position and half the sum of the axes'
    cross products, until a step is below 1e-12.

    Args:
        arm: ``(3,)``.
        pose: ``(4, 4)`` T_base_tool that is wanted.
        start: ``(6,)`` where the steps begin.
        joints: ``(6,)``, filled; angles are brought into ±pi.

    Returns:
        Whether the steps became small within 500.
    """
    joints[:] = start
    now = np.empty((4, 4))
    J = np.empty((6, 6))
    error = np.empty(6)
    for _ in range(ITERATIONS):
        forward(arm, joints, now)
        jacobian(arm, joints, 0.0, J)
        for k in range(3):
            error[k] = pose[k, 3] - now[k, 3]
            i, j = (k + 1) % 3, (k + 2) % 3
            error[3 + k] = 0.0
            for axis in range(3):
                error[3 + k] += 0.5 * (now[i, axis] * pose[j, axis] - now[j, axis] * pose[i, axis])
        gram = np.zeros((6, 6))
        for row in range(6):
            for column in range(6):
                for k in range(6):
                    gram[row, column] += J[row, k] * J[column, k]
            gram[row, row] += DAMPING
        solve(gram, error)
        size = 0.0
        for k in range(JOINTS):
            step = 0.0
            for row in range(6):
                step += J[row, k] * error[row]
            joints[k] += step
            size += step * step
        if size < TOLERANCE * TOLERANCE:
            for k in range(JOINTS):
                if k != 2:
                    joints[k] -= 2 * math.pi * round(joints[k] / (2 * math.pi))
            return True
    return False


@compiled
def solve(matrix: FloatArray, vector: FloatArray) -> bool:
    """Solve a symmetric positive definite system in place (Cholesky).

    Args:
        matrix: ``(n, n)``; its lower triangle is overwritten.
        vector: ``(n,)``, the right side; overwritten with the solution.

    Returns:
        False where the matrix is not positive definite; the vector is then of no use.
    """
    n = len(vector)
    for row in range(n):
        for column in range(row + 1):
            total = matrix[row, column]
            for k in range(column):
                total -= matrix[row, k] * matrix[column, k]
            if row > column:
                matrix[row, column] = total / matrix[column, column]
            elif total > 0.0:
                matrix[row, row] = math.sqrt(total)
            else:
                return False
    for row in range(n):
        for k in range(row):
            vector[row] -= matrix[row, k] * vector[k]
        vector[row] /= matrix[row, row]
    for row in range(n - 1, -1, -1):
        for k in range(row + 1, n):
            vector[row] -= matrix[k, row] * vector[k]
        vector[row] /= matrix[row, row]
    return True
