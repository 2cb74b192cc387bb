"""The joints from which the camera sees the feature best: bounded least squares over the whole pose.

Levenberg and Marquardt's method with joints that stand at a bound, and want beyond it, held there.
"""

from __future__ import annotations

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.trackers.viewing.residuals import RESIDUALS, residuals
from surgbench.trackers.viewing.world import World
from surgbench.viewpoint.kinematics import solve

SMALLEST_STEP = 1e-9
LARGEST_DAMPING = 1e6


@compiled(makes_arrays=True, calls="viewpoint")
def fit(
    world: World,
    joints: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    feature: FloatArray,
    normal: FloatArray,
    tool: FloatArray,
    weights: FloatArray,
    iterations: int,
) -> float:
    """Improve ``joints`` within bounds.

    Args:
        world: As in :func:`surgbench.trackers.viewing.residuals.residuals`.
        joints: ``(6,)``, within the bounds; improved in place.
        lower: ``(6,)``; a joint whose bounds are one stays where it is.
        upper: ``(6,)``.
        feature: As there, and all that follows.
        normal: There.
        tool: There.
        weights: There.
        iterations: At most so many.

    Returns:
        The cost that remains.
    """
    r, J = np.empty(RESIDUALS), np.empty((RESIDUALS, 6))
    r_try, J_try = np.empty(RESIDUALS), np.empty((RESIDUALS, 6))
    A, b, held = np.empty((6, 6)), np.empty(6), np.empty(6, dtype=np.bool_)
    trial = np.empty(6)
    cost: float = residuals(world, joints, feature, normal, tool, weights, r, J)
    damping = 1e-4
    for _ in range(iterations):
        for row in range(6):
            b[row] = 0.0
            for k in range(RESIDUALS):
                b[row] -= J[k, row] * r[k]
            held[row] = (joints[row] <= lower[row] and b[row] < 0.0) or (joints[row] >= upper[row] and b[row] > 0.0)
        for row in range(6):
            for column in range(row + 1):
                total = 0.0
                if not (held[row] or held[column]):
                    for k in range(RESIDUALS):
                        total += J[k, row] * J[k, column]
                A[row, column] = total
            if held[row]:
                A[row, row] = 1.0
                b[row] = 0.0
            else:
                A[row, row] += damping * A[row, row] + 1e-9
        if not solve(A, b):
            damping *= 10.0
            continue
        moved = 0.0
        for k in range(6):
            trial[k] = min(upper[k], max(lower[k], joints[k] + b[k]))
            moved = max(moved, abs(trial[k] - joints[k]))
        better = residuals(world, trial, feature, normal, tool, weights, r_try, J_try)
        if better < cost:
            cost = better
            joints[:] = trial
            r[:] = r_try
            J[:] = J_try
            damping = max(damping * 0.1, 1e-9)
            if moved < SMALLEST_STEP:
                break
        else:
            if moved < SMALLEST_STEP:
                break
            damping *= 10.0
            if damping > LARGEST_DAMPING:
                break
    return cost
