"""Where the feature will be, and how the camera comes round to a far place without losing sight of it."""

from __future__ import annotations

import math

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray


@compiled
def track(measured: FloatArray, gain: float, dt_s: float, place: FloatArray, velocity: FloatArray) -> None:
    """One step of an alpha-beta filter (constant velocity) in three coordinates.

    beta follows from alpha as Benedict and Bordner's, ``alpha^2 / (2 - alpha)``.

    Args:
        measured: ``(3,)``.
        gain: alpha, 0 to 1.
        dt_s: Since the last step.
        place: ``(3,)``, updated.
        velocity: ``(3,)``, updated.
    """
    for k in range(3):
        error = measured[k] - place[k] - velocity[k] * dt_s
        place[k] += velocity[k] * dt_s + gain * error
        velocity[k] += gain * gain / (2 - gain) * error / dt_s


@compiled
def chase(
    place: FloatArray,
    goal: FloatArray,
    goal_velocity: FloatArray,
    box: FloatArray,
    acceleration: FloatArray,
    dt_s: float,
    pace: float,
    after: FloatArray,
) -> bool:
    """Where joints should be after one step, so that they meet a moving goal together and without passing it.

    They close the gap along a straight line, no faster than the joint that needs longest can brake in whole steps.

    Args:
        place: ``(n,)`` of the joints.
        goal: ``(n,)`` where the goal will be after the step.
        goal_velocity: ``(n,)`` of the goal.
        box: ``(2, n)`` least and largest places that the joints can reach in the step.
        acceleration: ``(n,)`` of the joints, largest.
        dt_s: Of the step.
        pace: Share of that speed which is used, above 0 and at most 1.
        after: ``(n,)``, filled: places after the step, within ``box``.

    Returns:
        Whether the goal is reached.
    """
    longest = 0.0
    for k in range(len(place)):
        longest = max(longest, abs(goal[k] - goal_velocity[k] * dt_s - place[k]) / acceleration[k])
    unit = dt_s / 2
    closing = pace * (math.sqrt(unit * unit + 2 * longest) - unit)
    share = 1.0 if longest <= closing * dt_s else closing * dt_s / longest
    met = True
    for k in range(len(place)):
        moved = goal_velocity[k] * dt_s
        wanted = place[k] + moved + share * (goal[k] - moved - place[k]) if share < 1.0 else goal[k]
        after[k] = min(box[1, k], max(box[0, k], wanted))
        met = met and after[k] == goal[k]
    return met
