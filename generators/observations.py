"""What else a tracker sees: tip keypoints, joint readings and tool poses with the errors of real ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.generators.presets import Keypoints, Readings
from surgbench.generators.sections import Kinematics
from surgbench.generators.trajectories import ornstein_uhlenbeck
from surgbench.geometry import (
    FloatArray,
    inverse_transform,
    look_at_rotation,
    rigid_transform,
    rotation_from_vector,
)
from surgbench.instrument import Instrument
from surgbench.instrument.arm import Manipulator
from surgbench.state import ANGLES, JOINTS, POSITION

# A joint faster than this has its cables nearly fully stretched.
STRETCH_RAD_S = 0.02
STRETCH_M_S = 0.002


@dataclass(frozen=True)
class Kinematic:
    """What a robot says of one of its tools.

    Attributes:
        T_cam_base: ``(4, 4)`` nominal place of its base.
        T_base_tool: ``(frames, 4, 4)`` its readings of where the wrist-pitch frame is.
    """

    T_cam_base: FloatArray
    T_base_tool: FloatArray


def observe_keypoints(
    states: FloatArray,
    instrument: Instrument,
    camera: Camera,
    settings: Keypoints,
    rng: np.random.Generator,
    hidden: NDArray[np.bool_] | None = None,
) -> FloatArray:
    """Tip keypoints of one arm with noise and drop-outs.

    Args:
        states: ``(frames, 9)`` true states.
        instrument: For its tips.
        camera: Intrinsics and distortion.
        settings: Noise and drop-outs.
        rng: The only source of randomness.
        hidden: ``(frames, 2)`` tips that something hides; none unless told.

    Returns:
        ``(frames, 2, 2)`` pixels (u, v), the two tips in random order; NaN where one dropped out, is hidden, or is
        outside the image.
    """
    tips = camera.see(instrument.tips_cam(states))
    seen: FloatArray = tips + settings.noise_px * rng.standard_normal(tips.shape)
    lost = ~camera.contains(seen) | (rng.random(seen.shape[:2]) < settings.dropout)
    if hidden is not None:
        lost |= hidden
    seen[lost] = np.nan
    swapped = rng.random(len(seen)) < 0.5
    seen[swapped] = seen[swapped][:, ::-1]
    return seen


def observe_joints(states: FloatArray, settings: Readings, dt_s: float, rng: np.random.Generator) -> FloatArray:
    """Noisy joint readings of one arm.

    Args:
        states: ``(frames, 9)`` true states.
        settings: Bias, drift, stretch and noise.
        dt_s: Seconds between frames.
        rng: The only source of randomness.

    Returns:
        ``(frames, 3)`` radians, raw: they may lie outside the limits.
    """
    joints = states[:, JOINTS]
    bias = settings.bias_rad * rng.standard_normal(3)
    drift = settings.drift_rad * ornstein_uhlenbeck(joints.shape, settings.drift_rho, rng)
    noise = settings.noise_rad * rng.standard_normal(joints.shape)
    readings: FloatArray = joints + bias + drift + noise
    if settings.stretch_rad:
        readings += settings.stretch_rad * cable_tension(joints, dt_s, STRETCH_RAD_S)
    return readings


def lagged(values: FloatArray, frames: float) -> FloatArray:
    """What a robot's log says that is behind the images: the first and last values go on beyond the ends.

    Args:
        values: ``(frames, n)`` of a sequence; angles may be wrapped.
        frames: How far it is behind; below 0 it is ahead.

    Returns:
        ``(frames, n)``.
    """
    if frames == 0.0:
        return values
    times = np.arange(len(values), dtype=np.float64)
    unwrapped = np.unwrap(values, axis=0)
    return np.stack([np.interp(times - frames, times, column) for column in unwrapped.T], axis=1)


def observe_free_tool(states: FloatArray, settings: Kinematics, rng: np.random.Generator) -> Kinematic:
    """Tool poses of one arm where no robot moves it: the true ones, disturbed by one slowly changing transform.

    The base frame is the camera's, but for the error of the hand-eye calibration, which is the constant part.

    Args:
        states: ``(frames, 9)`` true states.
        settings: Hand-eye calibration, drift and noise.
        rng: The only source of randomness.
    """
    constant = _six(settings.hand_eye_rad, settings.hand_eye_m) * rng.standard_normal(6)
    shape = (len(states), 6)
    drift = _six(settings.drift_rad, settings.drift_m) * ornstein_uhlenbeck(shape, settings.drift_rho, rng)
    noise = _six(settings.noise_rad, settings.noise_m) * rng.standard_normal(shape)
    # T_cam_tool = T_cam_base T_lumped_error T_base_tool.
    error = _transform(constant + drift + noise)
    true = rigid_transform(look_at_rotation(states[:, ANGLES]), states[:, POSITION])
    return Kinematic(np.eye(4), inverse_transform(error) @ true)


def observe_arm(
    joints: FloatArray,
    arm: Manipulator,
    T_cam_base: FloatArray,
    settings: Kinematics,
    dt_s: float,
    rng: np.random.Generator,
) -> Kinematic:
    """Tool poses of one robot arm: the forward kinematics of what its encoders say.

    Args:
        joints: ``(frames, 4)`` true yaw, pitch, insertion, roll.
        arm: Its kinematics.
        T_cam_base: ``(4, 4)`` where its base truly is.
        settings: Hand-eye calibration, and the encoders' bias, drift, stretch and noise.
        dt_s: Seconds between frames.
        rng: The only source of randomness.
    """
    hand_eye = _transform(_six(settings.hand_eye_rad, settings.hand_eye_m) * rng.standard_normal(6))
    bias = _four(settings.bias_rad, settings.bias_m) * rng.standard_normal(4)
    drift = _four(settings.drift_rad, settings.drift_m) * ornstein_uhlenbeck(joints.shape, settings.drift_rho, rng)
    noise = _four(settings.noise_rad, settings.noise_m) * rng.standard_normal(joints.shape)
    tension = cable_tension(joints, dt_s, _four(STRETCH_RAD_S, STRETCH_M_S))
    stretch = _four(settings.stretch_rad, settings.stretch_m) * tension
    return Kinematic(T_cam_base @ inverse_transform(hand_eye), arm.forward(joints + bias + drift + stretch + noise))


def cable_tension(joints: FloatArray, dt_s: float, knee: FloatArray | float) -> FloatArray:
    """Which way and how fully friction stretches the cables between an encoder and its joint, -1 to 1.

    The sign of the joint's velocity, rounded off where the joint is slower than ``knee``.

    Args:
        joints: ``(frames, n)``.
        dt_s: Seconds between frames.
        knee: ``(n,)`` or a number, units per second.

    Returns:
        ``(frames, n)``.
    """
    velocity = np.gradient(joints, dt_s, axis=0)
    tension: FloatArray = velocity / np.hypot(velocity, knee)
    return tension


def _six(rad: float, metres: float) -> FloatArray:
    """Of a rotation vector and a translation."""
    return np.array([rad] * 3 + [metres] * 3)


def _four(rad: float, metres: float) -> FloatArray:
    """Of yaw, pitch, insertion, roll."""
    return np.array([rad, rad, metres, rad])


def _transform(errors: FloatArray) -> FloatArray:
    """``(..., 4, 4)`` of ``(..., 6)`` rotation vectors and translations."""
    return rigid_transform(rotation_from_vector(errors[..., :3]), errors[..., 3:])
