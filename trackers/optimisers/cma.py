"""Covariance matrix adaptation evolution strategy, ask and tell.

Equations and default learning rates after N. Hansen, "The CMA Evolution Strategy: A Tutorial" (2016,
arXiv:1604.00772), with the raised learning rates and the elite selection of Hu et al. 2026 (eq. 3 and 4,
and the settings of their released code) as options.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray


class CMA:
    """One search distribution ``N(mean, sigma^2 C)``.

    Args:
        mean: ``(d,)`` where the search begins.
        sigma: Step size to begin with.
        population: Samples per generation.
        mean_rate: c_m, how far the mean moves towards the weighted elites (1 is the default of the tutorial).
        covariance_rate: Multiplies the tutorial's c_mu, at most up to ``1 - c_1``.
        elites: How many of the best samples count; half the population unless told. The learning rates are
            those of half the population in any case, as in the paper's code.
        blocks: Sizes of the diagonal blocks that the covariance is constrained to (eq. 16), ``(d,)`` unless told.
    """

    def __init__(
        self,
        mean: FloatArray,
        sigma: float,
        population: int,
        *,
        mean_rate: float = 1.0,
        covariance_rate: float = 1.0,
        elites: int | None = None,
        blocks: tuple[int, ...] | None = None,
    ) -> None:
        d = len(mean)
        self.mean: FloatArray = np.array(mean, dtype=np.float64)
        self.sigma = sigma
        self.covariance: FloatArray = np.eye(d)
        self._factor: FloatArray = np.eye(d)
        self._path_sigma: FloatArray = np.zeros(d)
        self._path_c: FloatArray = np.zeros(d)
        self._generation = 0
        half = population // 2
        self._mu = min(elites or half, population)
        log_weights = np.log((population + 1) / 2) - np.log(np.arange(1, half + 1))
        mu_eff = float(log_weights.sum() ** 2 / (log_weights**2).sum())
        kept = np.log(max(half, self._mu) + 0.5) - np.log(np.arange(1, self._mu + 1))
        self._weights: FloatArray = kept / kept.sum()
        self._c_sigma = (mu_eff + 2) / (d + mu_eff + 5)
        self._damping = 1 + 2 * max(0.0, np.sqrt((mu_eff - 1) / (d + 1)) - 1) + self._c_sigma
        self._c_c = (4 + mu_eff / d) / (d + 4 + 2 * mu_eff / d)
        self._c_1 = 2 / ((d + 1.3) ** 2 + mu_eff)
        c_mu = 2 * (mu_eff - 2 + 1 / mu_eff) / ((d + 2) ** 2 + mu_eff)
        self._c_mu = min(1 - self._c_1, covariance_rate * c_mu)
        self._c_m = mean_rate
        self._mu_eff = mu_eff
        self._expected_norm = np.sqrt(d) * (1 - 1 / (4 * d) + 1 / (21 * d**2))
        self._block_mask = _block_mask(blocks or (d,))

    def ask(self, normals: FloatArray) -> FloatArray:
        """Samples of the distribution, one for each of the ``(n, d)`` standard normal vectors."""
        samples: FloatArray = self.mean + self.sigma * (normals @ self._factor.T)
        return samples

    def tell(self, samples: FloatArray, losses: NDArray[np.float64]) -> None:
        """Move the distribution towards the samples with the least losses.

        Args:
            samples: ``(n, d)`` as asked for.
            losses: ``(n,)``; samples whose loss is NaN count as the worst.
        """
        d = len(self.mean)
        self._generation += 1
        best = np.argsort(np.where(np.isnan(losses), np.inf, losses), kind="stable")[: self._mu]
        steps = (samples[best] - self.mean) / self.sigma
        step = self._weights @ steps
        self.mean = self.mean + self._c_m * self.sigma * step
        whitened = np.linalg.solve(self._factor, step)
        c_sigma, c_c = self._c_sigma, self._c_c
        self._path_sigma = (1 - c_sigma) * self._path_sigma + np.sqrt(c_sigma * (2 - c_sigma) * self._mu_eff) * whitened
        norm = np.linalg.norm(self._path_sigma)
        settled = norm / np.sqrt(1 - (1 - c_sigma) ** (2 * self._generation))
        rising = settled < (1.4 + 2 / (d + 1)) * self._expected_norm
        self._path_c = (1 - c_c) * self._path_c + rising * np.sqrt(c_c * (2 - c_c) * self._mu_eff) * step
        rank_one = np.outer(self._path_c, self._path_c)
        rank_mu = (steps * self._weights[:, None]).T @ steps
        missing = 0.0 if rising else self._c_1 * c_c * (2 - c_c)
        kept = 1 + missing - self._c_1 - self._c_mu
        covariance = kept * self.covariance + self._c_1 * rank_one + self._c_mu * rank_mu
        self.covariance = np.where(self._block_mask, (covariance + covariance.T) / 2, 0.0)
        self.sigma *= float(np.exp(min(1.0, (c_sigma / self._damping) * (norm / self._expected_norm - 1))))
        self._factor = _cholesky(self.covariance)


def _block_mask(blocks: tuple[int, ...]) -> NDArray[np.bool_]:
    owner = np.repeat(np.arange(len(blocks)), blocks)
    mask: NDArray[np.bool_] = owner[:, None] == owner[None, :]
    return mask


def _cholesky(covariance: FloatArray) -> FloatArray:
    """Lower factor; a covariance that rounding has made singular gets the least jitter that mends it."""
    jitter = 0.0
    scale = float(np.trace(covariance)) / len(covariance)
    while True:
        try:
            return np.asarray(np.linalg.cholesky(covariance + jitter * np.eye(len(covariance))), dtype=np.float64)
        except np.linalg.LinAlgError:
            jitter = max(10 * jitter, 1e-12 * scale)
