"""Where the arms may be: in view, entering from their own side, apart from each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.generators.presets import Workspace
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.instrument import Instrument
from surgbench.state import ALPHA, ANGLES, BETA, GAMMA, JOINTS, POSITION, STATE_SIZE, JointLimits
from surgbench.tasks.instrument.format import Arm

BoolArray = NDArray[np.bool_]

# How much of the arms is kept apart, and how densely it is looked at.
CLEARANCE_REACH_M = 0.10
CLEARANCE_SPACING_M = 0.005


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
        limits = instrument.generate_limits
        asked = np.array(workspace.joints_rad or np.transpose([limits.lower_rad, limits.upper_rad]))
        self._joints = JointLimits(limits.clip(asked[:, 0]), limits.clip(asked[:, 1]))
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
        states[:, JOINTS] = rng.uniform(self._joints.lower_rad, self._joints.upper_rad, (count, 3))
        return states

    def in_workspace(self, states: FloatArray, margin_m: float = 0.0, margin_rad: float = 0.0) -> BoolArray:
        """Which of ``(..., 9)`` states keep distance, elevation and direction.

        Args:
            states: Candidates.
            margin_m: How far inside the bounds of the distance.
            margin_rad: How far inside those of elevation and direction the shaft's axis must point.
        """
        space = self.workspace
        axis = look_at_rotation(states[..., ANGLES])[..., 2]
        distance = np.linalg.norm(states[..., POSITION], axis=-1)
        elevation = np.arcsin(np.clip(axis[..., 2], -1.0, 1.0))
        # Both arms pointing right, so that one range serves.
        direction = np.arctan2(axis[..., 1], -self.side * axis[..., 0])
        return (
            _between(distance, space.distance_m, margin_m)
            & _between(elevation, space.elevation_rad, margin_rad)
            # The steeper a shaft, the more its direction in the image turns with it.
            & _between(direction, space.direction_rad, margin_rad / np.cos(elevation))
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


def _between(values: FloatArray, bounds: tuple[float, float], margin: FloatArray | float = 0.0) -> BoolArray:
    inside: BoolArray = (values >= bounds[0] + margin) & (values <= bounds[1] - margin)
    return inside
