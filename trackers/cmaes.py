"""Rendering-based tracking by CMA-ES, after Hu et al. 2026."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from surgbench.geometry import FloatArray
from surgbench.search.sampling import SamplingConfig, SamplingTracker
from surgbench.state import STATE_SIZE, split_arms
from surgbench.trackers.optimisers.cma import CMA
from surgbench.trackers.optimisers.cma_settings import joint_settings, released_settings
from surgbench.trackers.optimisers.normals import SobolNormals


class CmaesTracker(SamplingTracker):
    """CMA-ES with raised learning rates, on samples of a Sobol sequence."""

    name: ClassVar[str] = "cmaes"
    summary: ClassVar[str] = "CMA-ES on silhouettes and tips, as published by Hu et al. 2026"

    class Config(SamplingConfig):
        """Options; the defaults are those of the released code."""

        dual: Annotated[
            Literal["joint", "separate", "released"],
            Field(
                description="two arms: one search with one ranking (eq. 15 and 16); or one for each arm against its "
                "own mask, as the paper's code has it (separate), and with its mistake in the ranks, too (released)"
            ),
        ] = "joint"
        elites: Annotated[int, Field(ge=1, description="best samples that move the mean, at most half of all")] = 15
        mean_rate: Annotated[float, Field(gt=0, description="c_m of eq. 3")] = 2.0
        covariance_rate: Annotated[float, Field(gt=0, description="factor on the default c_mu of eq. 4")] = 4.0

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()
        super().__init__(self.config)

    def _prepare(self, arms: int, rng: np.random.Generator) -> None:
        config = self.config
        alone = released_settings(
            STATE_SIZE,
            config.population,
            mean_rate=config.mean_rate,
            covariance_rate=config.covariance_rate,
            elites=config.elites,
        )
        self._separately = arms == 2 and config.dual != "joint"
        self._settings = alone if arms == 1 or self._separately else joint_settings(alone, STATE_SIZE * arms)
        self._blocks = (STATE_SIZE,) * arms
        self._normals = SobolNormals(STATE_SIZE if self._separately else STATE_SIZE * arms, rng)

    def _search(self, start: FloatArray) -> _Search | _Separate:
        config = self.config
        if self._separately:
            arms = [CMA(own, config.sigma, config.population, settings=self._settings) for own in split_arms(start)]
            return _Separate(arms, self._normals, config.population, mistaken=config.dual == "released")
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


class _Separate:
    """A search for each arm, ranked by its own losses.

    Args:
        arms: The searches.
        normals: Of one arm; each arm takes its own from it.
        population: Samples of each arm a generation.
        mistaken: As in the released code, sample i is not given the weight of its own rank but that of rank
            ``argsort(losses)[i]``.
    """

    def __init__(self, arms: list[CMA], normals: SobolNormals, population: int, mistaken: bool) -> None:
        self._arms, self._normals, self._population, self._mistaken = arms, normals, population, mistaken

    def ask(self) -> FloatArray:
        self._asked = [arm.ask(self._normals.take(self._population)) for arm in self._arms]
        return np.concatenate(self._asked, axis=1)

    def tell(self, samples: FloatArray, losses: NDArray[np.float64]) -> None:
        for arm, asked, own in zip(self._arms, self._asked, losses.T, strict=True):
            order = np.argsort(own, kind="stable")
            arm.tell(asked, order.astype(np.float64) if self._mistaken else own)
