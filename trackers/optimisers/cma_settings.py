"""Weights and learning rates of CMA-ES: of the tutorial, of the package ``cma``, and as Hu et al. 2026 released them.

They differ in more than the negative weights, see :func:`package_settings` and :func:`released_settings`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln

from surgbench.geometry import FloatArray


@dataclass(frozen=True)
class CMASettings:
    """What :class:`~surgbench.trackers.optimisers.cma.CMA` is told beside where to begin.

    Attributes:
        weights: ``(m,)`` of the best m samples in the covariance, best first. Negative ones come last and shrink the
            covariance in the directions of bad samples ("active" CMA-ES).
        mean_weights: ``(k,)`` of the best k samples in the step of the mean and in the paths.
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
    mean_weights: FloatArray
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


def tutorial_settings(
    size: int,
    population: int,
    *,
    mean_rate: float = 1.0,
    covariance_rate: float = 1.0,
    elites: int | None = None,
) -> CMASettings:
    """The rates of N. Hansen, "The CMA Evolution Strategy: A Tutorial" (2016).

    Args:
        size: Components of a vector, d.
        population: Samples per generation.
        mean_rate: c_m (1 is the default of the tutorial).
        covariance_rate: Multiplies the tutorial's c_mu, at most up to ``1 - c_1``.
        elites: How many of the best samples count; half the population unless told. The learning rates are
            those of half the population in any case.
    """
    d, half = size, population // 2
    count = min(elites or half, population)
    log_weights = np.log((population + 1) / 2) - np.log(np.arange(1, half + 1))
    effective = float(log_weights.sum() ** 2 / (log_weights**2).sum())
    kept = np.log(max(half, count) + 0.5) - np.log(np.arange(1, count + 1))
    step_path_rate = (effective + 2) / (d + effective + 5)
    rank_one_rate = 2 / ((d + 1.3) ** 2 + effective)
    rank_mu_rate = 2 * (effective - 2 + 1 / effective) / ((d + 2) ** 2 + effective)
    expected_length = _expected_length(d)
    return CMASettings(
        weights=kept / kept.sum(),
        mean_weights=kept / kept.sum(),
        effective=effective,
        mean_rate=mean_rate,
        step_path_rate=step_path_rate,
        step_damping=1 + 2 * max(0.0, np.sqrt((effective - 1) / (d + 1)) - 1) + step_path_rate,
        expected_length=expected_length,
        longest_step_path=(1.4 + 2 / (d + 1)) * expected_length,
        path_rate=_path_rate(d, effective),
        rank_one_rate=rank_one_rate,
        rank_mu_rate=min(1 - rank_one_rate, covariance_rate * rank_mu_rate),
        symmetric_root=False,
    )


def released_settings(
    size: int,
    population: int,
    *,
    mean_rate: float = 2.0,
    covariance_rate: float = 4.0,
    elites: int = 15,
) -> CMASettings:
    """What the released code of Hu et al. 2026 runs: the rates of the package evotorch, two of them raised.

    The article (eq. 3 and 4) says that the best 15 samples move the distribution. In the code they move the mean alone,
    by weights that are normalised over half the population: with 70 samples they sum to 0.78, so that c_m = 2 is worth
    1.56. The covariance is made of all samples. c_mu is not bounded: with four times its default next to nothing is
    left of the last covariance (``1 - c_1 - c_mu`` is -0.014 in nine dimensions), and the negative weights of active
    CMA-ES, which are bounded by that, become positive and tiny.

    Args:
        size: Components of a vector, d.
        population: Samples per generation.
        mean_rate: c_m.
        covariance_rate: Multiplies c_mu.
        elites: How many of the best samples move the mean, at most half the population.
    """
    d = size
    good, bad = _log_weights(population)
    effective = float(1 / (good**2).sum())
    step_path_rate = (effective + 2) / (d + effective + 3)
    rank_one_rate, rank_mu_rate = _covariance_rates(d, population, effective)
    rank_mu_rate *= covariance_rate
    return CMASettings(
        weights=np.concatenate([good, _negative(bad, d, effective, rank_one_rate, rank_mu_rate)]),
        mean_weights=good[:elites],
        effective=effective,
        mean_rate=mean_rate,
        step_path_rate=step_path_rate,
        step_damping=1 + 2 * max(0.0, np.sqrt((effective - 1) / (d + 1)) - 1) + step_path_rate,
        expected_length=_expected_length(d),
        longest_step_path=float(np.sqrt(d * (2 + 4 / (d + 1)))),
        path_rate=_path_rate(d, effective),
        rank_one_rate=rank_one_rate,
        rank_mu_rate=rank_mu_rate,
        symmetric_root=False,
    )


