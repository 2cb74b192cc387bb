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
    place: float,
    velocity: float,
    goal: float,
    goal_velocity: float,
    least: float,
    most: float,
    acceleration: float,
    dt_s: float,
) -> float:
    """Where a joint should be after one step, so that it meets a moving goal as soon as it can without passing it.

    The distance is closed no faster than can be braked away in whole steps.

    Args:
        place: Of the joint.
        velocity: Of the joint.
        goal: Where the goal will be after the step.
        goal_velocity: Of the goal.
        least: Least place that the joint can reach in the step.
        most: Largest such place.
        acceleration: Of the joint, largest.
        dt_s: Of the step.

    Returns:
        The joint's place after the step, between ``least`` and ``most``.
    """
    gap = goal - goal_velocity * dt_s - place
    unit = acceleration * dt_s / 2
    closing = min(math.sqrt(unit * unit + 2 * acceleration * abs(gap)) - unit, abs(gap) / dt_s)
    wanted = place + (goal_velocity + math.copysign(closing, gap)) * dt_s
    return min(most, max(least, wanted))
