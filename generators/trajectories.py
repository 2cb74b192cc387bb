"""Trajectories of a left and a right arm: feasible waypoints, cubic Hermite steps, correlated noise, low-pass filter.

After Hu et al. 2026, section IV, except that waypoints are drawn from a workspace rather than taken from tracked
recordings.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import butter, lfilter, sosfiltfilt

from surgbench.camera import Camera
from surgbench.dataset.format import ARMS, Arm
from surgbench.errors import ConfigError
from surgbench.generators.presets import Motion, Preset, Workspace
from surgbench.geometry import FloatArray, look_at_rotation, wrap_angle
from surgbench.instrument import Instrument
from surgbench.state import ALPHA, ANGLES, BETA, GAMMA, JOINTS, POSITION, STATE_SIZE

BoolArray = NDArray[np.bool_]

# Proposals looked at together, and how often each stage is tried before the one before it is done again.
BATCH = 32
BATCHES_PER_WAYPOINT = 4
PERTURBATIONS_PER_PATH = 40
PATHS = 60
# Where segments between waypoints are checked, as a share of the way from one to the next.
PATH_SAMPLES = np.linspace(0.0, 1.0, 9)
# How much of the arms is kept apart, and how densely it is looked at.
CLEARANCE_REACH_M = 0.10
CLEARANCE_SPACING_M = 0.005


def make_pair(preset: Preset, instrument: Instrument, speed: str, frames: int, rng: np.random.Generator) -> FloatArray:
    """A trajectory of two arms.

    In every frame the joints lie within the instrument's generating limits, both tips and the wrist of each arm in
    the image, each shaft enters from its own side, and the arms' centre lines keep their clearance.

    Args:
        preset: Motion, workspace, camera and frame rate.
        instrument: Of both arms.
        speed: ``nominal`` or ``fast``.
        frames: How many.
        rng: The only source of randomness.

    Returns:
        ``(frames, 2, 9)`` states, left arm first; beta and gamma wrapped into [-pi, pi).

    Raises:
        ConfigError: The workspace is too tight for such a trajectory.
    """
    places = {arm: Place(arm, preset.workspace, preset.camera, instrument) for arm in ARMS}
    interval = getattr(preset.motion.waypoint_interval, speed)
    for _ in range(PATHS):
        left = _path(places["left"], preset.motion, interval, frames, rng, other=None)
        if left is None:
            continue
        right = _path(places["right"], preset.motion, interval, frames, rng, other=left)
        if right is None:
            continue
        smooth = np.stack([_interpolate(path, interval, frames) for path in (left, right)], axis=1)
        for _ in range(PERTURBATIONS_PER_PATH):
            states = _perturb(smooth, preset, instrument, rng)
            fits = all(
                places[arm].allows(states[:, index], preset.workspace.tip_margin).all()
                for index, arm in enumerate(ARMS)
            )
            apart = clearance_m(instrument, states[:, 0], states[:, 1])
            if fits and apart.min() >= preset.workspace.clearance_m:
                states[..., BETA] = wrap_angle(states[..., BETA])
                states[..., GAMMA] = wrap_angle(states[..., GAMMA])
                return states
    raise ConfigError(
        f"preset '{preset.name}': no feasible {speed} trajectory of {frames} frames was found; "
        "widen workspace or lessen motion (workspace.reach, workspace.tip_margin, motion.max_step)"
    )


class Place:
    """Where one arm may be.

    Args:
        arm: Which side its shaft enters from.
        workspace: Bounds.
        camera: For what is in view.
        instrument: For tips, limits and the length of the shaft.
    """

    def __init__(self, arm: Arm, workspace: Workspace, camera: Camera, instrument: Instrument) -> None:
        self.arm = arm
        self.workspace = workspace
        self.camera = camera
        self.instrument = instrument
        self.side = -1.0 if arm == "left" else 1.0
        first = instrument.spec.links[0].name
        self.shaft_m = -float(instrument.meshes[first].vertices_m[:, 2].min()) if first in instrument.meshes else np.inf

    def draw(self, count: int, rng: np.random.Generator) -> FloatArray:
        """``(count, 9)`` states anywhere in the workspace; not all of them in view."""
        space, camera = self.workspace, self.camera
        direction = rng.uniform(space.direction_rad[0], space.direction_rad[1], count)
        if self.arm == "right":
            direction = np.pi - direction
        elevation = rng.uniform(space.elevation_rad[0], space.elevation_rad[1], count)
        axis = np.stack(
            [np.cos(direction) * np.cos(elevation), np.sin(direction) * np.cos(elevation), np.sin(elevation)]
        )
        pixel = rng.uniform((0.0, 0.0), (camera.width - 1.0, camera.height - 1.0), (count, 2))
        ray = np.stack(
            [(pixel[:, 0] - camera.cx) / camera.fx, (pixel[:, 1] - camera.cy) / camera.fy, np.ones(count)], axis=1
        )
        distance = rng.uniform(space.distance_m[0], space.distance_m[1], count)
        states = np.empty((count, STATE_SIZE))
        # The third column of Ry(gamma) Rx(alpha) is the shaft's axis.
        states[:, ALPHA] = -np.arcsin(axis[1])
        states[:, GAMMA] = np.arctan2(axis[0], axis[2])
        states[:, BETA] = rng.uniform(-np.pi, np.pi, count)
        states[:, POSITION] = ray / np.linalg.norm(ray, axis=1, keepdims=True) * distance[:, None]
        limits = self.instrument.generate_limits
        states[:, JOINTS] = rng.uniform(limits.lower_rad, limits.upper_rad, (count, 3))
        return states

    def in_workspace(self, states: FloatArray) -> BoolArray:
        """Which of ``(..., 9)`` states keep distance, elevation and direction."""
        space = self.workspace
        axis = look_at_rotation(states[..., ANGLES])[..., 2]
        distance = np.linalg.norm(states[..., POSITION], axis=-1)
        elevation = np.arcsin(np.clip(axis[..., 2], -1.0, 1.0))
        # Both arms pointing right, so that one range serves.
        direction = np.arctan2(axis[..., 1], -self.side * axis[..., 0])
        return (
            _between(distance, space.distance_m)
            & _between(elevation, space.elevation_rad)
            & _between(direction, space.direction_rad)
        )

    def allows(self, states: FloatArray, margin: float) -> BoolArray:
        """Which of ``(..., 9)`` states show both tips and the wrist, on this arm's side, the shaft from that side.

        Args:
            states: Candidates.
            margin: How far inside the image the tips must be, as a share of its height.
        """
        camera = self.camera
        margin_px = margin * camera.height
        tips = camera.project(self.instrument.tips_cam(states))
        wrist = camera.project(states[..., POSITION])
        seen = camera.contains(tips, margin_px).all(axis=-1) & camera.contains(wrist)
        middle = (tips[..., 0].mean(axis=-1) + 0.5) / camera.width
        share = middle if self.arm == "left" else 1.0 - middle
        return seen & _between(share, self.workspace.reach) & self._enters(states, wrist)

    def _enters(self, states: FloatArray, wrist: FloatArray) -> BoolArray:
        """Whether the shaft, followed back from the wrist, leaves the image on this arm's side."""
        camera = self.camera
        axis = look_at_rotation(states[..., ANGLES])[..., 2]
        x, y, z = np.moveaxis(states[..., POSITION], -1, 0)
        # Direction of the shaft's image: d(projection)/d(way back along the shaft), times z squared.
        along_u = camera.fx * (axis[..., 2] * x - axis[..., 0] * z)
        along_v = camera.fy * (axis[..., 2] * y - axis[..., 1] * z)
        edge_u = -0.5 if self.arm == "left" else camera.width - 0.5
        with np.errstate(divide="ignore", invalid="ignore"):
            to_side = (edge_u - wrist[..., 0]) / along_u
            edge_v = np.where(along_v < 0, -0.5, camera.height - 0.5)
            to_edge = np.where(along_v == 0, np.inf, (edge_v - wrist[..., 1]) / along_v)
            # How far back along the shaft that is: fx (x - s ax) = (edge - cx) (z - s az).
            slope = (edge_u - camera.cx) / camera.fx
            way_m = (x - slope * z) / (axis[..., 0] - slope * axis[..., 2])
            result: BoolArray = (along_u * self.side > 0) & (to_side < to_edge) & (way_m > 0) & (way_m < self.shaft_m)
        return result


