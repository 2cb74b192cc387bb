"""What initialisers share once they have hypotheses: scoring, ranking, and refining the best by CMA-ES."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from surgbench.contract import Observation, Scene
from surgbench.geometry import FloatArray
from surgbench.objective import LossWeights
from surgbench.state import STATE_SCALE, StateSpace
from surgbench.trackers.initialisers.thickness import ThicknessObjective
from surgbench.trackers.optimisers.cma import CMA

BATCH = 256
WIDE = 5.0  # first step of refinements that begin at a coarse hypothesis


class Scorer:
    """Losses of states of one arm in the first frame, counted as work done.

    Args:
        scene: Of one arm.
        observation: The first frame.
        weights: Of the loss's terms.
        work: Number of states that will be scored, as far as it is known.
        progress: Called with the fraction done, 0 to 1.
    """

    def __init__(
        self, scene: Scene, observation: Observation, weights: LossWeights, work: int, progress: Callable[[float], None]
    ) -> None:
        self._objective = ThicknessObjective(scene, weights)
        self._objective.observe(observation)
        self._work, self._done, self._progress = work, 0, progress

    def __call__(self, states: FloatArray) -> FloatArray:
        """``(n,)`` losses of ``(n, 9)`` states, pixels."""
        losses = np.empty(len(states))
        for begin in range(0, len(states), BATCH):
            batch = slice(begin, begin + BATCH)
            losses[batch] = self._objective(states[batch])[0]
            self._done += len(losses[batch])
            self._progress(min(self._done / self._work, 1.0))
        return losses

    def best(self, states: FloatArray, keep: int) -> FloatArray:
        """The ``keep`` states of least loss, best first."""
        return states[np.argsort(self(states), kind="stable")[:keep]]


class Refiner:
    """Refines states by CMA-ES with its default rates.

    Args:
        scene: Of one arm.
        observation: The first frame. With readings the joints are searched within a few hundredths of a radian of them.
        score: Gives the losses.
        population: Samples a generation.
        rng: Draws the samples.
    """

    def __init__(
        self, scene: Scene, observation: Observation, score: Scorer, population: int, rng: np.random.Generator
    ) -> None:
        joint_step = 1.0 if observation.joints is None else 0.1
        scale = STATE_SCALE * np.where(np.arange(len(STATE_SCALE)) < 6, 1.0, joint_step)
        self._space = StateSpace(scene.limits[0], scale)
        self._score, self._population, self._rng = score, population, rng

    def __call__(self, candidates: FloatArray, sigma: float, generations: int, keep: int) -> FloatArray:
        """Refine each of ``(n, 9)`` states by itself; the ``keep`` best results, best first."""
        ended = [self._refine(state, sigma, generations) for state in candidates]
        order = np.argsort([loss for _, loss in ended], kind="stable")[:keep]
        return np.stack([ended[i][0] for i in order])

    def _refine(self, state: FloatArray, sigma: float, generations: int) -> tuple[FloatArray, float]:
        """The best state that is met, and its loss."""
        search = CMA(self._space.encode(state), sigma, self._population)
        best, best_loss = state, np.inf
        for _ in range(generations):
            samples = search.ask(self._rng.standard_normal((self._population, len(state))))
            states = self._space.decode(samples)
            losses = self._score(states)
            search.tell(samples, losses)
            first = int(np.argmin(losses))
            if losses[first] < best_loss:
                best, best_loss = states[first], float(losses[first])
        return best, best_loss
