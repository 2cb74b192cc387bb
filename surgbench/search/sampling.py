"""What the trackers have in common that sample candidates around the start of each frame."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from surgbench.config import Section
from surgbench.contract import Estimate, InstrumentTracker, Observation, Scene, Trace
from surgbench.geometry import FloatArray
from surgbench.objective import LossWeights, Objective
from surgbench.search.spaces import SearchSpaces


class Search(Protocol):
    """One frame's search: asked for candidates, then told how good they are."""

    def ask(self) -> FloatArray:
        """``(n, 9 * arms)`` vectors of the search space."""
        ...

    def tell(self, samples: FloatArray, losses: NDArray[np.float64]) -> None:
        """Learn from the ``(n,)`` losses of what was asked for; infinite where a tip is behind the camera."""
        ...


class SamplingConfig(Section):
    """Options; the defaults are those of the released code of Hu et al. 2026."""

    iterations: Annotated[int, Field(ge=1, description="generations a frame")] = 3
    population: Annotated[int, Field(ge=4, description="samples a generation")] = 70
    sigma: Annotated[float, Field(gt=0, description="first step size, in the state's natural steps")] = 1.0
    readings_scale: Annotated[
        float, Field(gt=0, description="factor on the joints' steps where readings are given")
    ] = 0.1
    jaw_step_rad: Annotated[float, Field(gt=0, description="natural step of q3, without readings")] = 0.1
    lost_iou: Annotated[float, Field(ge=0, le=1, description="an estimate that overlaps less is lost")] = 0.5
    loss: LossWeights = LossWeights(keypoint_form="released")


class SamplingTracker(InstrumentTracker):
    """Samples candidate states around the start of each frame and keeps the best one ever sampled."""

    def __init__(self, config: SamplingConfig) -> None:
        self._options = config
        self.trace: Trace | None = None

    def reset(self, scene: Scene, state: FloatArray, rng: np.random.Generator) -> None:
        """Prepare the scorer, the search spaces and the samples."""
        self._objective = Objective(scene, self._options.loss)
        self._spaces = SearchSpaces(scene, self._options.readings_scale, self._options.jaw_step_rad)
        self._prepare(scene.arms, rng)

    @abstractmethod
    def _prepare(self, arms: int, rng: np.random.Generator) -> None:
        """Set up what the searches of a sequence share. Untimed."""

    @abstractmethod
    def _search(self, start: FloatArray) -> Search:
        """A search that begins at ``start``, ``(9 * arms,)`` of the search space."""

    def step(self, observation: Observation) -> Estimate:
        """Search from ``observation.start``."""
        self._objective.observe(observation)
        space = self._spaces.of(observation)
        search = self._search(space.encode(observation.start))
        best_loss, best_iou, best_state = np.inf, 0.0, observation.start
        for _ in range(self._options.iterations):
            samples = search.ask()
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
        # With an empty mask the best sample is one out of the picture, and two empty masks overlap perfectly.
        lost = best_iou < self._options.lost_iou or not observation.mask.any()
        return Estimate(best_state, confidence=float(best_iou), lost=bool(lost))
