"""How fast the camera goes along its way: so that every joint can follow, and stop at the end."""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.trackers.viewing.look import look_nearly
from surgbench.trackers.viewing.way import arc
from surgbench.trackers.viewing.world import ACCELERATION, VELOCITY, World

# Places ahead at which the joints are looked at, and how far apart: as far as one comes in this time, within bounds.
AHEAD = 5
AHEAD_S, LEAST_M, MOST_M = 0.1, 1e-3, 1e-2


@compiled(makes_arrays=True, calls="viewpoint")
def pace(
    world: World,
    feature: FloatArray,
    start: FloatArray,
    start_m: float,
    end: FloatArray,
    end_m: float,
    further_m: float,
    near: FloatArray,
    speed_m_s: float,
    share: float,
    patience: float,
    tool: FloatArray,
    weights: FloatArray,
    iterations: int,
    along: FloatArray,
) -> float:
    """How far along an arc the camera should be after one step.

    The joints' first and second derivatives along the way come from the inverse kinematics at places ahead. No joint
    may need more than a share of its acceleration for going faster or slower, nor more than another for the way's
    bends, nor more than its velocity; and from every place ahead the camera must have slowed down to what is possible
    there.

    Args:
        world: The arm.
        feature: ``(3,)``.
        start: ``(3,)`` unit vector from the feature to the camera.
        start_m: Distance there.
        end: ``(3,)`` where the arc ends.
        end_m: Distance there.
        further_m: The way goes on so far after that.
        near: ``(6,)`` joints at the start.
        speed_m_s: Along the way, now.
        share: Of the accelerations.
        patience: Share of the speed, where roll and wrist are behind.
        tool: ``(2, 3)``.
        weights: ``(7,)``, for places that the joints cannot quite reach, as what follows.
        iterations: Of the fit there.
        along: ``(2,)``, filled: metres along the way after the step, and the whole arc's length.

    Returns:
        The speed after the step.
    """
    across, u, p = np.empty(3), np.empty(3), np.empty(3)
    q, before, rate, last = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    angle = arc(start, end, across)
    length = math.hypot(world.distance_m * angle, end_m - start_m)
    along[1] = length
    dt = world.dt_s
    if length + further_m < 1e-9:
        along[0] = length
        return 0.0
    apart = min(max(speed_m_s * AHEAD_S, LEAST_M), MOST_M)
    hardest = math.inf  # acceleration along the way
    before[:] = near
    bound = np.full(AHEAD, math.inf)
    for n in range(AHEAD + 1):
        # Beyond the end the arc goes on: what matters there is how the joints bend.
        done = n * apart / max(length, LEAST_M) if length > LEAST_M else n * apart / LEAST_M
        turned = done * angle if length > LEAST_M else n * apart / world.distance_m
        for k in range(3):
            u[k] = math.cos(turned) * start[k] + math.sin(turned) * across[k]
        distance_m = start_m + min(done, 1.0) * (end_m - start_m)
        look_nearly(world, feature, u, distance_m, tool, weights, iterations, before, p, q)
        if n:
            for joint in range(6):
                rate[joint] = (q[joint] - before[joint]) / apart
                steep = abs(rate[joint])
                if steep > 1e-9:
                    hardest = min(hardest, share * world.limits[ACCELERATION, joint] / steep)
                    bound[n - 1] = min(bound[n - 1], 0.9 * world.limits[VELOCITY, joint] / steep)
                if n > 1:
                    bend = abs(rate[joint] - last[joint]) / apart
                    if bend > 1e-9:
                        most = math.sqrt(share * world.limits[ACCELERATION, joint] / bend)
                        bound[n - 1] = min(bound[n - 1], most)
                        if n == 2:
                            bound[0] = min(bound[0], most)
            last[:] = rate
        before[:] = q
    if hardest == math.inf:
        along[0] = length
        return 0.0
    unit = hardest * dt / 2
    fastest = math.sqrt(unit * unit + 2 * hardest * (length + further_m)) - unit
    for n in range(AHEAD):
        fastest = min(fastest, math.sqrt(bound[n] ** 2 + 2 * hardest * max(n * apart - speed_m_s * dt, 0.0)))
    fastest = max(min(fastest * patience, speed_m_s + hardest * dt), 0.0)
    along[0] = min(fastest * dt, length)
    return float(fastest)
