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

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from surgbench.config import NotNegative, Positive, Section
from surgbench.contract import Estimate, InstrumentTracker, Observation, Scene, Trace, View
from surgbench.errors import ConfigError
from surgbench.geometry import (
    FloatArray,
    inverse_transform,
    look_at_angles,
    look_at_rotation,
    rigid_transform,
    rotation_from_vector,
)
from surgbench.objective import LossWeights, Objective
from surgbench.silhouette import KeypointProjector
from surgbench.state import ANGLES, JOINTS, POSITION, STATE_SIZE, split_arms
from surgbench.timing import step_s
from surgbench.trackers.observations.edges import Gate, detect_edges, expected_edges
from surgbench.trackers.observations.likelihood import association_likelihood, line_costs, point_costs
from surgbench.trackers.observations.particles import ParticleCloud
from surgbench.trackers.observations.shaft import cylinder_edges, shaft_of

# The published noise of the motion model is that of a frame at this rate.
PUBLISHED_RATE_HZ = 30.0


class ParticleFilterConfig(Section):
    """Options; where the publication or its code gives a value, it is the default."""

    particles: Annotated[int, Field(ge=2, description="particles of each arm (1000 in Hu et al.'s comparison)")] = 200
    init_position_m: Annotated[NotNegative, Field(description="spread of the first lumped errors' translation")] = 1e-3
    init_rotation_rad: Annotated[NotNegative, Field(description="spread of the first lumped errors' rotation")] = 1e-2
    walk_position_m: Annotated[NotNegative, Field(description="random step of the translation in 1/30 s")] = 5e-5
    walk_rotation_rad: Annotated[NotNegative, Field(description="random step of the rotation in 1/30 s")] = 5e-4
    joint_errors: Annotated[bool, Field(description="also estimate the errors of the three joint readings")] = True
    init_joint_rad: Annotated[NotNegative, Field(description="spread of the first joint errors")] = 0.02
    walk_joint_rad: Annotated[NotNegative, Field(description="random step of the joint errors in 1/30 s")] = 2e-3
    point_rate: Annotated[Positive, Field(description="gamma of the tips, per pixel")] = 0.15
    point_threshold_px: Annotated[Positive, Field(description="tips farther apart are no pair")] = 20.0
    shaft: Annotated[bool, Field(description="observe the two edges of the shaft")] = True
    rho_rate: Annotated[NotNegative, Field(description="gamma of the edges' offsets, per pixel")] = 0.05
    theta_rate: Annotated[NotNegative, Field(description="gamma of the edges' directions, per radian")] = 7.5
    rho_threshold_px: Annotated[Positive, Field(description="with the next: edges farther apart are no pair")] = 75.0
    theta_threshold_rad: Annotated[Positive, Field(description="see rho_threshold_px")] = 0.5
    gate_px: Annotated[Positive, Field(description="edges are sought so far from the expected ones")] = 40.0
    gate_rad: Annotated[Positive, Field(le=0.5, description="and turned by so much")] = 0.2
    edge_points: Annotated[int, Field(ge=3, description="rows or columns in which an edge must show")] = 20
    resample_below: Annotated[
        float, Field(ge=0, le=1, description="resample where N_eff is below this share of the particles")
    ] = 0.5
    lost_iou: Annotated[float, Field(ge=0, le=1, description="an estimate that overlaps less is lost")] = 0.5


