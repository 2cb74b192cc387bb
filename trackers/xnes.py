"""Tracking by exponential natural evolution strategy, a baseline of Hu et al. 2026."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.search.sampling import SamplingConfig, SamplingTracker
from surgbench.trackers.optimisers.xnes import XNES


class XnesTracker(SamplingTracker):
    """XNES with its default learning rates, on plain normal samples."""

    name: ClassVar[str] = "xnes"
    summary: ClassVar[str] = "exponential natural evolution strategy on silhouettes and tips, as in Hu et al. 2026"

    class Config(SamplingConfig):
        """Options; the defaults are those of the released code."""

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()
        super().__init__(self.config)

    def _prepare(self, arms: int, rng: np.random.Generator) -> None:
        self._rng = rng

    def _search(self, start: FloatArray) -> _Search:
        return _Search(XNES(start, self.config.sigma, self.config.population), self._rng, self.config.population)


class _Search:
    def __init__(self, xnes: XNES, rng: np.random.Generator, population: int) -> None:
        self._xnes, self._rng, self._population = xnes, rng, population

    def ask(self) -> FloatArray:
        normals = self._rng.standard_normal((self._population, len(self._xnes.mean)))
        samples: FloatArray = self._xnes.ask(normals)
        return samples

    def tell(self, samples: FloatArray, losses: NDArray[np.float64]) -> None:
        self._xnes.tell(samples, losses)
