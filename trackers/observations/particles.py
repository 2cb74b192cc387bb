"""A weighted cloud of particles: reweighting, systematic resampling, means."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray


def effective_number(weights: FloatArray) -> float:
    """``1 / sum(w^2)`` of normalised weights: from 1, where one particle has all, to their number."""
    return float(1.0 / (weights**2).sum())


def systematic_resample(weights: FloatArray, rng: np.random.Generator) -> NDArray[np.int64]:
    """Indices of the particles that go on.

    One uniform number places a comb of N equal teeth over the cumulated weights, so that a particle of weight w goes
    on floor(N w) or ceil(N w) times, and N w times in the mean.

    Args:
        weights: ``(N,)``, sum 1.
        rng: Gives the one number.

    Returns:
        ``(N,)`` indices, ascending.
    """
    count = len(weights)
    teeth = (rng.random() + np.arange(count)) / count
    # Rounding may leave the sum short of the last tooth.
    return np.minimum(np.searchsorted(np.cumsum(weights), teeth, side="right"), count - 1)


class ParticleCloud:
    """Particles of one arm with their weights.

    Args:
        spread: ``(d,)`` standard deviations of the first particles about zero.
        count: How many.
        rng: The only source of randomness.

    Attributes:
        values: ``(count, d)``.
        weights: ``(count,)``, sum 1.
    """

    def __init__(self, spread: FloatArray, count: int, rng: np.random.Generator) -> None:
        self._rng = rng
        self.values = spread * rng.standard_normal((count, len(spread)))
        self.weights = np.full(count, 1.0 / count)

    def walk(self, spread: FloatArray) -> None:
        """Move every particle by its own normal step of these standard deviations, ``(d,)``."""
        self.values = self.values + spread * self._rng.standard_normal(self.values.shape)

    def weigh(self, likelihoods: FloatArray) -> None:
        """Multiply the weights with ``(count,)`` likelihoods; equal ones if nothing is left."""
        weights = self.weights * likelihoods
        total = weights.sum()
        kept = np.isfinite(total) and total > 0
        self.weights = weights / total if kept else np.full(len(weights), 1.0 / len(weights))

    def resample(self, below: float) -> bool:
        """Draw the particles anew in proportion to their weights where ``N_eff < below * N``; says whether it did."""
        count = len(self.weights)
        if effective_number(self.weights) >= below * count:
            return False
        self.values = self.values[systematic_resample(self.weights, self._rng)]
        self.weights = np.full(count, 1.0 / count)
        return True
