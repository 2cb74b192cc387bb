"""Particle filter over the lumped error of the robot's kinematics, after Richter et al. (arXiv 2102.06235).

The model is the published one; the released code (ucsdarclab/surgical_tool_tracking) differs from it by mistakes that
are not repeated here. It never resamples (it compares N_eff, at least 1, with 0.5); particles whose shaft lines match
badly gain weight (``exp(+C)``); and each frame is weighed with the joint readings of the one before. Ours besides:

- The lumped error is kept as ``T(x) T_0`` with ``T_0`` from the first frame, so that angle-axis vectors are added only
  where they nearly add; rotations are averaged as rotations.
- A pair beyond the threshold counts as missing before, not after, the features are associated.
- rho and theta of lines are compared without the jumps where rho changes sign or theta wraps, and rho is measured
  from the middle of the expected shaft: from a corner of the image it is mostly theta times the distance.
- Steps of the lumped error are those of the random walk alone: the share of 1 % of the base joints' motion, in a branch
  of the released code, needs readings of those joints.

A frame's likelihood is the product over cameras, as published, and over tips and shaft.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from surgbench.config import Positive
from surgbench.contract import Estimate, InstrumentTracker, Observation, Scene, Trace, View
from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray
from surgbench.objective import LossWeights, Objective
from surgbench.silhouette import KeypointProjector
from surgbench.state import split_arms
from surgbench.trackers.observations.edges import detect_edges
from surgbench.trackers.observations.likelihood import association_likelihood, point_costs
from surgbench.trackers.observations.lines import LineConfig, ShaftLines
from surgbench.trackers.observations.lumped_error import CloudConfig, Features, LumpedErrorFilter, Particles


class ParticleFilterConfig(CloudConfig, LineConfig):
    """Options; where the publication or its code gives a value, it is the default."""

    point_rate: Annotated[Positive, Field(description="gamma of the tips, per pixel")] = 0.15
    point_threshold_px: Annotated[Positive, Field(description="tips farther apart are no pair")] = 20.0
    lost_iou: Annotated[float, Field(ge=0, le=1, description="an estimate that overlaps less is lost")] = 0.5


class MaskFeatures:
    """The two tips, and the edges of the shaft in the mask.

    Args:
        config: Options.
        scene: Instruments and cameras.
        arm: Which.
    """

    def __init__(self, config: ParticleFilterConfig, scene: Scene, arm: int) -> None:
        self._config, self._arm = config, arm
        instrument = scene.instruments[arm]
        self._lines = ShaftLines(config, instrument) if config.shaft else None
        self._projectors = [KeypointProjector([instrument], view.camera) for view in scene.views]

    def likelihood(self, index: int, view: View, particles: Particles) -> FloatArray:
        """See :class:`~surgbench.trackers.observations.lumped_error.Features`."""
        config = self._config
        likelihood = np.ones(len(particles.weights))
        tips = view.keypoints[self._arm]
        if tips is not None:
            projected = self._projectors[index].project(particles.states)[:, 0]
            costs = point_costs(projected, tips, config.point_rate)
            likelihood = association_likelihood(costs, config.point_rate * config.point_threshold_px)
        if self._lines is not None:
            found = self._lines.likelihood(particles, view.camera, partial(detect_edges, view.mask))
            if found is not None:
                likelihood = likelihood * found
        return likelihood


class ParticleFilterTracker(InstrumentTracker):
    """Tracks what calibration and readings together are wrong by, from the two tips and the shaft's two edges."""

    name: ClassVar[str] = "particle-filter"
    summary: ClassVar[str] = "Richter et al.'s lumped-error particle filter; needs kinematics and readings"

    Config: ClassVar[type[Any]] = ParticleFilterConfig

    def __init__(self, config: Any = None) -> None:
        self.config: Any = config or self.Config()
        self.trace: Trace | None = None

    def reset(self, scene: Scene, state: FloatArray, rng: np.random.Generator) -> None:
        """Spread the particles of each arm around ``state``.

        Raises:
            ConfigError: The dataset has no kinematics, or the instrument no shaft.
        """
        if scene.T_cam_base is None:
            raise ConfigError(self._needs_kinematics)
        self._objective = Objective(scene, LossWeights())
        self._arms = [
            LumpedErrorFilter(self.config, scene, arm, one, rng, self._features(scene, arm), self._needs_kinematics)
            for arm, one in enumerate(split_arms(state))
        ]

    def step(self, observation: Observation) -> Estimate:
        """Move, weigh and average the particles. ``observation.start`` plays no part.

        Raises:
            ConfigError: There are no kinematics or no readings, not even of earlier frames.
        """
        state = np.concatenate([arm.step(observation) for arm in self._arms])
        if self.trace is not None:
            states, weights = zip(*(arm.ranked() for arm in self._arms), strict=True)
            losses = [-np.log(np.maximum(one, np.finfo(float).tiny)) for one in weights]
            self.trace.states.append(np.concatenate(states, axis=1))
            self.trace.losses.append(np.sum(losses, axis=0))
        return self._estimate(state, observation)

    def _estimate(self, state: FloatArray, observation: Observation) -> Estimate:
        """The state with how sure it is: by how much of the mask it overlaps."""
        self._objective.observe(observation)
        overlap = float(self._objective.mismatch(state[None])[1][0])
        return Estimate(state, confidence=overlap, lost=overlap < self.config.lost_iou)

    @property
    def _needs_kinematics(self) -> str:
        return f"{self.name} needs kinematics: a dataset with them, and --joints"

    def _features(self, scene: Scene, arm: int) -> Features:
        """What an arm's particles are weighed by."""
        return MaskFeatures(self.config, scene, arm)
