"""What else a tracker sees: tip keypoints and joint readings with the errors of real ones."""

from __future__ import annotations

import numpy as np

from surgbench.camera import Camera
from surgbench.generators.presets import Keypoints, Readings
from surgbench.generators.trajectories import ornstein_uhlenbeck
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.state import JOINTS


def observe_keypoints(
    states: FloatArray, instrument: Instrument, camera: Camera, settings: Keypoints, rng: np.random.Generator
) -> FloatArray:
    """Tip keypoints of one arm with noise and drop-outs.

    Args:
        states: ``(frames, 9)`` true states.
        instrument: For its tips.
        camera: Intrinsics.
        settings: Noise and drop-outs.
        rng: The only source of randomness.

    Returns:
        ``(frames, 2, 2)`` pixels (u, v), the two tips in random order; NaN where one dropped out or is outside the
        image.
    """
    tips = camera.project(instrument.tips_cam(states))
    seen: FloatArray = tips + settings.noise_px * rng.standard_normal(tips.shape)
    lost = ~camera.contains(seen) | (rng.random(seen.shape[:2]) < settings.dropout)
    seen[lost] = np.nan
    swapped = rng.random(len(seen)) < 0.5
    seen[swapped] = seen[swapped][:, ::-1]
    return seen


def observe_joints(states: FloatArray, settings: Readings, rng: np.random.Generator) -> FloatArray:
    """Noisy joint readings of one arm.

    Args:
        states: ``(frames, 9)`` true states.
        settings: Bias, drift and noise.
        rng: The only source of randomness.

    Returns:
        ``(frames, 3)`` radians, raw: they may lie outside the limits.
    """
    joints = states[:, JOINTS]
    bias = settings.bias_rad * rng.standard_normal(3)
    drift = settings.drift_rad * ornstein_uhlenbeck(joints.shape, settings.drift_rho, rng)
    noise = settings.noise_rad * rng.standard_normal(joints.shape)
    readings: FloatArray = joints + bias + drift + noise
    return readings
