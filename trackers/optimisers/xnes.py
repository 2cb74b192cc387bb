"""Exponential natural evolution strategy, ask and tell.

T. Glasmachers et al., "Exponential Natural Evolution Strategies" (GECCO 2010), with its default learning rates.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray


class XNES:
    """One search distribution ``N(mean, A A^T)``.

    Args:
        mean: ``(d,)`` where the search begins.
        sigma: Standard deviation to begin with, in all directions.
        population: Samples per generation.

    Attributes:
        mean: ``(d,)``.
        scale: ``(d, d)``: A.
    """

    def __init__(self, mean: FloatArray, sigma: float, population: int) -> None:
        d = len(mean)
        self.mean: FloatArray = np.array(mean, dtype=np.float64)
        self.scale: FloatArray = sigma * np.eye(d)
        utilities = np.maximum(np.log(population / 2 + 1) - np.log(np.arange(1, population + 1)), 0.0)
        self._utilities: FloatArray = utilities / utilities.sum() - 1 / population
        self._rate = 0.6 * (3 + np.log(d)) / (d * np.sqrt(d))

    def ask(self, normals: FloatArray) -> FloatArray:
        """Samples of the distribution, one for each of the ``(n, d)`` standard normal vectors."""
        samples: FloatArray = self.mean + normals @ self.scale.T
        return samples

    def tell(self, samples: FloatArray, losses: NDArray[np.float64]) -> None:
        """Move the distribution along the natural gradient of the expected utility.

        Args:
            samples: ``(population, d)`` as asked for.
            losses: ``(population,)``; samples whose loss is NaN count as the worst.
        """
        order = np.argsort(np.where(np.isnan(losses), np.inf, losses), kind="stable")
        normals = np.linalg.solve(self.scale, (samples[order] - self.mean).T).T
        # The utilities add up to zero, so that the identity in their definition of the second gradient drops out.
        along = self._utilities @ normals
        shape = (normals * self._utilities[:, None]).T @ normals
        values, vectors = np.linalg.eigh(shape)
        self.mean = self.mean + self.scale @ along
        self.scale = self.scale @ ((vectors * np.exp(self._rate / 2 * values)) @ vectors.T)
