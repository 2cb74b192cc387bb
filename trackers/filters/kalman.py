"""Constant-velocity Kalman filter over the state (Hu et al. 2026, eq. 13 and 14)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from surgbench.config import Section
from surgbench.contract import Plugin, Scene
from surgbench.geometry import FloatArray, wrap_angle
from surgbench.state import POSITION, STATE_SIZE, clip_joints
from surgbench.timing import carried_s


@dataclass(frozen=True)
class Noise:
    """Diagonals of Q and R, as standard deviations of [alpha, beta, gamma, x, y, z, q1, q2, q3].

    Attributes:
        value: ``(9,)`` process noise of the values, per frame.
        velocity: ``(9,)`` process noise of the velocities, per second, per frame.
        measurement: ``(9,)`` noise of a tracker's estimates.
        first_value: ``(9,)`` uncertainty of the first state.
        first_velocity: ``(9,)`` uncertainty of the first velocities, per second.
    """

    value: FloatArray
    velocity: FloatArray
    measurement: FloatArray
    first_value: FloatArray
    first_velocity: FloatArray


# The figures of the paper's released code (variances there). It takes a frame for 1/20 s whatever the recording says.
PUBLISHED_DT_S = 1 / 20
PUBLISHED = Noise(
    value=np.sqrt([2e-5, 1e-4, 2e-5, 2e-5, 2e-5, 2e-5, 1e-4, 1e-4, 1e-4]),
    velocity=np.sqrt([2e-4, 1e-3, 2e-4, 2e-4, 2e-4, 2e-4, 1e-3, 1e-3, 1e-3]),
    measurement=np.sqrt([2e-3, 1e-2, 2e-3, 2e-3, 2e-3, 2e-3, 5e-3, 5e-3, 5e-3]),
    first_value=np.full(STATE_SIZE, 0.1),
    first_velocity=np.full(STATE_SIZE, 0.1),
)
# Ours. A silhouette shows alpha, x and y well: their velocities may follow the estimates. It shows the others
# badly, and a velocity made of their errors sends the next search astray, so that theirs hardly move and the
# values follow the estimates instead (docs/trackers.md has the comparison).
TUNED = Noise(
    value=np.array([8e-3, 2e-2, 8e-3, 1e-3, 1e-3, 1e-3, 1.4e-2, 1.4e-2, 1e-2]),
    velocity=np.array([3.6e-2, 3e-3, 1.2e-3, 4.5e-3, 4.5e-3, 1.5e-4, 2.1e-3, 2.1e-3, 1.5e-3]),
    measurement=np.array([1e-3, 1e-2, 5e-3, 5e-5, 5e-5, 3e-4, 1e-2, 1e-2, 5e-3]),
    first_value=np.array([1e-3, 1e-2, 5e-3, 5e-5, 5e-5, 3e-4, 1e-2, 1e-2, 5e-3]),
    first_velocity=np.array([0.18, 0.015, 0.006, 0.022, 0.022, 7.5e-4, 0.01, 0.01, 7.5e-3]),
)

Factor = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class KalmanFilter(Plugin):
    """Each component has its own value and velocity; the covariances do not mix components."""

    name: ClassVar[str] = "kalman"
    summary: ClassVar[str] = "constant-velocity Kalman filter, joints clamped to their limits"

    class Config(Section):
        """Options; factors multiply standard deviations."""

        noise: Annotated[
            Literal["tuned", "published"],
            Field(description="ours; or that of the paper's released code, which has 1/20 s a frame and one speed"),
        ] = "tuned"
        start: Annotated[
            Literal["auto", "predicted", "filtered"],
            Field(description="where the next search begins; auto: predicted, with published noise filtered"),
        ] = "auto"
        velocity_noise: Annotated[Factor, Field(description="factor on the velocities' process noise")] = 1.0
        fast_velocity_noise: Annotated[
            Factor, Field(description="further factor for fast motion, with tuned noise")
        ] = 5.0
        measurement_noise: Annotated[Factor, Field(description="factor on the measurement noise")] = 1.0
        speed: Annotated[
            Literal["auto", "nominal", "fast"], Field(description="auto: as the dataset says of the sequence")
        ] = "auto"

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

    def reset(self, scene: Scene, state: FloatArray) -> None:
        """Start at rest at ``state``, ``(9 * arms,)``."""
        config = self.config
        published = config.noise == "published"
        noise = PUBLISHED if published else TUNED
        speed = scene.speed if config.speed == "auto" else config.speed
        fast = speed == "fast" and not published
        faster = config.velocity_noise * (config.fast_velocity_noise if fast else 1.0)
        self._limits = scene.joint_limits
        self._dt_s = PUBLISHED_DT_S if published else scene.dt_s
        self._scene_dt_s = scene.dt_s
        self._frames = self._carried = 1.0  # of the step to come: its length, and that of its motion
        self._starts_filtered = config.start == "filtered" or (published and config.start == "auto")
        self._measurement = np.tile((noise.measurement * config.measurement_noise) ** 2, scene.arms)
        process = np.stack([noise.value**2, (noise.velocity * faster) ** 2], axis=-1)
        first = np.stack([noise.first_value**2, (noise.first_velocity * faster) ** 2], axis=-1)
        is_angle = np.ones((scene.arms, STATE_SIZE), dtype=bool)
        is_angle[:, POSITION] = False
        self._is_angle = is_angle.reshape(-1)
        self._process: FloatArray = np.tile(process, (scene.arms, 1))
        self._value: FloatArray = np.array(state, dtype=np.float64)
        self._velocity: FloatArray = np.zeros_like(self._value)
        self._covariance: FloatArray = np.tile(first, (scene.arms, 1))[:, :, None] * np.eye(2)

    def elapse(self, dt_s: float) -> None:
        """How long it is to the frame to come: the noise is that of as many frames."""
        self._frames = dt_s / self._scene_dt_s
        self._carried = carried_s(dt_s, self._scene_dt_s) / self._scene_dt_s

    def predict(self) -> FloatArray:
        """Advance to the frame to come; returns where its search begins, joints within their limits."""
        dt = self._dt_s * self._carried
        filtered = self._value.copy()
        self._value = self._value + dt * self._velocity
        transition = np.array([[1.0, dt], [0.0, 1.0]])
        self._covariance = transition @ self._covariance @ transition.T
        self._covariance[:, [0, 1], [0, 1]] += self._process * self._frames
        self._value = clip_joints(self._value, self._limits)
        return filtered if self._starts_filtered else self._value.copy()

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
