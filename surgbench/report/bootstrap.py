"""Intervals of means over sequences, by resampling them: what samples of one sequence say resembles each other."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import DegenerateDataWarning, bootstrap

from surgbench.geometry import FloatArray
from surgbench.randomness import generator

LEVEL, RESAMPLES = 0.95, 9999


def mean_interval(values: ArrayLike, weights: ArrayLike | None = None) -> tuple[float, float] | None:
    """The 95 % interval of a mean, with sequences drawn anew (bias-corrected and accelerated bootstrap, Efron 1987).

    Args:
        values: ``(n,)`` one for each sequence.
        weights: ``(n,)`` how much each counts in the mean, as its number of samples; alike unless told.

    Returns:
        Lower and upper end; ``None`` for fewer than two sequences. The same values have the same interval, always.

    Example:
        Where all say the same there is nothing to be learnt of how they differ.

        >>> from surgbench.report.bootstrap import mean_interval
        >>> mean_interval([3.0, 3.0, 3.0])
        (3.0, 3.0)
        >>> low, high = mean_interval([1.0, 2.0, 3.0, 4.0, 5.0])
        >>> round(low, 1), round(high, 1)
        (1.8, 4.2)
    """
    found = np.asarray(values, dtype=np.float64)
    if len(found) < 2:
        return None
    if np.ptp(found) == 0.0:
        return float(found[0]), float(found[0])
    shares = np.ones(len(found)) if weights is None else np.asarray(weights, dtype=np.float64)

    def mean(sample: FloatArray, weight: FloatArray, axis: int = -1) -> FloatArray:
        return np.asarray((sample * weight).sum(axis=axis) / weight.sum(axis=axis))

    for method in ("BCa", "percentile"):  # the second where the first is at a loss: nearly all are alike
        with np.errstate(invalid="ignore", divide="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore", DegenerateDataWarning)
            result = bootstrap(
                (found, shares),
                mean,
                paired=True,
                confidence_level=LEVEL,
                n_resamples=RESAMPLES,
                method=method,
                rng=generator(purpose="bootstrap"),
            )
        low, high = result.confidence_interval
        if np.isfinite([low, high]).all():
            break
    return float(low), float(high)
