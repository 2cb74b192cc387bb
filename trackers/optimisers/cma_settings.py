"""Weights and learning rates of CMA-ES: today's defaults of the package ``cma``, and those that were published.

They differ in more than the negative weights, see :func:`package_settings`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from surgbench.geometry import FloatArray


@dataclass(frozen=True)
class CMASettings:
    """What :class:`~surgbench.trackers.optimisers.cma.CMA` is told beside where to begin.

    Attributes:
        weights: ``(m,)`` of the best m samples, best first. The positive ones come first, sum to 1 and move the mean;
            negative ones shrink the covariance in the directions of bad samples ("active" CMA-ES).
        effective: mu_eff, the number of samples that the positive weights are worth.
        mean_rate: c_m, how far the mean moves towards the weighted samples.
        step_path_rate: c_sigma.
        step_damping: d_sigma.
        expected_length: What the length of the step size's path is compared with: that of a standard normal vector.
        longest_step_path: Where the path of the step size is longer than this, the other path waits (h_sigma = 0).
        path_rate: c_c.
        rank_one_rate: c_1.
        rank_mu_rate: c_mu.
        symmetric_root: Whether samples and the path of the step size go through the symmetric root of the covariance
            instead of its Cholesky factor. The same distribution, but lengths of the path differ a little.
    """

    weights: FloatArray
    effective: float
    mean_rate: float
    step_path_rate: float
    step_damping: float
    expected_length: float
    longest_step_path: float
    path_rate: float
    rank_one_rate: float
    rank_mu_rate: float
    symmetric_root: bool


def published_settings(
    size: int,
    population: int,
    *,
    mean_rate: float = 1.0,
    covariance_rate: float = 1.0,
    elites: int | None = None,
) -> CMASettings:
    """The rates of N. Hansen, "The CMA Evolution Strategy: A Tutorial" (2016), and what Hu et al. 2026 raise in them.

    Args:
        size: Components of a vector, d.
        population: Samples per generation.
        mean_rate: c_m (1 is the default of the tutorial).
        covariance_rate: Multiplies the tutorial's c_mu, at most up to ``1 - c_1``.
        elites: How many of the best samples count; half the population unless told. The learning rates are
            those of half the population in any case, as in the paper's code.
    """
    d, half = size, population // 2
    count = min(elites or half, population)
    log_weights = np.log((population + 1) / 2) - np.log(np.arange(1, half + 1))
    effective = float(log_weights.sum() ** 2 / (log_weights**2).sum())
    kept = np.log(max(half, count) + 0.5) - np.log(np.arange(1, count + 1))
    step_path_rate = (effective + 2) / (d + effective + 5)
    rank_one_rate = 2 / ((d + 1.3) ** 2 + effective)
    rank_mu_rate = 2 * (effective - 2 + 1 / effective) / ((d + 2) ** 2 + effective)
    expected_length = np.sqrt(d) * (1 - 1 / (4 * d) + 1 / (21 * d**2))
    return CMASettings(
        weights=kept / kept.sum(),
        effective=effective,
        mean_rate=mean_rate,
        step_path_rate=step_path_rate,
        step_damping=1 + 2 * max(0.0, np.sqrt((effective - 1) / (d + 1)) - 1) + step_path_rate,
        expected_length=expected_length,
        longest_step_path=(1.4 + 2 / (d + 1)) * expected_length,
        path_rate=(4 + effective / d) / (d + 4 + 2 * effective / d),
        rank_one_rate=rank_one_rate,
        rank_mu_rate=min(1 - rank_one_rate, covariance_rate * rank_mu_rate),
        symmetric_root=False,
    )


def package_settings(size: int, population: int, *, active: bool = True) -> CMASettings:
    """The defaults of the package ``cma``, version 4.5.

    Unlike the tutorial it bounds c_sigma by 1/2, damps the step size more in many dimensions (if the positive weights
    are worth more samples than there are dimensions), bounds the square of the path's length for h_sigma, computes the
    expected length exactly, has 1/4 more in the numerator of c_mu, and counts bad samples with negative weights.

    Args:
        size: Components of a vector, d.
        population: Samples per generation.
        active: Whether there are negative weights (``CMA_active``).
    """
    d = size
    raw = np.log((population + 1) / 2) - np.log(np.arange(1, population + 1))
    good, bad = raw[raw > 0], raw[raw <= 0]
    good = good / good.sum()
    effective = float(1 / (good**2).sum())
    rank_one_rate = min(1.0, population / 6) * 2 / ((d + 1.3) ** 2 + effective)
    rank_mu_rate = min(1 - rank_one_rate, 2 * (0.25 + effective - 2 + 1 / effective) / ((d + 2) ** 2 + effective))
    step_path_rate = min(0.5, (effective + 2) / (d + effective + 3))
    damped = max(1.0, 3 * (1 - 0.5 ** (d / 9)))
    weights = good
    if active and bad.any():
        effective_bad = float(bad.sum() ** 2 / (bad**2).sum())
        total = min(
            1 + rank_one_rate / rank_mu_rate,  # the covariance does not decay by itself
            (1 - rank_one_rate - rank_mu_rate) / (rank_mu_rate * d),  # it stays positive definite
            1 + 2 * effective_bad / (effective + 2),
        )
        weights = np.concatenate([good, bad * (total / -bad.sum())])
    return CMASettings(
        weights=weights,
        effective=effective,
        mean_rate=1.0,
        step_path_rate=step_path_rate,
        step_damping=1 + 2 * max(0.0, damped * np.sqrt((effective - 1) / (d + 1)) - 1) + step_path_rate,
        expected_length=float(np.sqrt(2) * np.exp(gammaln((d + 1) / 2) - gammaln(d / 2))),
        longest_step_path=float(np.sqrt(d * (2 + 4 / (d + 1)))),
        path_rate=(4 + effective / d) / (d + 4 + 2 * effective / d),
        rank_one_rate=rank_one_rate,
        rank_mu_rate=rank_mu_rate,
        symmetric_root=True,
    )
