"""Checks a dataset of the instrument task against its manifest, its format and common sense."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from surgbench.camera import Camera
from surgbench.config import read_yaml
from surgbench.dataset import tables
from surgbench.dataset.integrity import check_files
from surgbench.dataset.manifest import observations_path
from surgbench.dataset.masks import decode_image, decode_levels, decode_mask, read_bytes
from surgbench.errors import DatasetError, SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.state import ALPHA, BETA, GAMMA, JOINTS, POSITION, JointLimits
from surgbench.tasks.instrument.auxiliary import auxiliary_columns, keypoint_columns, kind_arms, pose_columns
from surgbench.tasks.instrument.dataset import (
    InstrumentDataset,
    labelled_columns,
    observation_columns,
    state_columns,
    visibility_columns,
)
from surgbench.tasks.instrument.format import (
    DEPTH_KIND,
    IMAGE_KIND,
    LINKS_KIND,
    Arm,
    AuxiliaryEntry,
    SequenceEntry,
    labels_path,
    look_path,
    poses_path,
    sequence_files,
    states_path,
    view_folder,
    visibility_path,
)
from surgbench.tasks.instrument.tables import (
    ARM_JOINT_COLUMNS,
    KEYPOINT_COLUMNS,
    KINEMATICS_COLUMNS,
    READING_COLUMNS,
    STATE_COLUMNS,
    VIEW_COLUMNS,
    arm_columns,
    label_columns,
)

# Angles computed in float64 may pass a limit by rounding.
TOLERANCE_RAD = 1e-9
SHARE_TOLERANCE = 1e-9


def validate(dataset: InstrumentDataset, progress: Callable[[float], None] = lambda files: None) -> list[str]:
    """Find everything that is wrong with a dataset; see :func:`surgbench.dataset.validate.validate`."""
    root, manifest = dataset.path, dataset.manifest
    expected = {file for entry in manifest.sequences for file in sequence_files(entry)}
    cameras = {entry.id: manifest.cameras[entry.camera] for entry in manifest.sequences}
    cameras |= {
        view_folder(entry.id, name): manifest.cameras[view.camera]
        for entry in manifest.sequences
        for name, view in entry.auxiliary.items()
    }
    problems, sound = check_files(
        root, manifest, expected, lambda file, data: _check_picture(file, data, root, cameras), progress
    )
    limits: dict[str, JointLimits] = {}
    for name, file in manifest.instruments.items():
        try:
            instrument = dataset.instrument(name)
        except SurgbenchError as error:
            if file in sound:
                problems.append(str(error))
            continue
        generated = manifest.origin == "generated"
        limits[name] = instrument.generate_limits if generated else instrument.search_limits
    for entry in manifest.sequences:
        camera = cameras[entry.id]
        if observations_path(entry.id) in sound:
            problems += _check_observations(root, entry, camera)
        if entry.labels and labels_path(entry.id) in sound:
            problems += _check_labels(root, entry, camera)
        if entry.truth and states_path(entry.id) in sound:
            problems += _check_states(root, entry, limits)
        if entry.visibility and visibility_path(entry.id) in sound:
            problems += _check_visibility(root, entry)
        if entry.look and look_path(entry.id) in sound:
            try:
                read_yaml(root / look_path(entry.id), "look")
            except SurgbenchError as error:
                problems.append(str(error))
        for name, view in entry.auxiliary.items():
            problems += _check_auxiliary(root, entry, name, view, manifest.cameras[view.camera], sound)
    return problems


def _check_picture(file: str, data: bytes, root: Path, cameras: dict[str, Camera]) -> str | None:
    """The problem of a mask or image, if it has one."""
    parts = PurePosixPath(file).parts
    if not file.endswith(".png"):
        return None
    name, kind = str(root / file), parts[-2]
    try:
        if kind in (DEPTH_KIND, LINKS_KIND):
            # truth/<id>/<kind>/<frame>.png
            camera = cameras["/".join(parts[1:-2])]
            decode_levels(data, name, camera.width, camera.height, np.uint16 if kind == DEPTH_KIND else np.uint8)
            return None
        # sequences/<folder>/observed/<kind>/<frame>.png, where a view's folder has slashes
        camera = cameras["/".join(parts[1:-3])]
        decode = decode_image if kind == IMAGE_KIND else decode_mask
        decode(data, name, camera.width, camera.height)
    except DatasetError as error:
        return str(error)
    return None


def _check_observations(root: Path, entry: SequenceEntry, camera: Camera) -> list[str]:
    path = root / observations_path(entry.id)
    try:
        values = tables.decode_table(read_bytes(path), str(path), entry.frames, observation_columns(entry))
    except DatasetError as error:
        return [str(error)]
    problems = []
    times = values[tables.TIMESTAMP]
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        problems.append(f"{path}: 'timestamp_s' must be finite and increase from frame to frame")
    for arm in entry.arms:
        if entry.keypoints:
            points = tables.stack(values, arm_columns(arm, KEYPOINT_COLUMNS)).reshape(-1, 2, 2)
            problems += _keypoint_problems(path, arm, points, camera)
        if entry.readings:
            readings = tables.stack(values, arm_columns(arm, READING_COLUMNS))
            bad = (np.isinf(readings) | (np.abs(readings) > np.pi)).any(axis=1)
            if bad.any():
                problems.append(f"{path}: frame {_first(bad)}: a joint reading of the {arm} arm is outside [-pi, pi]")
        if entry.arm_joints:
            joints = tables.stack(values, arm_columns(arm, ARM_JOINT_COLUMNS))
            bad = (np.isinf(joints) | (np.abs(joints) > 2 * np.pi)).any(axis=1)
            if bad.any():
                problems.append(f"{path}: frame {_first(bad)}: a joint of the {arm} arm is beyond a full turn")
        if entry.T_cam_base:
            poses = tables.stack(values, arm_columns(arm, KINEMATICS_COLUMNS))
            missing = np.isnan(poses).all(axis=1)
            turn = np.linalg.norm(poses[:, :3], axis=1)
            bad = ~missing & ~(np.isfinite(poses).all(axis=1) & (turn <= np.pi + TOLERANCE_RAD))
            if bad.any():
                problems.append(
                    f"{path}: frame {_first(bad)}: the {arm} arm's tool pose is not finite, or its rotation vector is "
                    "longer than pi"
                )
    return problems


def _check_labels(root: Path, entry: SequenceEntry, camera: Camera) -> list[str]:
    path = root / labels_path(entry.id)
    try:
        values = tables.decode_table(read_bytes(path), str(path), entry.frames, labelled_columns(entry))
    except DatasetError as error:
        return [str(error)]
    problems = []
    for arm in entry.arms:
        columns = [column for label in entry.labels for column in arm_columns(arm, label_columns(label))]
        points = tables.stack(values, columns).reshape(-1, len(entry.labels), 2)
        problems += _keypoint_problems(path, arm, points, camera)
    return problems


def _keypoint_problems(path: Path, arm: Arm, points: FloatArray, camera: Camera) -> list[str]:
    lost = np.isnan(points)
    half = lost.any(axis=2) != lost.all(axis=2)
    outside = ~camera.contains(points) & ~lost.any(axis=2)
    return [
        f"{path}: frame {_first(bad.any(axis=1))}: a keypoint of the {arm} arm {what}"
        for bad, what in ((half, "has one coordinate without the other"), (outside, "lies outside the image"))
        if bad.any()
    ]


def _check_auxiliary(
    root: Path, entry: SequenceEntry, name: str, view: AuxiliaryEntry, camera: Camera, sound: set[str]
) -> list[str]:
    """Problems of an auxiliary view's tables, those that are there whole."""
    folder = view_folder(entry.id, name)
    files = {observations_path(folder): auxiliary_columns(view)}
    if entry.truth:
        files[poses_path(folder)] = pose_columns(view)
    problems = []
    for file in sorted(sound & set(files)):
        path = root / file
        try:
            values = tables.decode_table(read_bytes(path), str(path), entry.frames, files[file])
        except DatasetError as error:
            problems.append(str(error))
            continue
        for kind in view.kinds:
            poses = tables.stack(values, arm_columns(kind, VIEW_COLUMNS))
            turn = np.linalg.norm(poses[:, :3], axis=1)
            bad = ~(np.isfinite(poses).all(axis=1) & (turn <= np.pi + TOLERANCE_RAD))
            if bad.any():
                problems.append(
                    f"{path}: frame {_first(bad)}: the view's pose for '{kind}' is not finite, or its rotation vector "
                    "is longer than pi"
                )
            for arm in kind_arms(kind) if view.keypoints and file == observations_path(folder) else ():
                points = tables.stack(values, keypoint_columns(kind, arm)).reshape(-1, 2, 2)
                problems += _keypoint_problems(path, arm, points, camera)
    return problems


