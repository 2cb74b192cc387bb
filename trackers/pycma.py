"""The tracker ``cmaes`` driven by the package ``cma`` of N. Hansen, as a reference."""

from __future__ import annotations

import warnings
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from surgbench.geometry import FloatArray
from surgbench.search.sampling import SamplingConfig, SamplingTracker
from surgbench.state import STATE_SIZE, split_arms
from surgbench.trackers.optimisers.cma_settings import package_settings, released_settings
from surgbench.trackers.optimisers.normals import SobolNormals

# What stands for an infinite loss: the package warns of what is not finite, and adds two losses up.
HUGE = 1e300


class PycmaTracker(SamplingTracker):
    """The package's own search, one for each arm, fed with the losses of both arms together."""

    name: ClassVar[str] = "pycma"
    summary: ClassVar[str] = "CMA-ES of the package cma with the settings of cmaes, as far as it has them"

    class Config(SamplingConfig):
        """Options; the defaults are those of ``cmaes``."""

        elites: Annotated[
            int, Field(ge=1, description="best samples that move the distribution (CMA_mu), at most half of all")
        ] = 15
        mean_rate: Annotated[float, Field(gt=0, description="c_m of eq. 3 (CMA_cmean)")] = 2.0
        covariance_rate: Annotated[
            float, Field(gt=0, description="factor on the package's c_mu for such a population (CMA_rankmu)")
        ] = 4.0

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()
        super().__init__(self.config)

    def _prepare(self, arms: int, rng: np.random.Generator) -> None:
        config = self.config
        elites = min(config.elites, config.population // 2)
        # The weights of the package sum to 1; those of the best samples of half the population, in cmaes, do not.
        kept = released_settings(STATE_SIZE, config.population, elites=elites).mean_weights.sum()
        self._package_options = {
            "popsize": config.population,
            "CMA_mu": elites,
            "CMA_cmean": config.mean_rate * float(kept),
            "CMA_rankmu": _rank_mu_factor(config.covariance_rate, config.population, elites),
            "CMA_active": False,  # with a raised c_mu negative weights make negative eigenvalues
            "CMA_mirrors": 0,
            "seed": np.nan,  # anything else seeds NumPy's global generator
            "verbose": -9,
            "verb_log": 0,
        }
        self._normals = {STATE_SIZE * arms: SobolNormals(STATE_SIZE * arms, rng)}
        if arms > 1 and config.dual != "joint":
            self._normals[STATE_SIZE] = SobolNormals(STATE_SIZE, rng)
        _package()

    def _search(self, start: FloatArray) -> _Search:
        arms = len(start) // STATE_SIZE
        normals = _Normals(self._normals[len(start)], arms)
        options = [{**self._package_options, "randn": normals.of(arm)} for arm in range(arms)]
        return _Search(
            [
                _package().CMAEvolutionStrategy(mean, self.config.sigma, option)
                for mean, option in zip(split_arms(start), options, strict=True)
            ]
        )


class _Search:
    def __init__(self, arms: list[Any]) -> None:
        self._arms = arms

    def ask(self) -> FloatArray:
        self._asked = [arm.ask() for arm in self._arms]
        return np.concatenate([np.array(samples) for samples in self._asked], axis=1)

    def tell(self, samples: FloatArray, losses: NDArray[np.float64]) -> None:
        finite = np.nan_to_num(losses, nan=HUGE, posinf=HUGE).tolist()
        for arm, asked in zip(self._arms, self._asked, strict=True):
            arm.tell(asked, finite)


class _Normals:
    """Normals of all arms, drawn together when the first arm asks and handed out to each."""

    def __init__(self, source: SobolNormals, arms: int) -> None:
        self._source = source
        self._waiting: list[list[FloatArray]] = [[] for _ in range(arms)]

    def of(self, arm: int) -> Any:
        """What the package calls in place of ``numpy.random.randn``."""

        def draw(count: int, size: int) -> FloatArray:
            if not self._waiting[arm]:
                vectors = self._source.take(count)
                for index, queue in enumerate(self._waiting):
                    queue.append(vectors[:, index * size : (index + 1) * size])
            return self._waiting[arm].pop()

        return draw


def _rank_mu_factor(covariance_rate: float, population: int, elites: int) -> float:
    """What brings the package's c_mu for a number of elites to that of ``cmaes``.

    The package derives its rates from the number of elites, ``cmaes`` from the population. It also lets c_1 + c_mu
    exceed 1, which makes negative eigenvalues: at least a thousandth of the last covariance is kept.
    """
    wanted = covariance_rate * package_settings(STATE_SIZE, population).rank_mu_rate
    given = package_settings(STATE_SIZE, 2 * elites)
    rank_one_rate = 2 / ((STATE_SIZE + 1.3) ** 2 + given.effective)
    return float(min(wanted, 0.999 * (1 - rank_one_rate)) / given.rank_mu_rate)


def _package() -> Any:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Could not import matplotlib")
        import cma
    return cma
