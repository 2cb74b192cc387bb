"""Two arms followed together: each held against what the other leaves of the picture, both fitted by one system."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from surgbench.contract import Estimate, Observation, Scene, Trace
from surgbench.geometry import FloatArray
from surgbench.state import split_arms
from surgbench.trackers.registration.cut import Cutter, part_of
from surgbench.trackers.registration.fit import JointFit
from surgbench.trackers.registration.options import HybridOptions
from surgbench.trackers.registration.seeker import Seeker

ARMS = 2


class Pair:
    """Follows two arms.

    Args:
        scene: Of both.
        state: ``(18,)`` of the first frame.
        options: Of the tracker.
        rng: The only source of randomness.
    """

    def __init__(self, scene: Scene, state: FloatArray, options: HybridOptions, rng: np.random.Generator) -> None:
        self.trace: Trace | None = None
        self._arms = [
            Seeker(_alone(scene, arm), own, options, own_rng, part=True)
            for arm, (own, own_rng) in enumerate(zip(split_arms(np.array(state)), rng.spawn(ARMS), strict=True))
        ]
        self._cutters = [Cutter(scene, index) for index in range(len(scene.views))]
        self._fit = JointFit([arm.fit for arm in self._arms], options.fit)

    @property
    def shape(self) -> FloatArray:
        """What was learned so far of the instruments and the camera, one arm after the other."""
        return np.concatenate([arm.shape for arm in self._arms])

    def step(self, observation: Observation) -> Estimate:
        """Follow both arms' best stories together, and what else is followed of each; look where one does not fit."""
        arms = self._arms
        last = [arm.hypotheses[0].state for arm in arms]
        for arm in arms:
            arm.predict(observation.timestamp_s)
        parts = self._cut(observation, np.stack([arm.expected(arm.hypotheses[0]) for arm in arms]))
        union = not self._cutters[0].told_apart
        asks = [arm.ask(arm.hypotheses[0], part, None) for arm, part in zip(arms, parts, strict=True)]
        fits = self._fit(
            [ask.begin for ask in asks],
            parts,
            [ask.prior for ask in asks],
            tips=[ask.tips for ask in asks],
            learn=[ask.learn for ask in asks],
            shared=union,
        )
        others = [
            [arm.fitted(arm.ask(hypothesis, part, None), part) for hypothesis in arm.hypotheses[1:]]
            for arm, part in zip(arms, parts, strict=True)
        ]
        if union:  # else what is cut hardly depends on where the arms are
            parts = self._cut(observation, np.stack([fit.state for fit in fits]))
        answers = []
        lost = [arm.whereabouts.lost for arm in arms]
        for k, (arm, part, fit, more, before) in enumerate(zip(arms, parts, fits, others, last, strict=True)):
            arm.observe(part)
            for hypothesis, own in zip(arm.hypotheses, [fit, *more], strict=True):
                arm.take(hypothesis, own, part)
            arm.trace = self.trace
            arm.look(before, part, alone=not (union and lost[1 - k]))
            answers.append(arm.answer(part))
        return Estimate(
            np.concatenate([answer.state for answer in answers]),
            confidence=np.array([answer.confidence for answer in answers]),
            lost=np.array([answer.lost for answer in answers]),
            standard_deviations=np.concatenate([answer.standard_deviations for answer in answers]),
        )

    def _cut(self, observation: Observation, states: FloatArray) -> list[Observation]:
        """Each arm's part of a frame, the arms being at ``(2, 9)``."""
        lost = [arm.whereabouts.lost for arm in self._arms]
        unfit = [arm.unfit for arm in self._arms]
        views = [
            cutter(view, states, lost, unfit) for cutter, view in zip(self._cutters, observation.views, strict=True)
        ]
        return [part_of(observation, arm, [own[arm] for own in views]) for arm in range(ARMS)]


def _alone(scene: Scene, arm: int) -> Scene:
    """The scene of one of its arms."""
    own = slice(arm, arm + 1)
    return replace(
        scene,
        instruments=scene.instruments[own],
        limits=scene.limits[own],
        arms=1,
        T_cam_base=None if scene.T_cam_base is None else scene.T_cam_base[own],
    )
