"""The view and the rules about some joints, to first order, in the frame of the arm's base.

With the camera's position p and axes x, z, the feature f, c = f - p, and the world's up w:

- errors of the view: gaze ``z - c / |c|`` (rows 0 to 2), level ``x . w`` (3), distance ``|c| - d_t`` (4), place
  ``p - p_wanted`` (5 to 7);
- depths beyond the rules, metres, negative where they are kept: floor, no-go zone (behind its nearest face), proximity,
  side (of the feature's plane across the preferred side).
"""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.viewpoint.kinematics import forward, jacobian

ERRORS = 8
GAZE, LEVEL, DISTANCE, PLACE = slice(0, 3), slice(3, 4), slice(4, 5), slice(5, 8)
RULES = 4
FLOOR, ZONE, PROXIMITY, SIDE = range(RULES)
# Closer to the camera than this, the feature has no direction.
CLOSEST_M = 1e-6


@compiled(makes_arrays=True, calls="viewpoint")
def linearise(
    arm: FloatArray,
    reach_m: float,
    joints: FloatArray,
    feature: FloatArray,
    wanted: FloatArray,
    distance_m: float,
    rules: FloatArray,
    faces: FloatArray,
    error: FloatArray,
    J: FloatArray,
    depth: FloatArray,
    slope: FloatArray,
) -> None:
    """Errors and depths at some joints, and how they change with these.

    Args:
        arm: ``(3,)`` of the kinematics.
        reach_m: From tool to camera.
        joints: ``(6,)``.
        feature: ``(3,)``.
        wanted: ``(3,)`` place of the camera.
        distance_m: d_t.
        rules: ``(3, 4)``: the world's up and the proximity; the floor's normal and offset; the preferred side and an
            unused number.
        faces: ``(n, 4)`` inward normals and offsets of the zone.
        error: ``(8,)``, filled.
        J: ``(8, 6)``, filled with the errors' derivatives.
        depth: ``(4,)``, filled.
        slope: ``(4, 6)``, filled with the depths' derivatives.
    """
    pose, motion, p, c = np.empty((4, 4)), np.empty((6, 6)), np.empty(3), np.empty(3)
    forward(arm, joints, pose)
    jacobian(arm, joints, reach_m, motion)
    length = 0.0
    for k in range(3):
        p[k] = pose[k, 3] + reach_m * pose[k, 2]
        c[k] = feature[k] - p[k]
        length += c[k] * c[k]
    length = max(math.sqrt(length), CLOSEST_M)
    nearest, behind = 0, math.inf
    for face in range(len(faces)):
        now = faces[face, 0] * p[0] + faces[face, 1] * p[1] + faces[face, 2] * p[2] - faces[face, 3]
        if now < behind:
            nearest, behind = face, now
    error[3], depth[0], depth[3] = 0.0, rules[1, 3], 0.0
    for k in range(3):
        depth[0] -= rules[1, k] * p[k]
        depth[3] += rules[2, k] * c[k]
        c[k] /= length
        error[k] = pose[k, 2] - c[k]
        error[3] += pose[k, 0] * rules[0, k]
        error[5 + k] = p[k] - wanted[k]
    error[4] = length - distance_m
    depth[1], depth[2] = behind, rules[0, 3] - length
    for joint in range(6):
        along = 0.0
        for k in range(3):
            along += c[k] * motion[k, joint]
        J[3, joint] = slope[0, joint] = slope[1, joint] = slope[3, joint] = 0.0
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            moved = motion[k, joint]
            turned_z = motion[3 + i, joint] * pose[j, 2] - motion[3 + j, joint] * pose[i, 2]
            turned_x = motion[3 + i, joint] * pose[j, 0] - motion[3 + j, joint] * pose[i, 0]
            J[k, joint] = turned_z + (moved - along * c[k]) / length
            J[3, joint] += turned_x * rules[0, k]
            J[5 + k, joint] = moved
            slope[0, joint] -= rules[1, k] * moved
            slope[1, joint] += faces[nearest, k] * moved
            slope[3, joint] -= rules[2, k] * moved
        J[4, joint] = -along
        slope[2, joint] = along
