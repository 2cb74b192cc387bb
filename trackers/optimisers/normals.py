"""Standard normal samples from a scrambled Sobol sequence, which cover the space more evenly than random ones."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from surgbench.geometry import FloatArray


class SobolNormals:
    """Hands out standard normal vectors, never the same one twice.

    A fresh sampler costs about 2 ms, so that one long sequence is drawn in blocks.

    Args:
        size: Components of a vector.
        rng: Scrambles the sequence.
        block: Vectors drawn at a time, a power of two.
    """

    def __init__(self, size: int, rng: np.random.Generator, block: int = 1 << 14) -> None:
        self._sobol = qmc.Sobol(size, scramble=True, rng=rng)
        self._block = block
        self._vectors = self._draw()
        self._used = 0

    def _draw(self) -> FloatArray:
        # Scrambled points have 30 bits, so that an exact 0 is possible: keep half a step away from it.
        return np.asarray(ndtri(np.maximum(self._sobol.random(self._block), 2.0**-31)), dtype=np.float64)

    def take(self, count: int) -> FloatArray:
        """The next ``(count, size)`` vectors, however many."""
        if (missing := self._used + count - len(self._vectors)) > 0:
            blocks = -(-missing // self._block)
            self._vectors = np.concatenate([self._vectors[self._used :], *(self._draw() for _ in range(blocks))])
            self._used = 0
        vectors = self._vectors[self._used : self._used + count]
        self._used += count
        return vectors
