"""Trajectories of a left and a right arm: feasible waypoints, cubic Hermite steps, correlated noise, low-pass filter.

After Hu et al. 2026, section IV, except that waypoints are drawn from a workspace rather than taken from tracked
recordings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import butter, lfilter, sosfiltfilt

from surgbench.errors import ConfigError
from surgbench.generators.absences import with_absences
from surgbench.generators.coordinates import TOOL_JOINTS, ArmJoints, Coordinates, FreePose, set_up_arm
from surgbench.generators.crossings import Pair, crossing_path
from surgbench.generators.occluders import drawn_back_by, drawn_outside
from surgbench.generators.place import Place, clearance_m
from surgbench.generators.presets import Half, Motion, Preset
from surgbench.geometry import FloatArray, wrap_angle
from surgbench.instrument import Instrument
from surgbench.instrument.arm import ARM_JOINTS, INSERTION, Manipulator
from surgbench.state import BETA, GAMMA
from surgbench.tasks.instrument.format import ARMS

# Proposals looked at together, and how often each stage is tried before the one before it is done again.
BATCH = 32
BATCHES_PER_WAYPOINT = 4
PERTURBATIONS_PER_PATH = 40
PATHS = 60
# Where segments between waypoints are checked, as a share of the way from one to the next.
PATH_SAMPLES = np.linspace(0.0, 1.0, 9)


@dataclass(frozen=True)
class PairMotion:
    """How two arms move, left arm first.

    Attributes:
        states: ``(frames, 2, 9)``; beta and gamma wrapped into [-pi, pi).
        arms: What moves them, one per arm: ``None`` where they move freely.
    """

    states: FloatArray
    arms: tuple[ArmMotion | None, ArmMotion | None]


@dataclass(frozen=True)
class ArmMotion:
    """How a robot arm moves.

    Attributes:
        arm: Its kinematics.
        T_cam_base: ``(4, 4)`` where its base truly is.
        arm_joints: ``(frames, 4)`` yaw, pitch, insertion, roll.
    """

    arm: Manipulator
    T_cam_base: FloatArray
    arm_joints: FloatArray


def make_pair(preset: Preset, instrument: Instrument, half: Half, frames: int, rng: np.random.Generator) -> FloatArray:
    """States of :func:`make_motion`, ``(frames, 2, 9)``."""
    return make_motion(preset, instrument, half, frames, rng).states


def make_motion(
    preset: Preset, instrument: Instrument, half: Half, frames: int, rng: np.random.Generator
) -> PairMotion:
    """A trajectory of two arms.

    In every frame the joints lie within the instrument's generating limits, both tips and the wrist of each arm in
    the image, each shaft enters from its own side, and the arms' centre lines keep their clearance. Of robot arms, the
    joints are within the arm's limits and the wrist in the workspace too. Where the preset has absences, all this is so
    before the instruments are drawn back.

    Args:
        preset: Motion, workspace, camera and frame rate.
        instrument: Of both arms.
        half: Of the pairs, whose intervals and steps are taken: ``nominal`` or ``fast``.
        frames: How many.
        rng: The only source of randomness.

    Raises:
        ConfigError: The workspace is too tight for such a trajectory.
    """
    places = [Place(arm, preset.workspace, preset.camera, instrument) for arm in ARMS]
    interval = getattr(preset.motion.waypoint_interval, half)
    # Beside the main stream: what arms are drawn back does not change how they move.
    aside = rng.spawn(1)[0]
    for _ in range(PATHS):
        found = _smooth(places, preset, half, interval, frames, rng)
        if found is None:
            continue
        left, right, smooth = found
        for _ in range(PERTURBATIONS_PER_PATH):
            values = _perturb(smooth, left.sigma, preset, instrument, rng)
            fits = all(one.allows(values[:, index]) for index, one in enumerate((left, right)))
            states = np.stack([one.states(values[:, index]) for index, one in enumerate((left, right))], axis=1)
            apart = clearance_m(instrument, states[:, 0], states[:, 1])
            if fits and apart.min() >= preset.workspace.clearance_m:
                states[..., BETA] = wrap_angle(states[..., BETA])
                states[..., GAMMA] = wrap_angle(states[..., GAMMA])
                if preset.motion.absences is not None:
                    drawn_back = with_absences(preset.motion.absences, places, states, rng)
                    if drawn_back is None:
                        continue
                    states = drawn_back
                back = None
                if preset.occluders.outside:
                    back = drawn_outside(preset.occluders.outside, places, states, aside)
                    if back is None:
                        continue
                    states = drawn_back_by(states, back)
                return PairMotion(states, (_moved(left, values, 0, back), _moved(right, values, 1, back)))
    raise ConfigError(
        f"preset '{preset.name}': no feasible {half} trajectory of {frames} frames was found; "
        "widen workspace or lessen motion (workspace.reach, workspace.tip_margin, motion.max_step)"
    )


def _smooth(
    places: Sequence[Place], preset: Preset, half: Half, interval: int, frames: int, rng: np.random.Generator
) -> tuple[FreePose | ArmJoints, FreePose | ArmJoints, FloatArray] | None:
    """Coordinates of both arms and a way in them, ``(frames, 2, n)``, not perturbed yet; ``None`` if none was found."""
    left = _coordinates(places[0], preset, half, rng)
    if left is None:
        return None
    if preset.motion.crossing is not None:
        right = _coordinates(places[1], preset, half, rng)
        if right is None:
            return None
        pair = Pair([left, right], _gap_m(preset))
        crossed = crossing_path(pair, preset.motion.crossing, interval, frames, rng)
        return None if crossed is None else (left, right, crossed)
    left_path = _path(left, preset, interval, frames, rng, other=None)
    if left_path is None:
        return None
    right = _coordinates(places[1], preset, half, rng)
    if right is None:
        return None
    right_path = _path(right, preset, interval, frames, rng, other=left.states(_sampled(left_path)))
    if right_path is None:
        return None
    smooth = np.stack([_interpolate(path, interval, frames) for path in (left_path, right_path)], axis=1)
    return left, right, smooth


def _gap_m(preset: Preset) -> float:
    """How far arms are kept apart before the perturbation, which moves both."""
    gap_m: float = preset.workspace.clearance_m + 3.0 * preset.motion.ou_sigma_position_m
    return gap_m


def _coordinates(place: Place, preset: Preset, half: Half, rng: np.random.Generator) -> FreePose | ArmJoints | None:
    motion = preset.motion
    return FreePose(place, motion, half) if motion.kind == "free" else set_up_arm(place, motion, half, rng)


def _moved(
    coordinates: FreePose | ArmJoints, values: FloatArray, index: int, back_m: FloatArray | None
) -> ArmMotion | None:
    if not isinstance(coordinates, ArmJoints):
        return None
    joints = values[:, index, :ARM_JOINTS]
    if back_m is not None:
        joints = joints.copy()
        joints[:, INSERTION] -= back_m[:, index]
    return ArmMotion(coordinates.arm, coordinates.T_cam_base, joints)


def _blend(share: FloatArray) -> FloatArray:
    """Cubic Hermite step with zero tangents, 0 to 1."""
    return share * share * (3.0 - 2.0 * share)


def _path(
    coordinates: Coordinates,
    preset: Preset,
    interval: int,
    frames: int,
    rng: np.random.Generator,
    other: FloatArray | None,
) -> FloatArray | None:
    """Waypoints ``(k, n)`` of one arm whose segments are feasible; ``None`` if none were found.

    Each is a bounded step from the last towards one drawn anywhere in the workspace, so that the whole of it is
    visited. ``other`` holds the states ``(k, samples, 9)`` of the arm to keep clear of, on its ways to its waypoints.
    """
    count = max(2, -(-(frames - 1) // interval) + 1)
    instrument = coordinates.place.instrument
    gap_m = _gap_m(preset)
    path: list[FloatArray] = []
    failures = 0
    while len(path) < count:
        found = None
        for _ in range(BATCHES_PER_WAYPOINT):
            drawn = coordinates.draw(BATCH, rng)
            if path:
                move = coordinates.step(path[-1], drawn)
                ahead = path[-1] + move
                segment = path[-1] + _blend(PATH_SAMPLES)[:, None, None] * move
            else:
                ahead, segment = drawn, drawn[None]
            good = coordinates.leads(segment)
            if other is not None and good.any():
                # Before the first waypoint there is no way to it.
                beside = other[len(path)] if path else other[0][-1:]
                near = coordinates.states(segment[:, good])
                good[good] = (clearance_m(instrument, near, beside[:, None]) >= gap_m).all(axis=0)
            if good.any():
                found = ahead[int(np.argmax(good))]
                break
        if found is not None:
            path.append(found)
            continue
        failures += 1
        if failures > 20 + count:
            return None
        # A dead end: take back the last steps.
        del path[-2:]
    return np.array(path)


def _sampled(path: FloatArray) -> FloatArray:
    """``(k, samples, n)``: the ways to the waypoints ``(k, n)``; the first has none and stands still."""
    before = np.concatenate([path[:1], path[:-1]])[:, None]
    sampled: FloatArray = before + _blend(PATH_SAMPLES)[:, None] * (path[:, None] - before)
    return sampled


def _interpolate(path: FloatArray, interval: int, frames: int) -> FloatArray:
    """``(frames, n)`` along waypoints ``(k, n)``: cubic Hermite with zero tangents."""
    spline = CubicHermiteSpline(np.arange(len(path)) * float(interval), path, np.zeros_like(path))
    result: FloatArray = spline(np.arange(frames, dtype=np.float64))
    return result


def _perturb(
    smooth: FloatArray, sigma: FloatArray, preset: Preset, instrument: Instrument, rng: np.random.Generator
) -> FloatArray:
    """Add Ornstein-Uhlenbeck noise to ``(frames, 2, n)``, smooth it, stop the tools at their limits."""
    motion = preset.motion
    noisy = smooth + sigma * ornstein_uhlenbeck(smooth.shape, motion.ou_rho, rng)
    filtered = low_pass(noisy, motion, 1.0 / preset.dt_s)
    filtered[..., TOOL_JOINTS] = instrument.generate_limits.clip(filtered[..., TOOL_JOINTS])
    return filtered


def low_pass(values: FloatArray, motion: Motion, rate_hz: float) -> FloatArray:
    """Values ``(T, ...)``, so many a second, through the smoothing of ``motion``.

    Exponential smoothing begins at the first value: ``y += a (x - y)`` with ``a = w / (1 + w)``,
    ``w = 2 pi cutoff / rate``.
    """
    if motion.smoothing == "butterworth":
        sections = butter(2, motion.lowpass_cutoff_hz, fs=rate_hz, output="sos")
        both_ways: FloatArray = sosfiltfilt(sections, values, axis=0, padlen=min(15, len(values) - 1))
        return both_ways
    step = 2.0 * np.pi * motion.lowpass_cutoff_hz / rate_hz
    gain = step / (1.0 + step)
    smoothed: FloatArray = lfilter([gain], [1.0, gain - 1.0], values, axis=0, zi=(1.0 - gain) * values[:1])[0]
    return smoothed


def ornstein_uhlenbeck(shape: tuple[int, ...], rho: float, rng: np.random.Generator) -> FloatArray:
    """Stationary noise of unit variance, correlated by ``rho`` from one entry of the first axis to the next."""
    drive = rng.standard_normal(shape)
    drive[1:] *= np.sqrt(1.0 - rho**2)
    noise: FloatArray = lfilter([1.0], [1.0, -rho], drive, axis=0)
    return noise
