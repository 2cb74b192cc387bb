"""The particles of one arm over the lumped error of the robot's kinematics (Richter et al., arXiv 2102.06235)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Protocol

import numpy as np
from pydantic import Field

from surgbench.config import NotNegative, Section
from surgbench.contract import Observation, Scene, View
from surgbench.errors import ConfigError
from surgbench.geometry import (
    FloatArray,
    inverse_transform,
    look_at_angles,
    look_at_rotation,
    rigid_transform,
    rotation_from_vector,
)
from surgbench.state import ANGLES, JOINTS, POSITION, STATE_SIZE
from surgbench.timing import step_s
from surgbench.trackers.observations.particles import ParticleCloud

# The published noise of the motion model is that of a frame at this rate.
PUBLISHED_RATE_HZ = 30.0


class CloudConfig(Section):
    """Options of the particles; where the publication or its code gives a value, it is the default."""

    particles: Annotated[int, Field(ge=2, description="particles of each arm (1000 in Hu et al.'s comparison)")] = 200
    init_position_m: Annotated[NotNegative, Field(description="spread of the first lumped errors' translation")] = 1e-3
    init_rotation_rad: Annotated[NotNegative, Field(description="spread of the first lumped errors' rotation")] = 1e-2
    walk_position_m: Annotated[NotNegative, Field(description="random step of the translation in 1/30 s")] = 5e-5
    walk_rotation_rad: Annotated[NotNegative, Field(description="random step of the rotation in 1/30 s")] = 5e-4
    joint_errors: Annotated[bool, Field(description="also estimate the errors of the three joint readings")] = True
    init_joint_rad: Annotated[NotNegative, Field(description="spread of the first joint errors")] = 0.02
    walk_joint_rad: Annotated[NotNegative, Field(description="random step of the joint errors in 1/30 s")] = 2e-3
    resample_below: Annotated[
        float, Field(ge=0, le=1, description="resample where N_eff is below this share of the particles")
    ] = 0.5


@dataclass(frozen=True)
class Particles:
    """All particles of an arm as states in a camera's frame.

    Attributes:
        rotations: ``(n, 3, 3)`` of T_cam_tool.
        translations_m: ``(n, 3)``.
        joints: ``(n, 3)``.
        weights: ``(n,)``, sum 1.
    """

    rotations: FloatArray
    translations_m: FloatArray
    joints: FloatArray
    weights: FloatArray

    @cached_property
    def states(self) -> FloatArray:
        """``(n, 9)``."""
        return np.concatenate([look_at_angles(self.rotations), self.translations_m, self.joints], axis=1)

    @cached_property
    def mean_rotation(self) -> FloatArray:
        """The rotation nearest to all (least squares of the matrices' elements), ``(3, 3)``."""
        left, _, right = np.linalg.svd((self.weights @ self.rotations.reshape(-1, 9)).reshape(3, 3))
        left[:, 2] *= np.sign(np.linalg.det(left @ right))
        return np.asarray(left @ right)

    @cached_property
    def mean_state(self) -> FloatArray:
        """``(9,)`` weighted mean."""
        mean = np.empty(STATE_SIZE)
        mean[ANGLES] = look_at_angles(self.mean_rotation)
        mean[POSITION] = self.weights @ self.translations_m
        mean[JOINTS] = self.weights @ self.joints
        return mean

    def seen_by(self, view: View, weights: FloatArray) -> Particles:
        """The same in the frame of a view's camera, with other weights."""
        rotation, shift = view.T_view_cam[:3, :3], view.T_view_cam[:3, 3]
        return Particles(rotation @ self.rotations, self.translations_m @ rotation.T + shift, self.joints, weights)


class Features(Protocol):
    """What an arm's particles are weighed by."""

    def likelihood(self, index: int, view: View, particles: Particles) -> FloatArray:
        """``(n,)`` up to a factor, from what one view shows.

        Args:
            index: Of the view.
            view: What it shows in this frame.
            particles: In the frame of its camera.
        """
        ...


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
        features: What particles are weighed by.
        needs_kinematics: What to say where there are none.

    Attributes:
        cloud: The particles.
        resampled: Whether the last step drew them anew.
    """

    def __init__(
        self,
        config: CloudConfig,
        scene: Scene,
        arm: int,
        state: FloatArray,
        rng: np.random.Generator,
        features: Features,
        needs_kinematics: str,
    ) -> None:
        assert scene.T_cam_base is not None
        self._config, self._arm, self._needs_kinematics = config, arm, needs_kinematics
        self._limits = scene.limits[arm]
        self._T_cam_base = np.asarray(scene.T_cam_base[arm], dtype=np.float64)
        self._first_pose = rigid_transform(look_at_rotation(state[ANGLES]), state[POSITION])
        self._T_0: FloatArray | None = None
        self._readings: tuple[FloatArray, FloatArray] | None = None
        self._features = features

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
            raise ConfigError(self._needs_kinematics)
        T_base_tool, joint_readings = self._readings
        if self._T_0 is None:
            self._T_0 = inverse_transform(self._T_cam_base) @ self._first_pose @ inverse_transform(T_base_tool)
        else:
            elapsed_s = step_s(self._last_s, observation.timestamp_s, self._dt_s)
            self.cloud.walk(self._step * np.sqrt(elapsed_s / self._dt_s))
        self._last_s = observation.timestamp_s
        prior = self._placed(T_base_tool, joint_readings)
        for index, view in enumerate(observation.views):
            self.cloud.weigh(self._features.likelihood(index, view, prior.seen_by(view, self.cloud.weights)))
        self._weighed = Particles(prior.rotations, prior.translations_m, prior.joints, self.cloud.weights)
        mean = self._weighed.mean_state
        mean[JOINTS] = self._limits.clip(mean[JOINTS])
        self.resampled = self.cloud.resample(self._config.resample_below)
        return mean

    def ranked(self) -> tuple[FloatArray, FloatArray]:
        """States ``(particles, 9)`` of the last step and their weights before resampling, heaviest first."""
        order = np.argsort(-self._weighed.weights, kind="stable")
        return self._weighed.states[order], self._weighed.weights[order]

    def _placed(self, T_base_tool: FloatArray, readings: FloatArray) -> Particles:
        """All particles in the reference camera's frame."""
        assert self._T_0 is not None
        x, T = self.cloud.values, self._T_0 @ T_base_tool
        turned = self._T_cam_base[:3, :3] @ rotation_from_vector(x[:, 3:6])
        shift = self._T_cam_base[:3, :3] @ x[:, :3, None]
        errors = x[:, 6:9] if self._config.joint_errors else np.zeros((len(x), 3))
        translations = turned @ T[:3, 3] + shift[..., 0] + self._T_cam_base[:3, 3]
        return Particles(turned @ T[:3, :3], translations, self._limits.clip(readings + errors), self.cloud.weights)
