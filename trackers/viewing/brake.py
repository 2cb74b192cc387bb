"""The last word: a step is taken only if the arm could be brought to rest after it without breaking a rule.

Floor and zone stand still. If the joints, braking as hard as each can from where the step leaves them, stay out of
both until they rest, then braking is the way out in the next step, too; and so on: from a start that is within the
rules no command ever leaves them, whatever the feature does. Both the set point and the joints that lag behind it are
looked at, at every step of the braking.
"""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.trackers.viewing.look import place
from surgbench.trackers.viewing.rules import best_face
from surgbench.trackers.viewing.world import ACCELERATION, World

# Kept from floor and zone where the present place has as much, and the longest way to rest.
SPARE_M = 2e-4
LONGEST = 400
SETTLED = 1e-9


@compiled
def standing(world: World, p: FloatArray) -> float:
    """How far a place is from breaking the rules that stand still, floor and zone; negative beyond."""
    floor = -world.floor[3]
    face = best_face(world, p)
    zone = world.faces[face, 3]
    for k in range(3):
        floor += world.floor[k] * p[k]
        zone -= world.faces[face, k] * p[k]
    return float(min(floor, zone))


@compiled(makes_arrays=True, calls="viewpoint")
def least(world: World, setpoint: FloatArray, joints: FloatArray, target: FloatArray, enough_m: float) -> float:
    """The smallest clearance of floor and zone while a step is taken and the arm then brakes.

    Args:
        world: Arm and rules.
        setpoint: ``(6,)`` before the step.
        joints: ``(6,)`` where the arm is then.
        target: ``(6,)`` set point after the step.
        enough_m: Below this the answer is no longer of interest, and may be of any moment.
    """
    dt = world.dt_s
    lag = world.lag_s / dt
    decay = math.exp(-1.0 / lag) if lag > 1e-6 else 0.0
    now, there, after, speed, p = setpoint.copy(), joints.copy(), target.copy(), np.empty(6), np.empty(3)
    for k in range(6):
        speed[k] = (target[k] - setpoint[k]) / dt
    smallest = math.inf
    for _ in range(LONGEST):
        moving = behind = 0.0
        for k in range(6):
            trail = (after[k] - now[k]) * lag
            there[k] = after[k] - trail + (there[k] - now[k] + trail) * decay
            now[k] = after[k]
            moving = max(moving, abs(speed[k]))
            behind = max(behind, abs(there[k] - now[k]))
            slower = max(abs(speed[k]) - world.limits[ACCELERATION, k] * dt, 0.0)
            speed[k] = math.copysign(slower, speed[k])
            after[k] = min(world.limits[1, k], max(world.limits[0, k], now[k] + speed[k] * dt))
        place(world, now, p)
        smallest = min(smallest, standing(world, p))
        place(world, there, p)
        smallest = min(smallest, standing(world, p))
        if smallest < enough_m or (moving < SETTLED and behind < 1e-6):
            break
    return smallest


@compiled(makes_arrays=True, calls="viewpoint")
def secure(world: World, setpoint: FloatArray, velocity: FloatArray, joints: FloatArray, target: FloatArray) -> bool:
    """Bring a step so near to braking that the arm can be brought to rest after it within floor and zone.

    Args:
        world: Arm and rules.
        setpoint: ``(6,)``.
        velocity: ``(6,)`` of it.
        joints: ``(6,)`` measured.
        target: ``(6,)`` the step's end, changed where that must be.

    Returns:
        Whether it had to be.
    """
    p = np.empty(3)
    place(world, setpoint, p)
    enough = standing(world, p)
    place(world, joints, p)
    enough = min(enough, standing(world, p), SPARE_M) - 1e-9
    if least(world, setpoint, joints, target, enough) >= enough:
        return False
    braked, wanted = np.empty(6), target.copy()
    for k in range(6):
        slower = max(abs(velocity[k]) - world.limits[ACCELERATION, k] * world.dt_s, 0.0)
        stop = setpoint[k] + math.copysign(slower, velocity[k]) * world.dt_s
        braked[k] = min(world.limits[1, k], max(world.limits[0, k], stop))
    share = 1.0
    for _ in range(4):
        share = share / 2 if share > 0.2 else 0.0
        for k in range(6):
            target[k] = braked[k] + share * (wanted[k] - braked[k])
        if least(world, setpoint, joints, target, enough) >= enough:
            break
    return True
