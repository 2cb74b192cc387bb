"""Rendering-based tracking by CMA-ES, after Hu et al. 2026."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from surgbench.geometry import FloatArray
from surgbench.search.sampling import SamplingConfig, SamplingTracker
from surgbench.state import STATE_SIZE
from surgbench.trackers.optimisers.cma import CMA
from surgbench.trackers.optimisers.cma_settings import released_settings
from surgbench.trackers.optimisers.normals import SobolNormals


class CmaesTracker(SamplingTracker):
    """CMA-ES with raised learning rates, on samples of a Sobol sequence."""

    name: ClassVar[str] = "cmaes"
    summary: ClassVar[str] = "CMA-ES on silhouettes and tips, as published by Hu et al. 2026"

    class Config(SamplingConfig):
        """Options; the defaults are those of the released code."""

        elites: Annotated[int, Field(ge=1, description="best samples that move the mean, at most half of all")] = 15
        mean_rate: Annotated[float, Field(gt=0, description="c_m of eq. 3")] = 2.0
        covariance_rate: Annotated[float, Field(gt=0, description="factor on the default c_mu of eq. 4")] = 4.0

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()
        super().__init__(self.config)

    def _prepare(self, arms: int, rng: np.random.Generator) -> None:
        config = self.config
        self._settings = released_settings(
            STATE_SIZE * arms,
            config.population,
            mean_rate=config.mean_rate,
            covariance_rate=config.covariance_rate,
            elites=config.elites,
        )
        self._blocks = (STATE_SIZE,) * arms
        self._normals = SobolNormals(STATE_SIZE * arms, rng)

    def _search(self, start: FloatArray) -> _Search:
        config = self.config
        cma = CMA(start, config.sigma, config.population, settings=self._settings, blocks=self._blocks)
        return _Search(cma, self._normals, config.population)


class _Search:
    def __init__(self, cma: CMA, normals: SobolNormals, population: int) -> None:
        self._cma, self._normals, self._population = cma, normals, population

    def ask(self) -> FloatArray:
        samples: FloatArray = self._cma.ask(self._normals.take(self._population))
        return samples

    def tell(self, samples: FloatArray, losses: NDArray[np.float64]) -> None:
        self._cma.tell(samples, losses)