def joint_settings(settings: CMASettings, size: int) -> CMASettings:
    """Settings of one search over several blocks that each learn at their own rate (Hu et al. 2026, eq. 16).

    Weights and rates stay those of one block. What the length of the path of the step size is held against is that of a
    vector of all blocks, which the path is: the released code takes the length of one block's, so that its step size
    grows by an eighth in a generation of chance.

    Args:
        settings: Of one block.
        size: Components of a vector, of all blocks.
    """
    d = size
    return replace(
        settings,
        expected_length=_expected_length(d),
        longest_step_path=float(np.sqrt(d * (2 + 4 / (d + 1)))),
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
    good, bad = _log_weights(population)
    effective = float(1 / (good**2).sum())
    rank_one_rate, rank_mu_rate = _covariance_rates(d, population, effective)
    rank_mu_rate = min(1 - rank_one_rate, rank_mu_rate)
    step_path_rate = min(0.5, (effective + 2) / (d + effective + 3))
    damped = max(1.0, 3 * (1 - 0.5 ** (d / 9)))
    weights = good
    if active and bad.any():
        weights = np.concatenate([good, _negative(bad, d, effective, rank_one_rate, rank_mu_rate)])
    return CMASettings(
        weights=weights,
        mean_weights=good,
        effective=effective,
        mean_rate=1.0,
        step_path_rate=step_path_rate,
        step_damping=1 + 2 * max(0.0, damped * np.sqrt((effective - 1) / (d + 1)) - 1) + step_path_rate,
        expected_length=float(np.sqrt(2) * np.exp(gammaln((d + 1) / 2) - gammaln(d / 2))),
        longest_step_path=float(np.sqrt(d * (2 + 4 / (d + 1)))),
        path_rate=_path_rate(d, effective),
        rank_one_rate=rank_one_rate,
        rank_mu_rate=rank_mu_rate,
        symmetric_root=True,
    )


def _log_weights(population: int) -> tuple[FloatArray, FloatArray]:
    """Weights of the better half of the samples, which sum to 1, and raw ones of the worse, none above 0."""
    raw = np.log((population + 1) / 2) - np.log(np.arange(1, population + 1))
    good = raw[raw > 0]
    return good / good.sum(), raw[raw <= 0]


def _negative(bad: FloatArray, d: int, effective: float, rank_one_rate: float, rank_mu_rate: float) -> FloatArray:
    """Weights of bad samples, scaled to what the rates allow; the tutorial's eq. 50 to 53."""
    effective_bad = float(bad.sum() ** 2 / (bad**2).sum())
    total = min(
        1 + rank_one_rate / rank_mu_rate,  # the covariance does not decay by itself
        (1 - rank_one_rate - rank_mu_rate) / (rank_mu_rate * d),  # it stays positive definite
        1 + 2 * effective_bad / (effective + 2),
    )
    scaled: FloatArray = bad * (total / -bad.sum())
    return scaled


def _covariance_rates(d: int, population: int, effective: float) -> tuple[float, float]:
    """c_1 and c_mu as the packages ``cma`` and evotorch have them."""
    rank_one_rate = min(1.0, population / 6) * 2 / ((d + 1.3) ** 2 + effective)
    return rank_one_rate, 2 * (0.25 + effective - 2 + 1 / effective) / ((d + 2) ** 2 + effective)


def _path_rate(d: int, effective: float) -> float:
    return (4 + effective / d) / (d + 4 + 2 * effective / d)


def _expected_length(d: int) -> float:
    """Of a standard normal vector, the tutorial's series."""
    return float(np.sqrt(d) * (1 - 1 / (4 * d) + 1 / (21 * d**2)))
