"""A small quadratic program: as near as possible to what is wanted, within bounds, and beyond some planes."""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.viewpoint.kinematics import solve

ITERATIONS = 40
HALVINGS = 12
SMALLEST_STEP = 1e-13


@compiled
def _cost(
    H: FloatArray, wanted: FloatArray, rows: FloatArray, needed: FloatArray, stiff: float, x: FloatArray
) -> float:
    cost = 0.0
    for i in range(len(x)):
        for j in range(len(x)):
            cost += 0.5 * (x[i] - wanted[i]) * H[i, j] * (x[j] - wanted[j])
    for row in range(len(rows)):
        short = needed[row]
        for j in range(len(x)):
            short -= rows[row, j] * x[j]
        if short > 0.0:
            cost += 0.5 * stiff * short * short
    return cost


@compiled(makes_arrays=True, calls="viewpoint")
def solve_bounded(
    H: FloatArray,
    wanted: FloatArray,
    rows: FloatArray,
    needed: FloatArray,
    stiff: float,
    lower: FloatArray,
    upper: FloatArray,
    x: FloatArray,
) -> float:
    """Minimise ``1/2 (x - w)' H (x - w) + 1/2 k sum max(0, b - A x)^2`` within ``lower <= x <= upper``.

    The planes are as stiff as told and no more than that, so that there is always a solution: where bounds and planes
    cannot all be had, the bounds are kept. Bertsekas' projected Newton method (1982): variables that stand at a bound,
    and want beyond it, are held there; the others take a Newton step, halved until the cost falls.

    Args:
        H: ``(n, n)`` positive definite.
        wanted: ``(n,)``.
        rows: ``(m, n)`` A.
        needed: ``(m,)`` b.
        stiff: k.
        lower: ``(n,)``.
        upper: ``(n,)``.
        x: ``(n,)``, filled.

    Returns:
        By how much the worst plane is missed, 0 where none is.
    """
    n = len(x)
    slope, A, step, trial = np.empty(n), np.empty((n, n)), np.empty(n), np.empty(n)
    for i in range(n):
        x[i] = min(upper[i], max(lower[i], wanted[i]))
    cost = _cost(H, wanted, rows, needed, stiff, x)
    for _ in range(ITERATIONS):
        for i in range(n):
            slope[i] = 0.0
            for j in range(n):
                slope[i] += H[i, j] * (x[j] - wanted[j])
                A[i, j] = H[i, j]
        for row in range(len(rows)):
            short = needed[row]
            for j in range(n):
                short -= rows[row, j] * x[j]
            if short > 0.0:
                for i in range(n):
                    slope[i] -= stiff * short * rows[row, i]
                    for j in range(n):
                        A[i, j] += stiff * rows[row, i] * rows[row, j]
        for i in range(n):
            held = (x[i] <= lower[i] and slope[i] > 0.0) or (x[i] >= upper[i] and slope[i] < 0.0)
            step[i] = -slope[i]
            if held:
                for j in range(n):
                    A[i, j] = A[j, i] = 0.0
                A[i, i], step[i] = 1.0, 0.0
        if not solve(A, step):
            break
        moved, share = 0.0, 1.0
        better = math.inf
        for _ in range(HALVINGS):
            moved = 0.0
            for i in range(n):
                trial[i] = min(upper[i], max(lower[i], x[i] + share * step[i]))
                moved = max(moved, abs(trial[i] - x[i]))
            better = _cost(H, wanted, rows, needed, stiff, trial)
            if better < cost:
                break
            share *= 0.5
        if not better < cost:
            break
        cost = better
        x[:] = trial
        if moved < SMALLEST_STEP:
            break
    missed = 0.0
    for row in range(len(rows)):
        short = needed[row]
        for j in range(n):
            short -= rows[row, j] * x[j]
        missed = max(missed, short)
    return missed
