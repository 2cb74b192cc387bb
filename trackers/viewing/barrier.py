"""What every step must keep: barriers that respect how far the arm needs to brake.

A rule with the clearance h, m of it to be kept, may come closer at a rate of

    w = sqrt(a^2 dt^2 + 2 a (h - m)) - a dt

and no faster: from there the rate can be brought to zero in whole steps before m is used up, if the arm can change it
by a (its joints' accelerations through the gradient of h, of which a share is counted on, for rules and bends compete
for them). That is a discrete-time control barrier function. The feature's own motion is in h, as predicted for the end
of the step. Where m is used up already, h must grow.
"""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.trackers.viewing.quadratic import solve_bounded
from surgbench.trackers.viewing.residuals import VIEW, view
from surgbench.trackers.viewing.rules import RULES, best_face, clearances
from surgbench.trackers.viewing.world import ACCELERATION, World
from surgbench.viewpoint.kinematics import forward, jacobian

# Floor, zone, sphere, and the camera's y axis on its side.
BARRIERS = 4
WAY_SIDE = 3
# Of the slow joints' accelerations; and how fast a margin that is used up is won back.
SHARE = 0.5
RECOVERY_S, RECOVERY_M_S = 0.1, 0.03
# The face of the zone is that which the camera is beyond now and where it would be so much later.
AHEAD_S = 0.15
# Stiffness of a barrier, in 1 / m^2; what a joint's deviation costs by itself, in 1 / rad^2 and 1 / m^2.
STIFF, LAZY = 1e12, 1.0
PASSES = 3


@compiled(makes_arrays=True, calls="viewpoint")
def barriers(
    world: World, joints: FloatArray, feature: FloatArray, tool: FloatArray, face: int, h: FloatArray, g: FloatArray
) -> None:
    """Clearances of the four rules that steps keep, metres less the guard, and their slopes by the joints.

    Args:
        world: Arm and rules.
        joints: ``(6,)``.
        feature: ``(3,)`` at the same moment.
        tool: ``(2, 3)``.
        face: Of the zone.
        h: ``(4,)``, filled.
        g: ``(4, 6)``, filled.
    """
    pose, motion, p = np.empty((4, 4)), np.empty((6, 6)), np.empty(3)
    c, G = np.empty(RULES), np.empty((RULES, 3))
    forward(world.arm, joints, pose)
    jacobian(world.arm, joints, world.reach_m, motion)
    across = 0.0
    for k in range(3):
        p[k] = pose[k, 3] + world.reach_m * pose[k, 2]
        across += pose[k, 1] * world.side[k]
    clearances(world, p, feature, tool, face, c, G)
    for rule in range(WAY_SIDE):
        h[rule] = c[rule] - world.guard_m
        for joint in range(6):
            g[rule, joint] = 0.0
            for k in range(3):
                g[rule, joint] += G[rule, k] * motion[k, joint]
    sided = world.sine[1] > -1.0
    h[WAY_SIDE] = world.distance_m * (-across - world.sine[2]) if sided else 1.0
    for joint in range(6):
        turned = 0.0
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            turned += (motion[3 + i, joint] * pose[j, 1] - motion[3 + j, joint] * pose[i, 1]) * world.side[k]
        g[WAY_SIDE, joint] = -world.distance_m * turned if sided else 0.0


@compiled(makes_arrays=True, calls="viewpoint")
def choose_face(world: World, joints: FloatArray, velocity: FloatArray) -> int:
    """The face of the zone that the camera stays outside of: where it will be soon, if it is outside of it now."""
    pose, motion = np.empty((4, 4)), np.empty((6, 6))
    p, later = np.empty(3), np.empty(3)
    forward(world.arm, joints, pose)
    jacobian(world.arm, joints, world.reach_m, motion)
    for k in range(3):
        p[k] = pose[k, 3] + world.reach_m * pose[k, 2]
        later[k] = p[k]
        for joint in range(6):
            later[k] += AHEAD_S * motion[k, joint] * velocity[joint]
    soon = best_face(world, later)
    out = world.faces[soon, 3]
    for k in range(3):
        out -= world.faces[soon, k] * p[k]
    return int(soon if out >= world.guard_m else best_face(world, p))


@compiled(makes_arrays=True, calls="viewpoint")
def guard(
    world: World,
    setpoint: FloatArray,
    velocity: FloatArray,
    feature: FloatArray,
    later: FloatArray,
    tool: FloatArray,
    box: FloatArray,
    weights: FloatArray,
    turn: float,
    wanted: FloatArray,
) -> bool:
    """Bring a step within the barriers, the view changed as little as may be.

    Args:
        world: Arm and rules.
        setpoint: ``(6,)``.
        velocity: ``(6,)`` of it.
        feature: ``(3,)`` when the joints are at the set point.
        later: ``(3,)`` when they are where the step ends.
        tool: ``(2, 3)``.
        box: ``(2, 6)`` what can be reached.
        weights: ``(7,)`` of the view's residuals.
        turn: One over the tolerance of the camera's place, 1/m.
        wanted: ``(6,)`` the step's end, within the box; changed where that must be.

    Returns:
        Whether it had to be.
    """
    h, g, floor = np.empty(BARRIERS), np.empty((BARRIERS, 6)), np.empty(BARRIERS)
    face = choose_face(world, setpoint, velocity)
    barriers(world, setpoint, feature, tool, face, h, g)
    dt = world.dt_s
    for rule in range(BARRIERS):
        able = 0.0
        for joint in range(6 if rule == WAY_SIDE else 3):
            able += SHARE * abs(g[rule, joint]) * world.limits[ACCELERATION, joint]
        if h[rule] > 0.0:
            floor[rule] = h[rule] - (math.sqrt(able * able * dt * dt + 2 * able * h[rule]) - able * dt) * dt
        else:
            floor[rule] = h[rule] + min(-h[rule] / RECOVERY_S, RECOVERY_M_S) * dt
    x, first = wanted.copy(), wanted.copy()
    p, motion, r, J = np.empty(3), np.empty((6, 6)), np.empty(VIEW), np.empty((VIEW, 6))
    H, needed = np.empty((6, 6)), np.empty(BARRIERS)
    changed = False
    for _ in range(PASSES):
        barriers(world, x, later, tool, face, h, g)
        short = 0.0
        for rule in range(BARRIERS):
            short = max(short, floor[rule] - h[rule])
        if short < 1e-7:
            break
        if not changed:
            view(world, x, later, weights, p, motion, r, J)
            for i in range(6):
                for j in range(6):
                    H[i, j] = LAZY if i == j else 0.0
                    for k in range(VIEW):
                        H[i, j] += J[k, i] * J[k, j]
                    for k in range(3):
                        H[i, j] += turn * turn * motion[k, i] * motion[k, j]
        changed = True
        for rule in range(BARRIERS):
            needed[rule] = floor[rule] - h[rule]
            for joint in range(6):
                needed[rule] += g[rule, joint] * x[joint]
        solve_bounded(H, first, g, needed, STIFF, box[0], box[1], x)
    wanted[:] = x
    return changed
