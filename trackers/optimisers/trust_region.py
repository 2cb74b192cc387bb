"""The trust region of TuRBO: how large a box around the best point is searched.

Eriksson et al., "Scalable Global Optimization via Local Bayesian Optimization" (NeurIPS 2019, arXiv:1910.01739),
section 2, with the constants of its appendix.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray

FIRST_LENGTH = 0.8
LEAST_LENGTH = 0.5**7
LARGEST_LENGTH = 1.6
SUCCESSES = 3  # in a row, until the box doubles
IMPROVEMENT = 1e-3  # relative to the best value, that makes a success


def largest_offset(points: FloatArray, point: FloatArray, periodic: NDArray[np.bool_]) -> FloatArray:
    """How far points of the unit cube are from one of them: ``(n,)`` largest offset of a coordinate.

    Args:
        points: ``(n, d)``.
        point: ``(d,)``.
        periodic: ``(d,)`` which coordinates have a period of 1.
    """
    away = np.abs(points - point)
    away = np.where(periodic, np.minimum(away, 1.0 - away), away)
    return np.asarray(np.max(away, axis=1))


class TrustRegion:
    """Side of the box, as a share of the search space, from one batch of values to the next.

    Args:
        dimensions: Of the search space.
        batch: Points evaluated at a time.

    Attributes:
        length: Side of the box before each dimension's own weight.
        best: Least value so far.
    """

    def __init__(self, dimensions: int, batch: int) -> None:
        self.length = FIRST_LENGTH
        self.best = math.inf
        self._patience = math.ceil(max(4 / batch, dimensions / batch))
        self._successes = self._failures = 0

    @property
    def collapsed(self) -> bool:
        """Too small to find anything new: begin elsewhere."""
        return self.length < LEAST_LENGTH

    def update(self, values: FloatArray) -> None:
        """Grow after batches that improved on the best value, shrink after batches that did not.

        Args:
            values: ``(n,)`` of one batch; the first one only says what the best is.
        """
        least = float(np.min(values))
        if math.isfinite(self.best):
            if least < self.best - IMPROVEMENT * abs(self.best):
                self._successes, self._failures = self._successes + 1, 0
            else:
                self._successes, self._failures = 0, self._failures + 1
            if self._successes == SUCCESSES:
                self.length, self._successes = min(2 * self.length, LARGEST_LENGTH), 0
            elif self._failures == self._patience:
                self.length, self._failures = self.length / 2, 0
        self.best = min(self.best, least)