class LumpedErrorFilter:
    """The particles of one arm: ``p_cam = T_cam_base T(x) T_0 T_base_tool p``.

    A particle is ``[t, r]``, metres and an angle-axis vector in the base frame, and where asked for the three joint
    errors: ``joints = reading + e``.

    Args:
        config: Options.
        scene: Instruments, cameras, places of the bases.
        arm: Which.
        state: ``(9,)`` of the first frame; its pose is the middle of the first particles.
        rng: The only source of randomness.

    Attributes:
        cloud: The particles.
        resampled: Whether the last step drew them anew.
    """

    def __init__(
        self, config: ParticleFilterConfig, scene: Scene, arm: int, state: FloatArray, rng: np.random.Generator
    ) -> None:
        assert scene.T_cam_base is not None
        self._config, self._arm = config, arm
        self._limits = scene.limits[arm]
        self._T_cam_base = np.asarray(scene.T_cam_base[arm], dtype=np.float64)
        self._first_pose = rigid_transform(look_at_rotation(state[ANGLES]), state[POSITION])
        self._T_0: FloatArray | None = None
        self._readings: tuple[FloatArray, FloatArray] | None = None
        instrument = scene.instruments[arm]
        self._shaft = shaft_of(instrument) if config.shaft else None
        self._projectors = [KeypointProjector([instrument], view.camera) for view in scene.views]
        self._gate = Gate(config.gate_px, config.gate_rad, config.edge_points)

        def deviations(position: float, rotation: float, joint: float) -> FloatArray:
            return np.repeat([position, rotation, joint][: 3 if config.joint_errors else 2], 3)

        first = deviations(config.init_position_m, config.init_rotation_rad, config.init_joint_rad)
        step = deviations(config.walk_position_m, config.walk_rotation_rad, config.walk_joint_rad)
        self._step = step * np.sqrt(scene.dt_s * PUBLISHED_RATE_HZ)
        self._dt_s, self._last_s = scene.dt_s, 0.0
        self.cloud = ParticleCloud(first, config.particles, rng)
        self.resampled = False

    def step(self, observation: Observation) -> FloatArray:
        """Take a frame in. Where its readings are missing, the last ones stand for them.

        Returns:
            ``(9,)`` weighted mean of the particles' states.

        Raises:
            ConfigError: There are no readings, nor were there ever any.
        """
        if observation.kinematics is not None and observation.joints is not None:
            T_base_tool = np.asarray(observation.kinematics[self._arm], dtype=np.float64)
            self._readings = T_base_tool, observation.joints.reshape(-1, 3)[self._arm]
        if self._readings is None:
            raise ConfigError(NEEDS_KINEMATICS)
        T_base_tool, joint_readings = self._readings
        if self._T_0 is None:
            self._T_0 = inverse_transform(self._T_cam_base) @ self._first_pose @ inverse_transform(T_base_tool)
        else:
            elapsed_s = step_s(self._last_s, observation.timestamp_s, self._dt_s)
            self.cloud.walk(self._step * np.sqrt(elapsed_s / self._dt_s))
        self._last_s = observation.timestamp_s
        rotations, translations, joints = self._places(T_base_tool, joint_readings)
        for index, view in enumerate(observation.views):
            self.cloud.weigh(self._likelihood(index, view, rotations, translations, joints))
        weights = self.cloud.weights
        mean = np.empty(STATE_SIZE)
        mean[ANGLES] = look_at_angles(_mean_rotation(rotations, weights))
        mean[POSITION] = weights @ translations
        mean[JOINTS] = self._limits.clip(weights @ joints)
        self._weighed = rotations, translations, joints, weights
        self.resampled = self.cloud.resample(self._config.resample_below)
        return mean

    def ranked(self) -> tuple[FloatArray, FloatArray]:
        """States ``(particles, 9)`` of the last step and their weights before resampling, heaviest first."""
        rotations, translations, joints, weights = self._weighed
        order = np.argsort(-weights, kind="stable")
        return _states(rotations, translations, joints)[order], weights[order]

    def _places(self, T_base_tool: FloatArray, readings: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rotations ``(n, 3, 3)`` and translations ``(n, 3)`` T_cam_tool, and joints ``(n, 3)``, of all particles."""
        assert self._T_0 is not None
        x, T = self.cloud.values, self._T_0 @ T_base_tool
        turned = self._T_cam_base[:3, :3] @ rotation_from_vector(x[:, 3:6])
        shift = self._T_cam_base[:3, :3] @ x[:, :3, None]
        errors = x[:, 6:9] if self._config.joint_errors else np.zeros((len(x), 3))
        translations = turned @ T[:3, 3] + shift[..., 0] + self._T_cam_base[:3, 3]
        return turned @ T[:3, :3], translations, self._limits.clip(readings + errors)

    def _likelihood(
        self, index: int, view: View, rotations: FloatArray, translations: FloatArray, joints: FloatArray
    ) -> FloatArray:
        config = self._config
        rotations = view.T_view_cam[:3, :3] @ rotations
        translations = translations @ view.T_view_cam[:3, :3].T + view.T_view_cam[:3, 3]
        likelihood = np.ones(len(joints))
        tips = view.keypoints[self._arm]
        if tips is not None:
            projected = self._projectors[index].project(_states(rotations, translations, joints))[:, 0]
            costs = point_costs(projected, tips, config.point_rate)
            likelihood = association_likelihood(costs, config.point_rate * config.point_threshold_px)
        if self._shaft is not None:
            weights = self.cloud.weights
            middle = _mean_rotation(rotations, weights), weights @ translations
            expected, span_px = expected_edges(*middle, self._shaft, view.camera)
            found = detect_edges(view.mask, expected, span_px, self._gate)
            axis = rotations[:, :, :2] @ self._shaft.axis_m + translations
            edges = cylinder_edges(axis, rotations[:, :, 2], self._shaft.radius_m, view.camera)
            if len(found):
                origin = _middle_of_image_part(span_px, view)
                costs = line_costs(_about(edges, origin), _about(found, origin), config.rho_rate, config.theta_rate)
                threshold = config.rho_rate * config.rho_threshold_px + config.theta_rate * config.theta_threshold_rad
                likelihood = likelihood * association_likelihood(costs, threshold)
        return likelihood


def _mean_rotation(rotations: FloatArray, weights: FloatArray) -> FloatArray:
    """The rotation nearest to all ``(n, 3, 3)`` (least squares of the matrices' elements), ``(3, 3)``."""
    left, _, right = np.linalg.svd((weights @ rotations.reshape(-1, 9)).reshape(3, 3))
    left[:, 2] *= np.sign(np.linalg.det(left @ right))
    return np.asarray(left @ right)


def _states(rotations: FloatArray, translations: FloatArray, joints: FloatArray) -> FloatArray:
    return np.concatenate([look_at_angles(rotations), translations, joints], axis=1)


def _middle_of_image_part(span_px: FloatArray, view: View) -> FloatArray:
    """Middle of that part of the shaft's expected axis which lies in the image, roughly: clamped end points."""
    corner = np.array([view.camera.width - 1.0, view.camera.height - 1.0])
    middle: FloatArray = np.clip(span_px, 0.0, corner).mean(axis=0)
    return middle


def _about(lines: FloatArray, origin_px: FloatArray) -> FloatArray:
    """The same lines with rho measured from another origin."""
    moved = lines.copy()
    moved[..., 2] -= lines[..., :2] @ origin_px
    return moved


class ParticleFilterTracker(InstrumentTracker):
    """Tracks what calibration and readings together are wrong by, from the two tips and the shaft's two edges."""

    name: ClassVar[str] = "particle-filter"
    summary: ClassVar[str] = "Richter et al.'s lumped-error particle filter; needs kinematics and readings"

    Config = ParticleFilterConfig

    def __init__(self, config: ParticleFilterConfig | None = None) -> None:
        self.config = config or self.Config()
        self.trace: Trace | None = None

    def reset(self, scene: Scene, state: FloatArray, rng: np.random.Generator) -> None:
        """Spread the particles of each arm around ``state``.

        Raises:
            ConfigError: The dataset has no kinematics, or the instrument no shaft.
        """
        if scene.T_cam_base is None:
            raise ConfigError(NEEDS_KINEMATICS)
        self._objective = Objective(scene, LossWeights())
        self._arms = [LumpedErrorFilter(self.config, scene, arm, one, rng) for arm, one in enumerate(split_arms(state))]

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
        self._objective.observe(observation)
        overlap = float(self._objective.mismatch(state[None])[1][0])
        return Estimate(state, confidence=overlap, lost=overlap < self.config.lost_iou)


NEEDS_KINEMATICS = "particle-filter needs kinematics: a dataset with them, and --joints"
