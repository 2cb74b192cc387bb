"""What a course is judged by, and how that changes with the joints, for every step at once."""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.viewpoint.kinematics import forward, jacobian

TERMS = 8
RULES = 4
FLOOR, ZONE, PROXIMITY, SIDE = range(RULES)
# Closer to the camera than this, the feature has no direction.
CLOSEST_M = 1e-6


@compiled(makes_arrays=True, calls="viewpoint")
def judge(
    arm: FloatArray,
    reach_m: float,
    joints: FloatArray,
    wanted: FloatArray,
    distance_m: float,
    weights: FloatArray,
    up: FloatArray,
    r: FloatArray,
    J: FloatArray,
) -> None:
    """The terms of ``view_cost`` (:mod:`surgbench.viewpoint.scores`) and their derivatives.

    Angles are those of their sines, which differ in the third order: ``z - c / |c|`` of the view, ``x . w`` of level.

    Args:
        arm: ``(3,)`` of the kinematics.
        reach_m: From tool to camera.
        joints: ``(T, 6)``.
        wanted: ``(T, 2, 3)`` feature and naive place, base frame; NaN where nothing is wanted.
        distance_m: d_t.
        weights: ``(4,)`` one over the tolerances: view (rad), distance (m), level (rad), place (m).
        up: ``(3,)`` the world's, base frame.
        r: ``(T, 8)``, filled: view, level, distance, place.
        J: ``(T, 8, 6)``, filled.
    """
    pose, motion = np.empty((4, 4)), np.empty((6, 6))
    c, v, w = np.empty(3), np.empty(3), np.empty(3)
    for step in range(len(joints)):
        if not math.isfinite(wanted[step, 0, 0]):
            r[step] = 0.0
            J[step] = 0.0
            continue
        forward(arm, joints[step], pose)
        jacobian(arm, joints[step], reach_m, motion)
        length = 0.0
        for k in range(3):
            place = pose[k, 3] + reach_m * pose[k, 2]
            r[step, 5 + k] = weights[3] * (place - wanted[step, 1, k])
            c[k] = wanted[step, 0, k] - place
            length += c[k] * c[k]
        length = max(math.sqrt(length), CLOSEST_M)
        level = 0.0
        for k in range(3):
            c[k] /= length
            level += pose[k, 0] * up[k]
            r[step, k] = weights[0] * (pose[k, 2] - c[k])
        r[step, 3] = weights[2] * level
        r[step, 4] = weights[1] * (length - distance_m)
        for joint in range(6):
            along = 0.0
            for k in range(3):
                v[k], w[k] = motion[k, joint], motion[3 + k, joint]
                along += c[k] * v[k]
            J[step, 3, joint] = 0.0
            for k in range(3):
                i, j = (k + 1) % 3, (k + 2) % 3
                J[step, k, joint] = weights[0] * (
                    w[i] * pose[j, 2] - w[j] * pose[i, 2] + (v[k] - along * c[k]) / length
                )
                J[step, 3, joint] += weights[2] * up[k] * (w[i] * pose[j, 0] - w[j] * pose[i, 0])
                J[step, 5 + k, joint] = weights[3] * v[k]
            J[step, 4, joint] = -weights[1] * along


@compiled(makes_arrays=True, calls="viewpoint")
def clearances(
    arm: FloatArray,
    reach_m: float,
    joints: FloatArray,
    feature: FloatArray,
    rules: FloatArray,
    faces: FloatArray,
    clear: FloatArray,
    J: FloatArray,
) -> None:
    """How far the camera is from breaking each rule, and how that changes.

    Args:
        arm: ``(3,)`` of the kinematics.
        reach_m: From tool to camera.
        joints: ``(T, 6)``.
        feature: ``(T, 3)`` base frame, at the moment of the joints; NaN where it was not measured.
        rules: ``(2, 4)``: the floor's normal and offset; the preferred side and the least distance.
        faces: ``(n, 4)`` the zone's, inwards.
        clear: ``(T, 4)``, filled: metres above the floor, out of the zone, beyond the least distance; and of the side
            the camera's reach times the sine of the angle on its right side, so that it is a length, too.
        J: ``(T, 4, 6)``, filled.
    """
    pose, motion = np.empty((4, 4)), np.empty((6, 6))
    p, c = np.empty(3), np.empty(3)
    for step in range(len(joints)):
        forward(arm, joints[step], pose)
        jacobian(arm, joints[step], reach_m, motion)
        floor, side, length = -rules[0, 3], 0.0, 0.0
        for k in range(3):
            p[k] = pose[k, 3] + reach_m * pose[k, 2]
            floor += rules[0, k] * p[k]
            side -= rules[1, k] * pose[k, 1]
            c[k] = p[k] - feature[step, k]
            length += c[k] * c[k]
        length = max(math.sqrt(length), CLOSEST_M)
        seen = math.isfinite(length)
        nearest, depth = 0, math.inf
        for face in range(len(faces)):
            behind = -faces[face, 3]
            for k in range(3):
                behind += faces[face, k] * p[k]
            if behind < depth:
                nearest, depth = face, behind
        clear[step, FLOOR] = floor
        clear[step, ZONE] = -depth
        clear[step, PROXIMITY] = length - rules[1, 3] if seen else math.inf
        clear[step, SIDE] = reach_m * side
        for joint in range(6):
            for rule in range(RULES):
                J[step, rule, joint] = 0.0
            for k in range(3):
                i, j = (k + 1) % 3, (k + 2) % 3
                v = motion[k, joint]
                turned = motion[3 + i, joint] * pose[j, 1] - motion[3 + j, joint] * pose[i, 1]
                J[step, FLOOR, joint] += rules[0, k] * v
                J[step, ZONE, joint] -= faces[nearest, k] * v
                if seen:
                    J[step, PROXIMITY, joint] += c[k] / length * v
                J[step, SIDE, joint] -= reach_m * rules[1, k] * turned
