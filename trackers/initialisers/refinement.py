"""What initialisers share once they have hypotheses: scoring, and refining the best by CMA-ES.

The shaft dominates the silhouette, so that the best of a few thousand hypotheses tell it and little else. Therefore
the roll about it and the joints are drawn anew around the best shafts, ranked and refined once more. Of those that then
explain the mask about as well, the one whose wrist is least bent is taken: a real instrument is never quite the one
that is modelled, and what the mask does not decide is seldom at a joint's limit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import numpy as np
from pydantic import Field

from surgbench.config import Count, Section
from surgbench.contract import Observation, Scene
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.objective import LossWeights
from surgbench.state import ANGLES, BETA, JOINTS, POSITION, STATE_SCALE, JointLimits, StateSpace
from surgbench.trackers.initialisers.thickness import ThicknessObjective
from surgbench.trackers.optimisers.cma import CMA
from surgbench.trackers.optimisers.cma_settings import tutorial_settings

BATCH = 256
WIDE = 5.0  # first step of refinements that begin at a coarse hypothesis
SHAFT_SLIP_M = 2e-3  # how well a shaft tells where along it the wrist is


class RefinementConfig(Section):
    """Options of the refinement, for an initialiser's own options to build on."""

    refined: Annotated[Count, Field(description="best hypotheses that are refined")] = 16
    shafts: Annotated[Count, Field(description="best of those, whose roll and joints are drawn anew")] = 2
    redrawn: Annotated[Count, Field(description="states with another roll and other joints on those shafts")] = 8192
    finalists: Annotated[Count, Field(description="best states that are refined to the end")] = 4
    generations: Annotated[tuple[int, int], Field(description="of a refinement, and of the last one")] = (20, 100)
    population: Annotated[int, Field(ge=4, description="samples a generation")] = 70
    as_good: Annotated[float, Field(ge=0, description="share of the best loss by which another may be worse")] = 0.15
    loss: LossWeights = LossWeights()

    @property
    def work(self) -> int:
        """States that :func:`finish` scores."""
        short, long = self.generations
        refinements = (2 * self.refined + self.shafts) * short + self.finalists * long
        return self.redrawn + self.population * refinements + self.finalists


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
    """Refines states by CMA-ES with the tutorial's rates.

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
        settings = tutorial_settings(len(state), self._population)
        search = CMA(self._space.encode(state), sigma, self._population, settings=settings)
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


def finish(
    scene: Scene,
    observation: Observation,
    hypotheses: FloatArray,
    config: RefinementConfig,
    score: Scorer,
    rng: np.random.Generator,
) -> FloatArray:
    """The best state that is found from coarse ones.

    Args:
        scene: Of one arm.
        observation: The first frame.
        hypotheses: ``(n, 9)``.
        config: How much is tried.
        score: Gives the losses.
        rng: The only source of randomness.

    Returns:
        ``(9,)``.
    """
    drawn = scene.instruments[0].generate_limits
    short, long = config.generations
    refine = Refiner(scene, observation, score, config.population, rng)
    shafts = refine(hypotheses, WIDE, short, config.shafts)
    anew = score.best(_draw_anew(shafts, config.redrawn, observation, drawn, rng), config.refined)
    finalists = refine(np.concatenate([shafts, anew]), WIDE, short, config.finalists)
    ended = refine(finalists, 1.0, long, config.finalists)
    losses = score(ended)
    return least_bent(ended[losses <= (1.0 + config.as_good) * losses.min()], scene.limits[0])


def least_bent(states: FloatArray, limits: JointLimits) -> FloatArray:
    """That of ``(n, 9)`` states whose pitch and yaw of the wrist are farthest from their limits."""
    middle, half = (limits.upper_rad + limits.lower_rad) / 2, (limits.upper_rad - limits.lower_rad) / 2
    bent = np.abs((states[:, JOINTS] - middle) / half)[:, :2].max(axis=1)
    best: FloatArray = states[int(np.argmin(bent))]
    return best


def draw_joints(observation: Observation, limits: JointLimits, count: int, rng: np.random.Generator) -> FloatArray:
    """``(count, 3)``: the readings where there are any, else anything an instrument in use does."""
    if observation.joints is not None:
        return np.tile(observation.joints, (count, 1))
    return rng.uniform(limits.lower_rad, limits.upper_rad, (count, 3))


def _draw_anew(
    shafts: FloatArray, count: int, observation: Observation, limits: JointLimits, rng: np.random.Generator
) -> FloatArray:
    """``(count, 9)`` states on the given shafts, with another roll and other joints."""
    states = np.resize(shafts, (count, shafts.shape[1]))
    states[:, BETA] = rng.uniform(0.0, 2 * np.pi, len(states))
    along_shaft = look_at_rotation(states[:, ANGLES])[:, :, 2]
    states[:, POSITION] += rng.normal(0.0, SHAFT_SLIP_M, (len(states), 1)) * along_shaft
    states[:, JOINTS] = draw_joints(observation, limits, len(states), rng)
    return states