def clearance_m(instrument: Instrument, left: FloatArray, right: FloatArray) -> FloatArray:
    """Smallest distance between the centre lines of two arms.

    Args:
        instrument: Of both arms.
        left: ``(..., 9)``.
        right: ``(..., 9)``, to be broadcast with ``left``.

    Returns:
        ``(...)`` metres, to about 1 mm.
    """
    a, b = _centre_line(instrument, left), _centre_line(instrument, right)
    squared = ((a**2).sum(-1)[..., :, None] + (b**2).sum(-1)[..., None, :]) - 2.0 * (a @ np.swapaxes(b, -1, -2))
    result: FloatArray = np.sqrt(np.maximum(squared.min(axis=(-1, -2)), 0.0))
    return result


def _centre_line(instrument: Instrument, states: FloatArray) -> FloatArray:
    """``(..., P, 3)`` points along the last part of the shaft, and from the wrist to each tip."""
    wrist = states[..., None, POSITION]
    back = np.arange(0.0, CLEARANCE_REACH_M, CLEARANCE_SPACING_M)[:, None]
    shaft = wrist - back * look_at_rotation(states[..., ANGLES])[..., None, :, 2]
    tips = instrument.tips_cam(states)
    share = np.linspace(0.25, 1.0, 4)[:, None, None]
    jaws = wrist[..., None, :, :] + share * (tips - wrist)[..., None, :, :]
    return np.concatenate([shaft, jaws.reshape(*jaws.shape[:-3], -1, 3)], axis=-2)


