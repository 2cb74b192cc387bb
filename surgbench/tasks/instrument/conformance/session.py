"""A tracker under check, and how it is led through a sequence."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.conformance.subject import CheckFailedError
from surgbench.contract import Estimate, Observation, Scene
from surgbench.geometry import FloatArray
from surgbench.randomness import generator
from surgbench.state import JOINTS, STATE_SIZE, clip_joints, split_arms
from surgbench.tasks.instrument.conformance.scenes import Play
from surgbench.tasks.instrument.worker import check_confidence, check_lost, check_standard_deviations, check_state


@dataclass(frozen=True)
class Step:
    """One frame's answer, checked for its form; ``confidence`` and ``lost`` are ``(arms,)``."""

    state: FloatArray
    confidence: FloatArray
    lost: NDArray[np.bool_]
    standard_deviations: FloatArray | None
    latency_s: float

    def same(self, other: Step) -> bool:
        """Whether two answers are equal to the last bit."""
        mine, theirs = ((one.confidence, one.lost, one.state, one.standard_deviations) for one in (self, other))
        return all(_same(*pair) for pair in zip(mine, theirs, strict=True))


def _same(one: NDArray[Any] | None, other: NDArray[Any] | None) -> bool:
    return one is other if one is None or other is None else np.array_equal(one, other)


class Session:
    """A tracker on its way through a sequence, its last estimate starting the next search.

    Args:
        tracker: Any tracker.
        scene: The sequence's constants.
        last: The state that the next search starts from, ``(9 * arms,)``.
        alive: Called after everything that may take long.
    """

    def __init__(self, tracker: Any, scene: Scene, last: FloatArray, alive: Callable[[], None]) -> None:
        self.tracker = tracker
        self.scene = scene
        self.last = last
        self._alive = alive

    def reset(self, seed: int) -> None:
        """Start a sequence."""
        self.tracker.reset(self.scene, self.last.copy(), generator(check="conformance", seed=seed))
        self._alive()

    def prepare(self, observation: Observation) -> Observation:
        """The observation with its start filled in, joints from the readings where there are any."""
        start = self.last.copy()
        if observation.joints is not None:
            split_arms(start)[:, JOINTS] = observation.joints
        return replace(observation, start=clip_joints(start, self.scene.joint_limits))

    def step(self, observation: Observation) -> Step:
        """One frame, as it is (see :meth:`prepare`).

        Raises:
            CheckFailedError: What comes back is no answer.
        """
        begin = time.perf_counter()
        answer = self.tracker.step(observation)
        latency_s = time.perf_counter() - begin
        self._alive()
        estimate = answer if isinstance(answer, Estimate) else Estimate(answer)
        state = check_state(estimate.state, STATE_SIZE * self.scene.arms, f"frame {observation.index}: step")
        arms = self.scene.arms
        confidence = check_confidence(estimate.confidence, arms, f"frame {observation.index}: step")
        if np.asarray(estimate.lost).dtype != np.bool_:
            raise CheckFailedError(f"frame {observation.index}: 'lost' is {type(estimate.lost).__name__}, not bool")
        lost = check_lost(estimate.lost, arms, f"frame {observation.index}: step")
        deviations = check_standard_deviations(
            estimate.standard_deviations, len(state), f"frame {observation.index}: step"
        )
        self.last = state
        return Step(state, confidence, lost, deviations, latency_s)

    def follow(self, observations: Iterable[Observation]) -> list[Step]:
        """Several frames."""
        return [self.step(self.prepare(observation)) for observation in observations]


def start(tracker: Any, play: Play, alive: Callable[[], None], seed: int = 0) -> Session:
    """A tracker that has been reset at a play's first true state."""
    session = Session(tracker, play.scene, play.truth[0].copy(), alive)
    session.reset(seed)
    return session


def run_through(tracker: Any, play: Play, alive: Callable[[], None], seed: int = 0) -> list[Step]:
    """Reset a tracker and lead it through a whole play."""
    return start(tracker, play, alive, seed).follow(play.observations)


def first_difference(one: list[Step], other: list[Step]) -> int | None:
    """The first frame in which two runs differ; ``None`` where they are the same."""
    return next((k for k, (a, b) in enumerate(zip(one, other, strict=True)) if not a.same(b)), None)
