"""Covariance matrix adaptation evolution strategy, ask and tell.

Equations after N. Hansen, "The CMA Evolution Strategy: A Tutorial" (2016, arXiv:1604.00772). Without settings it does,
step by step, what the package ``cma`` does with its defaults.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.trackers.optimisers.cma_settings import CMASettings, package_settings


class CMA:
    """One search distribution ``N(mean, sigma^2 C)``.

    Args:
        mean: ``(d,)`` where the search begins.
        sigma: Step size to begin with.
        population: Samples per generation.
        settings: Weights and learning rates; those of the package ``cma`` unless told.
        blocks: Sizes of the diagonal blocks that the covariance is constrained to (Hu et al. 2026, eq. 16), ``(d,)``
            unless told. There is one ranking and one step size for all of them.
    """

    def __init__(
        self,
        mean: FloatArray,
        sigma: float,
        population: int,
        *,
        settings: CMASettings | None = None,
        blocks: tuple[int, ...] | None = None,
    ) -> None:
        d = len(mean)
        self.mean: FloatArray = np.array(mean, dtype=np.float64)
        self.sigma = sigma
        self.covariance: FloatArray = np.eye(d)
        self.settings = settings or package_settings(d, population)
        self._good = int((self.settings.weights > 0).sum())
        self._factor: FloatArray = np.eye(d)
        self._path_sigma: FloatArray = np.zeros(d)
        self._path_c: FloatArray = np.zeros(d)
        self._generation = 0
        sizes = blocks or (d,)
        self._blocks = [slice(sum(sizes[:k]), sum(sizes[: k + 1])) for k in range(len(sizes))]

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
        use = self.settings
        self._generation += 1
        best = np.argsort(np.where(np.isnan(losses), np.inf, losses), kind="stable")[: len(use.weights)]
        steps = (samples[best] - self.mean) / self.sigma
        step = use.mean_weights @ steps[: len(use.mean_weights)]
        self.mean = self.mean + use.mean_rate * self.sigma * step
        whitened = np.linalg.solve(self._factor, step)
        c_sigma, c_c = use.step_path_rate, use.path_rate
        pull = np.sqrt(c_sigma * (2 - c_sigma) * use.effective)
        self._path_sigma = (1 - c_sigma) * self._path_sigma + pull * whitened
        length = np.linalg.norm(self._path_sigma)
        settled = length / np.sqrt(1 - (1 - c_sigma) ** (2 * self._generation))
        rising = settled < use.longest_step_path
        self._path_c = (1 - c_c) * self._path_c + rising * np.sqrt(c_c * (2 - c_c) * use.effective) * step
        missing = 0.0 if rising else use.rank_one_rate * c_c * (2 - c_c)
        kept = 1 + missing - use.rank_one_rate - use.rank_mu_rate * float(use.weights.sum())
        for block in self._blocks:
            own = steps[:, block]
            rank_one = np.outer(self._path_c[block], self._path_c[block])
            rank_mu = (own * self._shortened(steps, block)[:, None]).T @ own
            before = self.covariance[block, block]
            covariance = kept * before + use.rank_one_rate * rank_one + use.rank_mu_rate * rank_mu
            self.covariance[block, block] = (covariance + covariance.T) / 2
        self.sigma *= float(np.exp(min(1.0, float((c_sigma / use.step_damping) * (length / use.expected_length - 1)))))
        self._factor = _symmetric_root(self.covariance) if use.symmetric_root else _cholesky(self.covariance)

    def _shortened(self, steps: FloatArray, block: slice) -> FloatArray:
        """Weights of steps in a block of the covariance.

        A step of negative weight counts as if it were as long as an average one, whatever its length: so the
        covariance stays positive definite.
        """
        weights = self.settings.weights
        if self._good == len(weights):
            return weights
        own = steps[self._good :, block]
        lengths = np.linalg.norm(np.linalg.solve(self._factor[block, block], own.T), axis=0)
        bad = weights[self._good :] * own.shape[1] / (lengths + 1e-9) ** 2
        return np.concatenate([weights[: self._good], bad])


def _cholesky(covariance: FloatArray) -> FloatArray:
    """Lower factor; a covariance that rounding has made singular gets the least jitter that mends it."""
    jitter = 0.0
    scale = float(np.trace(covariance)) / len(covariance)
    while True:
        try:
            return np.asarray(np.linalg.cholesky(covariance + jitter * np.eye(len(covariance))), dtype=np.float64)
        except np.linalg.LinAlgError:
            jitter = max(10 * jitter, 1e-12 * scale)


def _symmetric_root(covariance: FloatArray) -> FloatArray:
    """Symmetric positive definite root; eigenvalues that rounding has made negative become small ones."""
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values, 1e-14 * values[-1])
    root: FloatArray = (vectors * np.sqrt(values)) @ vectors.T
    return root