def _check_states(root: Path, entry: SequenceEntry, limits: dict[str, JointLimits]) -> list[str]:
    path = root / states_path(entry.id)
    try:
        values = tables.decode_table(read_bytes(path), str(path), entry.frames, state_columns(entry))
    except DatasetError as error:
        return [str(error)]
    problems = []
    for arm in entry.arms:
        states = tables.stack(values, arm_columns(arm, STATE_COLUMNS))
        problems += [
            f"{path}: {problem}" for problem in _state_problems(arm, states, limits.get(entry.instruments[arm]))
        ]
    return problems


def _check_visibility(root: Path, entry: SequenceEntry) -> list[str]:
    path = root / visibility_path(entry.id)
    try:
        values = tables.decode_table(read_bytes(path), str(path), entry.frames, visibility_columns(entry))
    except DatasetError as error:
        return [str(error)]
    problems = []
    for column, shares in values.items():
        bad = (shares < 0) | (shares > 1)
        if column.endswith("_swapped"):
            bad = ~np.isin(shares, (0, 1))
        if bad.any():
            what = "neither 0 nor 1" if column.endswith("_swapped") else "no share, 0 to 1"
            problems.append(f"{path}: frame {_first(bad)}: '{column}' is {shares[_first(bad)]:.6g}, {what}")
    if len(entry.arms) == 2:
        fronts = np.stack([values[f"{arm}_front"] for arm in entry.arms])
        bad = np.isnan(fronts).any(axis=0) != np.isnan(fronts).all(axis=0)
        bad |= np.abs(fronts.sum(axis=0) - 1) > SHARE_TOLERANCE
        if bad.any():
            problems.append(f"{path}: frame {_first(bad)}: the arms' shares in front do not add up to 1")
    return problems


