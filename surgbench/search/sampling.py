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
from surgbench.pair_objective import PairObjective
from surgbench.search.arms import arm_confidence
from surgbench.search.spaces import SearchSpaces
from surgbench.state import StateSpace, split_arms


class Search(Protocol):
    """One frame's search: asked for candidates, then told how good they are."""

    def ask(self) -> FloatArray:
        """``(n, 9 * arms)`` vectors of the search space."""
        ...

    def tell(self, samples: FloatArray, losses: NDArray[np.float64]) -> None:
        """Learn from the losses of what was asked for; infinite where a tip is behind the camera.

        Args:
            samples: ``(n, 9 * arms)``.
            losses: ``(n,)``; ``(n, 2)``, of each arm, where a tracker looks at two arms separately.
        """
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
    """Samples candidate states around the start of each frame and keeps the best one ever sampled.

    Two arms are scored as :class:`~surgbench.pair_objective.PairObjective` does. Where a tracker looks at them
    separately, the best of each arm is kept.
    """

    _separately = False

    def __init__(self, config: SamplingConfig) -> None:
        self._options = config
        self.trace: Trace | None = None

    def reset(self, scene: Scene, state: FloatArray, rng: np.random.Generator) -> None:
        """Prepare the scorer, the search spaces and the samples."""
        kind = PairObjective if scene.arms == 2 else Objective
        self._objective: Objective = kind(scene, self._options.loss)
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
        if self._separately and isinstance(self._objective, PairObjective):
            best_state = self._best_of_each(search, space, self._objective, observation.start)
        else:
            best_state, best_iou = self._best_of_all(search, space, observation.start)
        if isinstance(self._objective, PairObjective):
            confidence, hidden = arm_confidence(self._objective, best_state)
            return Estimate(best_state, confidence, hidden | (confidence < self._options.lost_iou))
        # With an empty mask the best sample is one out of the picture, and two empty masks overlap perfectly.
        lost = best_iou < self._options.lost_iou or not observation.mask.any()
        return Estimate(best_state, confidence=float(best_iou), lost=bool(lost))

    def _best_of_all(self, search: Search, space: StateSpace, start: FloatArray) -> tuple[FloatArray, float]:
        """The best state ever sampled, ``(9 * arms,)``, and its overlap."""
        best_loss, best_iou, best = np.inf, 0.0, start
        for _ in range(self._options.iterations):
            samples = search.ask()
            states = space.decode(samples)
            losses, ious = self._objective(states)
            search.tell(samples, losses)
            first = int(np.argmin(losses))
            if losses[first] < best_loss:
                best_loss, best_iou, best = losses[first], ious[first], states[first]
            self._show(states, losses)
        return best, best_iou

    def _best_of_each(
        self, search: Search, space: StateSpace, objective: PairObjective, start: FloatArray
    ) -> FloatArray:
        """The best left and the best right arm ever sampled, which need not be of one pair, ``(18,)``."""
        best_loss, best = np.full(2, np.inf), split_arms(start).copy()
        for _ in range(self._options.iterations):
            samples = search.ask()
            states = space.decode(samples)
            losses, _ious = objective.arms(states)
            search.tell(samples, losses)
            for arm, first in enumerate(np.argmin(losses, axis=0)):
                if losses[first, arm] < best_loss[arm]:
                    best_loss[arm], best[arm] = losses[first, arm], split_arms(states)[first, arm]
            self._show(states, losses.sum(axis=1))
        return best.ravel()

    def _show(self, states: FloatArray, losses: FloatArray) -> None:
        if self.trace is not None:
            order = np.argsort(losses, kind="stable")
            self.trace.states.append(states[order])
            self.trace.losses.append(losses[order])
