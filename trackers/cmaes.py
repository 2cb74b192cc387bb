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
from surgbench.trackers.optimisers.cma_settings import joint_settings, released_settings
from surgbench.trackers.optimisers.normals import SobolNormals


class CmaesTracker(SamplingTracker):
    """CMA-ES with raised learning rates, on samples of a Sobol sequence."""

    name: ClassVar[str] = "cmaes"
    summary: ClassVar[str] = "CMA-ES on silhouettes and tips, as published by Hu et al. 2026"

    class Config(SamplingConfig):
        """Options; the defaults are those of the released code."""

        released_ranks: Annotated[
            bool,
            Field(
                description="separate searches of two arms: samples are given each other's weights, as by a mistake in "
                "the paper's code"
            ),
        ] = False
        pair_options: ClassVar[tuple[str, ...]] = ("dual", "released_ranks")

        elites: Annotated[int, Field(ge=1, description="best samples that move the mean, at most half of all")] = 15
        mean_rate: Annotated[float, Field(gt=0, description="c_m of eq. 3")] = 2.0
        covariance_rate: Annotated[float, Field(gt=0, description="factor on the default c_mu of eq. 4")] = 4.0

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()
        super().__init__(self.config)

    def _prepare(self, arms: int, rng: np.random.Generator) -> None:
        config = self.config
        self._alone = released_settings(
            STATE_SIZE,
            config.population,
            mean_rate=config.mean_rate,
            covariance_rate=config.covariance_rate,
            elites=config.elites,
        )
        self._joint = self._alone if arms == 1 else joint_settings(self._alone, STATE_SIZE * arms)
        self._normals = {STATE_SIZE * arms: SobolNormals(STATE_SIZE * arms, rng)}
        if arms > 1 and config.dual != "joint":
            self._normals[STATE_SIZE] = SobolNormals(STATE_SIZE, rng)

    def _search(self, start: FloatArray) -> _Search:
        config, size = self.config, len(start)
        settings = self._alone if size == STATE_SIZE else self._joint
        blocks = (STATE_SIZE,) * (size // STATE_SIZE)
        cma = CMA(start, config.sigma, config.population, settings=settings, blocks=blocks)
        one_of_two = size == STATE_SIZE and len(self._normals) > 1
        mistaken = config.released_ranks and one_of_two
        return _Search(cma, self._normals[size], config.population, mistaken)


class _Search:
    """A search that draws its own samples.

    Args:
        cma: The distribution.
        normals: What samples are made of.
        population: Samples a generation.
        mistaken: As in the released code, sample i is not given the weight of its own rank but that of rank
            ``argsort(losses)[i]``.
    """

    def __init__(self, cma: CMA, normals: SobolNormals, population: int, mistaken: bool) -> None:
        self._cma, self._normals, self._population, self._mistaken = cma, normals, population, mistaken

    def ask(self) -> FloatArray:
        samples: FloatArray = self._cma.ask(self._normals.take(self._population))
        return samples

    def tell(self, samples: FloatArray, losses: NDArray[np.float64]) -> None:
        order = np.argsort(losses, kind="stable").astype(np.float64)
        self._cma.tell(samples, order if self._mistaken else losses)
