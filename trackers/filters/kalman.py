"""Constant-velocity Kalman filter over the state (Hu et al. 2026, eq. 13 and 14)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from surgbench.contract import Plugin, Scene
from surgbench.geometry import FloatArray, wrap_angle
from surgbench.state import POSITION, STATE_SIZE, clip_joints

# Variances of the paper's released code: process noise of the values, and measurement noise.
PROCESS = np.array([2e-5, 1e-4, 2e-5, 2e-5, 2e-5, 2e-5, 1e-4, 1e-4, 1e-4])
MEASUREMENT = np.array([2e-3, 1e-2, 2e-3, 2e-3, 2e-3, 2e-3, 5e-3, 5e-3, 5e-3])
FIRST_VARIANCE = 1e-2

Factor = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class KalmanFilter(Plugin):
    """Each component has its own value and velocity; the covariances do not mix components."""

    name: ClassVar[str] = "kalman"
    summary: ClassVar[str] = "constant-velocity Kalman filter, joints clamped to their limits"

    class Config(BaseModel):
        """Options; noise factors multiply the published variances."""

        model_config = ConfigDict(frozen=True, extra="forbid")

        velocity_noise_nominal: Annotated[
            Factor, Field(description="velocity noise over value noise, nominal motion")
        ] = 10.0
        velocity_noise_fast: Annotated[Factor, Field(description="the same for fast motion")] = 100.0
        measurement_noise: Annotated[Factor, Field(description="factor on the measurement noise")] = 1.0
        speed: Annotated[
            Literal["auto", "nominal", "fast"], Field(description="auto: as the dataset says of the sequence")
        ] = "auto"

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

    def reset(self, scene: Scene, state: FloatArray) -> None:
        """Start at rest at ``state``, ``(9 * arms,)``."""
        config = self.config
        speed = scene.speed if config.speed == "auto" else config.speed
        ratio = config.velocity_noise_fast if speed == "fast" else config.velocity_noise_nominal
        process = np.tile(PROCESS, scene.arms)
        self._limits = scene.limits[0]
        self._dt_s = scene.dt_s
        self._measurement = np.tile(MEASUREMENT, scene.arms) * config.measurement_noise
        self._process = np.stack([process, process * ratio], axis=-1)
        is_angle = np.ones((scene.arms, STATE_SIZE), dtype=bool)
        is_angle[:, POSITION] = False
        self._is_angle = is_angle.reshape(-1)
        self._value: FloatArray = np.array(state, dtype=np.float64)
        self._velocity: FloatArray = np.zeros_like(self._value)
        self._covariance: FloatArray = np.tile(FIRST_VARIANCE * np.eye(2), (len(self._value), 1, 1))

    def predict(self) -> FloatArray:
        """Advance by one frame; returns the predicted state, joints within their limits."""
        dt = self._dt_s
        self._value = self._value + dt * self._velocity
        transition = np.array([[1.0, dt], [0.0, 1.0]])
        self._covariance = transition @ self._covariance @ transition.T
        self._covariance[:, [0, 1], [0, 1]] += self._process
        self._value = clip_joints(self._value, self._limits)
        return self._value.copy()

    def update(self, estimate: FloatArray) -> FloatArray:
        """Take a frame's estimate in; returns the filtered state, joints within their limits."""
        innovation = estimate - self._value
        innovation[self._is_angle] = wrap_angle(innovation[self._is_angle])
        column = self._covariance[:, :, 0]
        gain = column / (column[:, :1] + self._measurement[:, None])
        self._value = clip_joints(self._value + gain[:, 0] * innovation, self._limits)
        self._velocity = self._velocity + gain[:, 1] * innovation
        self._covariance = self._covariance - gain[:, :, None] * self._covariance[:, :1, :]
        return self._value.copy()
