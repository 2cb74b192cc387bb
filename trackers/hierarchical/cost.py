"""The objective of AutoCam's constrained inverse kinematics (eq. 2, 4, 5 and Table IV) and its gradient.

With p and the axes x, z of the camera, f the feature, c = f - p, and w the world's up,

    f(q) = w1 h(C_ps, d1) + w2 h(C_or, d2) + w3 h(C_d, d3)
    C_ps = |p - p_desired|
    C_or = w4 / 2 (1 - z.c / |c|) + w5 |x.w|
    C_d  = |c| - d_t

and h of Huber: ``x^2 / 2`` up to d, beyond it ``d (|x| - d / 2)``.
"""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.viewpoint.kinematics import forward, jacobian

SMALLEST_M = 1e-12
# Of ``settings``.
W1, W2, W3, W4, W5, D1, D2, D3, DISTANCE, LEVER = range(10)


@compiled
def huber(x: float, delta: float) -> float:
    """Huber's loss (appendix A)."""
    return 0.5 * x * x if abs(x) <= delta else delta * (abs(x) - 0.5 * delta)


@compiled
def slope(x: float, delta: float) -> float:
    """The derivative of :func:`huber`."""
    return min(delta, max(-delta, x))


@compiled(makes_arrays=True, calls="viewpoint")
def cost(
    arm: FloatArray, reach_m: float, points: FloatArray, settings: FloatArray, joints: FloatArray, gradient: FloatArray
) -> float:
    """The objective, everything in the frame of the arm's base.

    Where it has no derivative (the desired position met, the camera level, the feature in the camera) the gradient is
    that of the other terms.

    Args:
        arm: ``(3,)`` of the kinematics.
        reach_m: From tool to camera.
        points: ``(3, 3)`` the feature, the desired position, and the world's up.
        settings: ``(10,)`` w1 to w5, d1 to d3, d_t, and how far behind the camera, along its z, the point lies whose
            position is desired: 0 for the camera, ``reach_m`` for the tool.
        joints: ``(6,)``.
        gradient: ``(6,)``, filled; or of another length, and left alone.

    Returns:
        f(q).
    """
    pose = np.empty((4, 4))
    forward(arm, joints, pose)
    off, ray = np.empty(3), np.empty(3)
    place = distance = along = level = 0.0
    for k in range(3):
        camera = pose[k, 3] + reach_m * pose[k, 2]
        off[k] = camera - settings[LEVER] * pose[k, 2] - points[1, k]
        ray[k] = points[0, k] - camera
        place += off[k] ** 2
        distance += ray[k] ** 2
        level += pose[k, 0] * points[2, k]
    place, distance = math.sqrt(place), math.sqrt(distance)
    if distance > SMALLEST_M:
        for k in range(3):
            ray[k] /= distance
            along += pose[k, 2] * ray[k]
    turned = 0.5 * settings[W4] * (1.0 - along) + settings[W5] * abs(level)
    far = distance - settings[DISTANCE]
    value: float = (
        settings[W1] * huber(place, settings[D1])
        + settings[W2] * huber(turned, settings[D2])
        + settings[W3] * huber(far, settings[D3])
    )
    if len(gradient) != 6:
        return value
    by_place = settings[W1] * slope(place, settings[D1]) / place if place > SMALLEST_M else 0.0
    by_turn = settings[W2] * slope(turned, settings[D2])
    by_far = settings[W3] * slope(far, settings[D3])
    by_axis = -0.5 * settings[W4] * by_turn  # of z.c / |c|
    by_level = settings[W5] * by_turn * (1.0 if level > 0 else (-1.0 if level < 0 else 0.0))
    push, turn = np.empty(3), np.empty(3)  # by the camera's position, by its rotation
    for k in range(3):
        push[k] = by_place * off[k]
        if distance > SMALLEST_M:
            # A step of the camera turns the ray by minus its part across the ray.
            push[k] -= by_far * ray[k] + by_axis * (pose[k, 2] - along * ray[k]) / distance
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        turn[k] = (
            by_axis * (pose[i, 2] * ray[j] - pose[j, 2] * ray[i])
            + by_level * (pose[i, 0] * points[2, j] - pose[j, 0] * points[2, i])
            - settings[LEVER] * by_place * (pose[i, 2] * off[j] - pose[j, 2] * off[i])
        )
    J = np.empty((6, 6))
    jacobian(arm, joints, reach_m, J)
    for joint in range(6):
        gradient[joint] = 0.0
        for k in range(3):
            gradient[joint] += push[k] * J[k, joint] + turn[k] * J[3 + k, joint]
    return value


@compiled(makes_arrays=True, calls="viewpoint")
def evaluate(
    arm: FloatArray,
    reach_m: float,
    points: FloatArray,
    settings: FloatArray,
    best: FloatArray,
    joints: FloatArray,
    gradient: FloatArray,
) -> float:
    """:func:`cost`, which keeps the best that it was asked for: ``best``, ``(8,)``: joints, cost, evaluations."""
    value: float = cost(arm, reach_m, points, settings, joints, gradient)
    best[7] += 1.0
    if value < best[6]:
        best[6] = value
        best[:6] = joints
    return value
