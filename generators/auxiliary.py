"""Auxiliary cameras: how they move, and what a tracker is told of where they are.

Each view is the camera of an arm that a viewpoint controller moves (:mod:`surgbench.generators.held_cameras`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surgbench.camera import Camera
from surgbench.camera.change_of_view import ChangeOfView
from surgbench.generators.held_cameras import REMOTE_CENTRE_M, held_camera_path
from surgbench.generators.observations import observe_keypoints
from surgbench.generators.presets import Preset
from surgbench.generators.sections import Auxiliary
from surgbench.geometry import (
    FloatArray,
    inverse_transform,
    rigid_transform,
    rotation_from_vector,
    rotation_vector,
)
from surgbench.instrument import Instrument
from surgbench.randomness import generator
from surgbench.tasks.instrument.auxiliary import keypoint_columns
from surgbench.tasks.instrument.format import ARMS, Arm
from surgbench.tasks.instrument.tables import VIEW_COLUMNS, arm_columns

AUXILIARY_CAMERA = "auxiliary"


@dataclass(frozen=True)
class ViewTables:
    """Tables of one auxiliary view.

    Attributes:
        T_view_cam: Arm to ``(frames, 4, 4)``, as it truly is.
        observed: Columns of the view's ``observations.parquet``.
        truth: Columns of its ``poses.parquet``.
    """

    T_view_cam: dict[Arm, FloatArray]
    observed: dict[str, FloatArray]
    truth: dict[str, FloatArray]

    def first(self, frames: int) -> ViewTables:
        """The same of the first frames alone."""
        return ViewTables(
            {arm: poses[:frames] for arm, poses in self.T_view_cam.items()},
            {name: values[:frames] for name, values in self.observed.items()},
            {name: values[:frames] for name, values in self.truth.items()},
        )


def auxiliary_paths(
    settings: Auxiliary, T_world_feature: FloatArray, dt_s: float, rng: np.random.Generator
) -> dict[str, FloatArray]:
    """Where the cameras of all views are, frame by frame.

    Args:
        settings: Which views there are, and what they aim at.
        T_world_feature: ``(T, 4, 4)`` what is followed; its y axis is the normal, towards the camera arm.
        dt_s: Seconds between frames.
        rng: The only source of randomness.

    Returns:
        View to ``(T, 4, 4)`` T_world_view.
    """
    # Of its own for each view, so that one more view changes no other.
    seeds = int(rng.integers(1 << 62))
    return {
        name: held_camera_path(
            name, T_world_feature, dt_s, settings.distance_m, generator(view=name, camera_path=seeds)
        )
        for name in settings.views
    }


def endoscope_pose(settings: Auxiliary) -> FloatArray:
    """``(4, 4)`` T_world_cam: in the world's origin, x level, looking along the world's y axis and down."""
    sin, cos = np.sin(settings.endoscope_pitch_rad), np.cos(settings.endoscope_pitch_rad)
    return rigid_transform(np.array([[1.0, 0.0, 0.0], [0.0, -sin, cos], [0.0, -cos, -sin]]), np.zeros(3))


def feature_poses(settings: Auxiliary, instrument: Instrument, states: FloatArray) -> FloatArray:
    """``(T, 4, 4)`` T_world_feature of one arm's ``(T, 9)`` states in the endoscope's frame.

    The tool frame is the dVRK's: of the link that carries the jaws, x = -z, y = -x and z = y.
    """
    jaw = instrument.spec.links[instrument.link_index[instrument.tips[0].link]]
    carrier = instrument.link_transforms(states)[:, instrument.link_index[jaw.parent or jaw.name]]
    tool = np.stack([-carrier[:, :3, 2], -carrier[:, :3, 0], carrier[:, :3, 1]], axis=-1)
    feature = rigid_transform(tool, carrier[:, :3, 3] + settings.feature_m * tool[..., 2])
    if settings.normal == "x":
        feature[:, :3, :3] = np.stack([-tool[..., 1], tool[..., 0], tool[..., 2]], axis=-1)
    world = endoscope_pose(settings) @ feature
    if world[:, :3, 1].mean(axis=0) @ REMOTE_CENTRE_M < 0:
        world[:, :3, :2] *= -1.0
    return world


def make_views(preset: Preset, sequence: str, states: FloatArray, instrument: Instrument) -> dict[str, ViewTables]:
    """Tables of all auxiliary views of a sequence.

    Args:
        preset: With the section ``auxiliary``, or without: then there are none.
        sequence: Its id.
        states: ``(frames, 2, 9)`` of the whole sequence.
        instrument: The real one.
    """
    settings = preset.auxiliary
    if settings is None:
        return {}
    axes: dict[str, str | int] = {"dataset": preset.seed, "sequence": sequence}
    constant = generator(**axes, purpose="auxiliary calibration").standard_normal(6)
    poses: dict[str, dict[Arm, FloatArray]] = {name: {} for name in settings.views}
    for index, arm in enumerate(ARMS):
        feature = feature_poses(settings, instrument, states[:, index])
        rng = generator(**axes, arm=arm, purpose="auxiliary paths")
        for name, path in auxiliary_paths(settings, feature, preset.dt_s, rng).items():
            poses[name][arm] = inverse_transform(path) @ endoscope_pose(settings)
    made = {}
    for name, of_arm in poses.items():
        observed: dict[str, FloatArray] = {}
        truth: dict[str, FloatArray] = {}
        for index, arm in enumerate(ARMS):
            rng = generator(**axes, arm=arm, view=name, purpose="auxiliary jitter")
            truth |= pose_columns_of(arm, of_arm[arm])
            observed |= pose_columns_of(arm, report(of_arm[arm], settings, constant, rng))
            rng = generator(**axes, arm=arm, view=name, purpose="keypoints")
            own = np.array([ChangeOfView(T).states(one) for T, one in zip(of_arm[arm], states[:, index], strict=True)])
            points = observe_keypoints(own, instrument, settings.camera, preset.keypoints, rng)
            observed |= dict(zip(keypoint_columns(arm, arm), points.reshape(-1, 4).T, strict=True))
        made[name] = ViewTables(of_arm, observed, truth)
    return made


def report(T_view_cam: FloatArray, settings: Auxiliary, constant: FloatArray, rng: np.random.Generator) -> FloatArray:
    """What is known of a camera's poses.

    Args:
        T_view_cam: ``(T, 4, 4)`` as they are.
        settings: Errors.
        constant: ``(6,)`` those of the whole sequence, in standard deviations.
        rng: For what is new in every frame.
    """

    def six(rad: float, metres: float) -> FloatArray:
        return np.repeat([rad, metres], 3)

    errors = six(settings.calibration_rad, settings.calibration_m) * constant
    errors = errors + six(settings.jitter_rad, settings.jitter_m) * rng.standard_normal((len(T_view_cam), 6))
    return rigid_transform(rotation_from_vector(errors[:, :3]), errors[:, 3:]) @ T_view_cam


def camera_of(preset: Preset) -> dict[str, Camera]:
    """The auxiliary camera by its name in the manifest, if there is one."""
    return {} if preset.auxiliary is None else {AUXILIARY_CAMERA: preset.auxiliary.camera}


def pose_columns_of(kind: str, poses: FloatArray) -> dict[str, FloatArray]:
    """Columns of poses ``(frames, 4, 4)`` that belong to a kind of masks."""
    numbers = np.hstack([rotation_vector(poses[:, :3, :3]), poses[:, :3, 3]])
    return dict(zip(arm_columns(kind, VIEW_COLUMNS), numbers.T, strict=True))
