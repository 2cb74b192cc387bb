"""What the trackers have in common that sample candidates around the start of each frame."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from surgbench.contract import Estimate, InstrumentTracker, Observation, Scene, Trace
from surgbench.geometry import FloatArray
from surgbench.objective import LossWeights, Objective
from surgbench.pair_objective import PairObjective
from surgbench.search.arms import fit_of_arms
from surgbench.search.pair_options import WithPairOptions
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


class Separate:
    """A search for each arm, told its own losses.

    Args:
        arms: The searches, each of vectors ``(n, 9)``.
    """

    def __init__(self, arms: Sequence[Search]) -> None:
        self._arms = arms

    def ask(self) -> FloatArray:
        """``(n, 9 * arms)``."""
        return np.concatenate([arm.ask() for arm in self._arms], axis=1)

    def tell(self, samples: FloatArray, losses: NDArray[np.float64]) -> None:
        """Learn from ``(n, arms)`` losses."""
        parts = np.moveaxis(split_arms(samples), 1, 0)
        for arm, own, loss in zip(self._arms, parts, losses.T, strict=True):
            arm.tell(np.ascontiguousarray(own), loss)


class SamplingConfig(WithPairOptions):
    """Options; the defaults are those of the released code of Hu et al. 2026."""

    iterations: Annotated[int, Field(ge=1, description="generations a frame")] = 3
    population: Annotated[int, Field(ge=4, description="samples a generation")] = 70
    sigma: Annotated[float, Field(gt=0, description="first step size, in the state's natural steps")] = 1.0
    readings_scale: Annotated[
        float, Field(gt=0, description="factor on the joints' steps where readings are given")
    ] = 0.1
    jaw_step_rad: Annotated[float, Field(gt=0, description="natural step of q3, without readings")] = 0.1
    lost_iou: Annotated[float, Field(ge=0, le=1, description="an estimate that overlaps less is lost")] = 0.5
    dual: Annotated[
        Literal["auto", "joint", "separate"],
        Field(
            description="two arms: one search with one ranking on the mask of both (eq. 15), or one for each arm "
            "against its own mask; auto: separate where there are such masks"
        ),
    ] = "auto"
    loss: LossWeights = LossWeights(keypoint_form="released")

    pair_options: ClassVar[tuple[str, ...]] = ("dual",)


class SamplingTracker(InstrumentTracker):
    """Samples candidate states around the start of each frame and keeps the best one ever sampled.

    Of two arms that are searched separately the best of each is kept.
    """

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
        """A search that begins at ``start``, of the search space: ``(9 * arms,)``, or ``(9,)`` of one of two arms."""

    def step(self, observation: Observation) -> Estimate:
        """Search from ``observation.start``."""
        self._objective.observe(observation)
        space = self._spaces.of(observation)
        begin = space.encode(observation.start)
        if isinstance(self._objective, PairObjective) and self._are_separate(self._objective):
            separate = Separate([self._search(own) for own in split_arms(begin)])
            best_state = self._best_of_each(separate, space, self._objective, observation.start)
        else:
            best_state, best_iou = self._best_of_all(self._search(begin), space, observation.start)
        if isinstance(self._objective, PairObjective):
            fit = fit_of_arms(self._objective, best_state)
            return Estimate(best_state, fit.confidence, fit.hidden | (fit.overlap < self._options.lost_iou))
        # With an empty mask the best sample is one out of the picture, and two empty masks overlap perfectly.
        lost = best_iou < self._options.lost_iou or not observation.mask.any()
        return Estimate(best_state, confidence=float(best_iou), lost=bool(lost))

    def _are_separate(self, objective: PairObjective) -> bool:
        return self._options.dual == "separate" or (self._options.dual == "auto" and objective.tells_apart)

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
