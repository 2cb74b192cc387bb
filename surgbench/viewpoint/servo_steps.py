"""What a servo does within a step, compiled: joints that follow their set points, and what a joint can do in time.

``limits`` is ``(4, 6)``: lower, upper, largest velocity, largest acceleration. ``timing`` is ``(3,)``: seconds between
commands, the joints' time constant, and what is left of a joint's lag after that time, ``exp(-dt / lag)``. ``state`` is
``(3, 6)``: set point, its velocity, joints; the next one goes into ``out``, which must be another array.
"""

from __future__ import annotations

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray

JOINTS = 6
# Of the limits, for what rounding adds.
SLACK = 1 + 1e-9
SETPOINT, VELOCITY, MEASURED = range(3)
LOWER, UPPER, FASTEST, ACCELERATION = range(4)
DT_S, LAG_S, DECAY = range(3)


@compiled
def clip(value: float, lower: float, upper: float) -> float:
    """A number within limits."""
    return min(max(value, lower), upper)


@compiled
def clip_all(limits: FloatArray, joints: FloatArray, within: FloatArray) -> float:
    """Joints (``(6,)``) within the limits, into ``within``; returns by how much the farthest one was outside."""
    farthest = 0.0
    for j in range(JOINTS):
        within[j] = clip(joints[j], limits[LOWER, j], limits[UPPER, j])
        farthest = max(farthest, abs(within[j] - joints[j]))
    return farthest


@compiled
def can_stop(limits: FloatArray, joint: int, setpoint: float, velocity: float) -> bool:
    """Whether a joint comes to rest within its limits."""
    rest = setpoint + velocity * abs(velocity) / (2 * limits[ACCELERATION, joint])
    return bool(rest <= limits[UPPER, joint] and rest >= limits[LOWER, joint])


@compiled
def slower(limits: FloatArray, joint: int, velocity: float, dt_s: float) -> float:
    """A joint's velocity after one step of braking."""
    speed = max(abs(velocity) - limits[ACCELERATION, joint] * dt_s, 0.0)
    return float(speed if velocity > 0 else -speed)


@compiled
def rest(limits: FloatArray, state: FloatArray, goal: FloatArray) -> None:
    """Where the joints come to rest if they brake as hard as they can, within the limits, into ``goal`` (``(6,)``)."""
    for j in range(JOINTS):
        velocity = state[VELOCITY, j]
        stop = state[SETPOINT, j] + velocity * abs(velocity) / (2 * limits[ACCELERATION, j])
        goal[j] = clip(stop, limits[LOWER, j], limits[UPPER, j])


@compiled
def follow(
    limits: FloatArray, timing: FloatArray, state: FloatArray, j: int, to: float, velocity: float, out: FloatArray
) -> None:
    """A joint's next set point, and where the joint is then: it follows while the set point moves there evenly."""
    dt_s, fastest = timing[DT_S], limits[FASTEST, j]
    clipped = clip(to, limits[LOWER, j], limits[UPPER, j])
    trail = (clipped - state[SETPOINT, j]) / dt_s * timing[LAG_S]  # how far it is behind in the long run
    out[MEASURED, j] = clipped - trail + (state[MEASURED, j] - state[SETPOINT, j] + trail) * timing[DECAY]
    out[SETPOINT, j] = clipped
    out[VELOCITY, j] = clip(velocity if clipped == to else 0.0, -fastest, fastest)


@compiled
def follow_all(limits: FloatArray, timing: FloatArray, state: FloatArray, planned: FloatArray, out: FloatArray) -> None:
    """:func:`follow` of all joints; ``planned`` is ``(2, 6)``, set points and velocities."""
    for j in range(JOINTS):
        follow(limits, timing, state, j, planned[0, j], planned[1, j], out)


@compiled
def brake_all(limits: FloatArray, timing: FloatArray, state: FloatArray, planned: FloatArray) -> None:
    """Set points and velocities after one step of braking, into ``planned`` (``(2, 6)``)."""
    for j in range(JOINTS):
        velocity = slower(limits, j, state[VELOCITY, j], timing[DT_S])
        planned[0, j] = state[SETPOINT, j] + (state[VELOCITY, j] + velocity) / 2 * timing[DT_S]
        planned[1, j] = velocity


@compiled
def possible(limits: FloatArray, timing: FloatArray, state: FloatArray, j: int, target: float) -> bool:
    """Whether a joint can be at ``target``, within its limits, after this step, and be stopped within them then."""
    dt_s = timing[DT_S]
    needed = (target - state[SETPOINT, j]) / dt_s
    return bool(
        abs(needed) <= limits[FASTEST, j] * SLACK
        and abs(needed - state[VELOCITY, j]) <= limits[ACCELERATION, j] * dt_s * SLACK
        and can_stop(limits, j, target, needed)
    )


@compiled
def servo(
    limits: FloatArray,
    timing: FloatArray,
    state: FloatArray,
    target: FloatArray,
    velocity: FloatArray,
    goal: FloatArray,
    out: FloatArray,
) -> bool:
    """Be at ``target`` after this step, if all joints can.

    Args:
        limits: See above.
        timing: See above.
        state: See above.
        target: ``(6,)``, clipped to the limits.
        velocity: ``(6,)`` wanted there.
        goal: ``(2, 6)``, filled with what is gone to where it is not possible: the target within the limits, and the
            velocity there, none where a joint could not be stopped any more.
        out: Filled where it is possible.

    Returns:
        Whether it is.
    """
    dt_s, every = timing[DT_S], True
    for j in range(JOINTS):
        goal[0, j] = clip(target[j], limits[LOWER, j], limits[UPPER, j])
        every = every and possible(limits, timing, state, j, goal[0, j])
    for j in range(JOINTS):
        if every:
            follow(limits, timing, state, j, goal[0, j], (goal[0, j] - state[SETPOINT, j]) / dt_s, out)
        else:
            wanted = clip(velocity[j], -limits[FASTEST, j], limits[FASTEST, j])
            goal[1, j] = wanted if can_stop(limits, j, goal[0, j] + wanted * dt_s, wanted) else 0.0
    return every


@compiled
def servo_planned(
    limits: FloatArray, timing: FloatArray, state: FloatArray, goal: FloatArray, planned: FloatArray, out: FloatArray
) -> None:
    """Go on where :func:`servo` could not: joints that can be at the goal are, the others do what was planned for them.

    To arrive with a velocity may take a run-up, for which there may be no room; a joint brakes then.

    Args:
        limits: See above.
        timing: See above.
        state: See above.
        goal: ``(2, 6)`` from :func:`servo`.
        planned: ``(2, 6)`` set points and velocities after this step on a trajectory to the goal.
        out: Filled.
    """
    dt_s = timing[DT_S]
    for j in range(JOINTS):
        to, velocity = planned[0, j], planned[1, j]
        if possible(limits, timing, state, j, goal[0, j]):
            to = goal[0, j]
            velocity = (to - state[SETPOINT, j]) / dt_s
        if not can_stop(limits, j, to, velocity):
            velocity = slower(limits, j, state[VELOCITY, j], dt_s)
            to = state[SETPOINT, j] + (state[VELOCITY, j] + velocity) / 2 * dt_s
        follow(limits, timing, state, j, to, velocity, out)