def _between(values: FloatArray, bounds: tuple[float, float]) -> BoolArray:
    inside: BoolArray = (values >= bounds[0]) & (values <= bounds[1])
    return inside


def _blend(share: FloatArray) -> FloatArray:
    """Cubic Hermite step with zero tangents, 0 to 1."""
    return share * share * (3.0 - 2.0 * share)


def _path(
    place: Place, motion: Motion, interval: int, frames: int, rng: np.random.Generator, other: FloatArray | None
) -> FloatArray | None:
    """Waypoints ``(n, 9)`` of one arm, beta unwrapped, whose segments are feasible; ``None`` if none were found.

    Each is a bounded step from the last towards a state drawn anywhere in the workspace, so that the whole of it is
    visited. ``other`` holds the waypoints of the arm to keep clear of.
    """
    count = max(2, -(-(frames - 1) // interval) + 1)
    space = place.workspace
    # The perturbation moves both arms; keep that much more apart.
    gap_m = space.clearance_m + 3.0 * motion.ou_sigma_position_m
    step = motion.max_step
    bounds = np.array(
        [step.tilt_rad, step.roll_rad, step.tilt_rad, *[np.inf] * 3, step.wrist_rad, step.wrist_rad, step.jaw_rad]
    )
    path: list[FloatArray] = []
    failures = 0
    while len(path) < count:
        found = None
        for _ in range(BATCHES_PER_WAYPOINT):
            drawn = place.draw(BATCH, rng)
            if path:
                move = drawn - path[-1]
                move[:, BETA] = wrap_angle(move[:, BETA])
                move = np.clip(move, -bounds, bounds)
                length = np.linalg.norm(move[:, POSITION], axis=1, keepdims=True)
                move[:, POSITION] *= np.minimum(1.0, step.position_m / np.maximum(length, 1e-12))
                ahead = path[-1] + move
                segment = path[-1] + _blend(PATH_SAMPLES)[:, None, None] * move
            else:
                ahead, segment = drawn, drawn[None]
            good = place.in_workspace(ahead) & place.allows(segment, space.waypoint_margin).all(axis=0)
            if other is not None and good.any():
                index = len(path)
                beside = other[index][None] if not path else _between_waypoints(other[index - 1], other[index])
                good[good] = (clearance_m(place.instrument, segment[:, good], beside[:, None]) >= gap_m).all(axis=0)
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


def _between_waypoints(start: FloatArray, end: FloatArray) -> FloatArray:
    return start + _blend(PATH_SAMPLES)[:, None] * (end - start)


def _interpolate(path: FloatArray, interval: int, frames: int) -> FloatArray:
    """``(frames, 9)`` along waypoints ``(n, 9)``: cubic Hermite with zero tangents."""
    spline = CubicHermiteSpline(np.arange(len(path)) * float(interval), path, np.zeros_like(path))
    result: FloatArray = spline(np.arange(frames, dtype=np.float64))
    return result


def _perturb(smooth: FloatArray, preset: Preset, instrument: Instrument, rng: np.random.Generator) -> FloatArray:
    """Add Ornstein-Uhlenbeck noise to ``(frames, 2, 9)`` states, low-pass filter them, stop joints at their limits."""
    motion = preset.motion
    sigma = np.array(
        [*motion.ou_sigma_angles_rad, *[motion.ou_sigma_position_m] * 3, *[motion.ou_sigma_joints_rad] * 3]
    )
    noisy = smooth + sigma * ornstein_uhlenbeck(smooth.shape, motion.ou_rho, rng)
    sections = butter(2, motion.lowpass_cutoff_hz, fs=1.0 / preset.dt_s, output="sos")
    padding = min(15, len(smooth) - 1)
    filtered: FloatArray = sosfiltfilt(sections, noisy, axis=0, padlen=padding)
    filtered[..., JOINTS] = instrument.generate_limits.clip(filtered[..., JOINTS])
    return filtered


def ornstein_uhlenbeck(shape: tuple[int, ...], rho: float, rng: np.random.Generator) -> FloatArray:
    """Stationary noise of unit variance, correlated by ``rho`` from one entry of the first axis to the next."""
    drive = rng.standard_normal(shape)
    drive[1:] *= np.sqrt(1.0 - rho**2)
    noise: FloatArray = lfilter([1.0], [1.0, -rho], drive, axis=0)
    return noise
