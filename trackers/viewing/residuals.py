"""What a good view is, as residuals, and their derivatives.

With the camera's position p and axes x, z, the feature f, the unit vector u from f to p, the feature's normal n and the
world's up w, all in the arm's base frame, the residuals, each over its tolerance, are

- gaze: ``z + u``,
- level: ``x . w``,
- distance: ``|p - f| - d``,
- direction: ``u - n``, with Huber's loss, so that a far direction pulls no harder than a near one,
- rules: how far p is past each of them (:mod:`surgbench.trackers.viewing.rules`), margins included; zero where it is
  not.

The article's costs (C_v = 1 - cos, under a Huber loss) are of fourth order in the angle, and so flat that its optimiser
stops degrees away; residuals in the angle itself are quadratic and Gauss-Newton steps converge in a few.
"""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.trackers.viewing.rules import CLOSEST_M, CONE, RULES, SPHERE, best_face, clearances
from surgbench.trackers.viewing.world import World
from surgbench.viewpoint.kinematics import forward, jacobian

VIEW = 5  # gaze, level, distance
TURN = 8  # and the direction
RESIDUALS = TURN + RULES
# Where the weights stand, one over the tolerances: rad, rad, m, rad; Huber's threshold in tolerances; rules, cone, m.
GAZE, LEVEL, DISTANCE, DIRECTION, HUBER, RULE, SOFT = range(7)


@compiled(makes_arrays=True, calls="viewpoint")
def view(
    world: World,
    joints: FloatArray,
    feature: FloatArray,
    weights: FloatArray,
    p: FloatArray,
    motion: FloatArray,
    r: FloatArray,
    J: FloatArray,
) -> float:
    """The first five residuals and their derivatives.

    Args:
        world: The arm.
        joints: ``(6,)``.
        feature: ``(3,)``.
        weights: ``(7,)``.
        p: ``(3,)``, filled: the camera.
        motion: ``(6, 6)``, filled: its geometric Jacobian.
        r: ``(5,)`` or more, filled.
        J: ``(5, 6)`` or more, filled.

    Returns:
        The distance.
    """
    pose = np.empty((4, 4))
    forward(world.arm, joints, pose)
    jacobian(world.arm, joints, world.reach_m, motion)
    u = np.empty(3)
    length = 0.0
    for k in range(3):
        p[k] = pose[k, 3] + world.reach_m * pose[k, 2]
        u[k] = p[k] - feature[k]
        length += u[k] * u[k]
    length = max(math.sqrt(length), CLOSEST_M)
    level = 0.0
    for k in range(3):
        u[k] /= length
        level += pose[k, 0] * world.up[k]
        r[k] = weights[GAZE] * (pose[k, 2] + u[k])
    r[3] = weights[LEVEL] * level
    r[4] = weights[DISTANCE] * (length - world.distance_m)
    for joint in range(6):
        along = u[0] * motion[0, joint] + u[1] * motion[1, joint] + u[2] * motion[2, joint]
        level = 0.0
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            turned_z = motion[3 + i, joint] * pose[j, 2] - motion[3 + j, joint] * pose[i, 2]
            turned_x = motion[3 + i, joint] * pose[j, 0] - motion[3 + j, joint] * pose[i, 0]
            J[k, joint] = weights[GAZE] * (turned_z + (motion[k, joint] - along * u[k]) / length)
            level += turned_x * world.up[k]
        J[3, joint] = weights[LEVEL] * level
        J[4, joint] = weights[DISTANCE] * along
    return float(length)


@compiled(makes_arrays=True, calls="viewpoint")
def residuals(
    world: World,
    joints: FloatArray,
    feature: FloatArray,
    normal: FloatArray,
    tool: FloatArray,
    weights: FloatArray,
    r: FloatArray,
    J: FloatArray,
) -> float:
    """All residuals at ``joints``, their derivatives, and half their squared sum (Huber's where that applies).

    Args:
        world: Arm and rules.
        joints: ``(6,)``.
        feature: ``(3,)``, base frame as all that follows.
        normal: ``(3,)`` its normal, a unit vector.
        tool: ``(2, 3)`` unit vector along the tool that holds it.
        weights: ``(7,)``.
        r: ``(15,)``, filled.
        J: ``(15, 6)``, filled.
    """
    p, motion = np.empty(3), np.empty((6, 6))
    c, G = np.empty(RULES), np.empty((RULES, 3))
    length = view(world, joints, feature, weights, p, motion, r, J)
    # The direction, its pull limited.
    miss = 0.0
    for k in range(3):
        r[VIEW + k] = weights[DIRECTION] * ((p[k] - feature[k]) / length - normal[k])
        miss += r[VIEW + k] ** 2
    miss = math.sqrt(miss)
    huber, cost = 1.0, 0.5 * miss * miss
    if miss > weights[HUBER]:
        huber, cost = math.sqrt(weights[HUBER] / miss), weights[HUBER] * (miss - 0.5 * weights[HUBER])
    for joint in range(6):
        along = 0.0
        for k in range(3):
            along += (p[k] - feature[k]) / length * motion[k, joint]
        for k in range(3):
            across = motion[k, joint] - along * (p[k] - feature[k]) / length
            J[VIEW + k, joint] = huber * weights[DIRECTION] * across / length
    clearances(world, p, feature, tool, best_face(world, p), c, G)
    for rule in range(RULES):
        row = TURN + rule
        short = -c[rule] + (world.margin_m if rule <= SPHERE else 0.0)
        weight = weights[SOFT] if rule == CONE else weights[RULE]
        r[row] = weight * max(short, 0.0)
        for joint in range(6):
            J[row, joint] = 0.0
            if short > 0.0:
                for k in range(3):
                    J[row, joint] -= weight * G[rule, k] * motion[k, joint]
    for k in range(VIEW, TURN):
        r[k] *= huber
    for row in range(RESIDUALS):
        if row < VIEW or row >= TURN:
            cost += 0.5 * r[row] * r[row]
    return cost
