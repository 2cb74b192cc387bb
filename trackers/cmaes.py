"""Rendering-based tracking by CMA-ES, after Hu et al. 2026."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from surgbench.contract import Estimate, InstrumentTracker, Observation, Scene, Trace
from surgbench.geometry import FloatArray
from surgbench.objective import LossWeights, Objective
from surgbench.state import STATE_SCALE, STATE_SIZE, StateSpace
from surgbench.trackers.optimisers.cma import CMA
from surgbench.trackers.optimisers.normals import SobolNormals


class CmaesTracker(InstrumentTracker):
    """Samples candidate states around the start of each frame and keeps the best one ever sampled."""

    name: ClassVar[str] = "cmaes"
    summary: ClassVar[str] = "CMA-ES on silhouettes and tips, as published by Hu et al. 2026"

    class Config(BaseModel):
        """Options; the defaults are the published settings."""

        model_config = ConfigDict(frozen=True, extra="forbid")

        iterations: Annotated[int, Field(ge=1, description="generations a frame")] = 3
        population: Annotated[int, Field(ge=4, description="samples a generation")] = 70
        elites: Annotated[int, Field(ge=1, description="best samples that move the distribution")] = 15
        mean_rate: Annotated[float, Field(gt=0, description="c_m of eq. 3")] = 2.0
        covariance_rate: Annotated[float, Field(gt=0, description="factor on the default c_mu of eq. 4")] = 4.0
        sigma: Annotated[float, Field(gt=0, description="first step size, in the state's natural steps")] = 1.0
        readings_scale: Annotated[
            float, Field(gt=0, description="factor on the joints' steps where readings are given")
        ] = 0.1
        lost_iou: Annotated[float, Field(ge=0, le=1, description="an estimate that overlaps less is lost")] = 0.5
        loss: LossWeights = LossWeights()

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()
        self.trace: Trace | None = None

    def reset(self, scene: Scene, state: FloatArray, rng: np.random.Generator) -> None:
        """Prepare the scorer, the search spaces and the samples."""
        self._objective = Objective(scene, self.config.loss)
        size = STATE_SIZE * scene.arms
        with_readings = STATE_SCALE * np.where(np.arange(STATE_SIZE) < 6, 1.0, self.config.readings_scale)
        self._space = StateSpace(scene.joint_limits, STATE_SCALE, scene.arms)
        self._space_with_readings = StateSpace(scene.joint_limits, with_readings, scene.arms)
        self._blocks = (STATE_SIZE,) * scene.arms
        self._normals = SobolNormals(size, rng)

    def step(self, observation: Observation) -> Estimate:
        """Search from ``observation.start``."""
        config = self.config
        self._objective.observe(observation)
        space = self._space if observation.joints is None else self._space_with_readings
        search = CMA(
            space.encode(observation.start),
            config.sigma,
            config.population,
            mean_rate=config.mean_rate,
            covariance_rate=config.covariance_rate,
            elites=config.elites,
            blocks=self._blocks,
        )
        best_loss, best_iou, best_state = np.inf, 0.0, observation.start
        for _ in range(config.iterations):
            samples = search.ask(self._normals.take(config.population))
            states = space.decode(samples)
            losses, ious = self._objective(states)
            search.tell(samples, losses)
            first = int(np.argmin(losses))
            if losses[first] < best_loss:
                best_loss, best_iou, best_state = losses[first], ious[first], states[first]
            if self.trace is not None:
                order = np.argsort(losses, kind="stable")
                self.trace.states.append(states[order])
                self.trace.losses.append(losses[order])
        return Estimate(best_state, confidence=float(best_iou), lost=bool(best_iou < config.lost_iou))