def _state_problems(arm: Arm, states: FloatArray, limits: JointLimits | None) -> list[str]:
    columns = arm_columns(arm, STATE_COLUMNS)
    bad = ~np.isfinite(states)
    if bad.any():
        frame, column = np.argwhere(bad)[0]
        return [f"frame {frame}: '{columns[column]}' is not a finite number"]
    lower = np.full(states.shape[1], -np.inf)
    upper = np.full(states.shape[1], np.inf)
    lower[[ALPHA, BETA, GAMMA]], upper[[ALPHA, BETA, GAMMA]] = (
        [-np.pi / 2, -np.pi, -np.pi],
        [np.pi / 2, np.pi, np.pi],
    )
    if limits is not None:
        lower[JOINTS], upper[JOINTS] = limits.lower_rad, limits.upper_rad
    problems = []
    outside = (states < lower - TOLERANCE_RAD) | (states > upper + TOLERANCE_RAD)
    for column in np.flatnonzero(outside.any(axis=0)):
        frame = _first(outside[:, column])
        problems.append(
            f"frame {frame}: '{columns[column]}' is {states[frame, column]:.6g}, "
            f"outside its limits [{lower[column]:.6g}, {upper[column]:.6g}]"
        )
    behind = states[:, POSITION][:, 2] <= 0
    if behind.any():
        problems.append(f"frame {_first(behind)}: the {arm} arm's wrist is behind the camera")
    return problems


def _first(bad: Any) -> int:
    return int(np.argmax(bad))
