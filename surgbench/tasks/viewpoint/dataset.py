"""Reading datasets of the viewpoint task."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import ValidationError

from surgbench.config import explain
from surgbench.dataset import tables
from surgbench.dataset.base import Dataset
from surgbench.dataset.integrity import read_listed
from surgbench.dataset.manifest import observations_path
from surgbench.errors import DatasetError, unknown_name
from surgbench.geometry import FloatArray, rigid_transform, rotation_from_vector, rotation_vector
from surgbench.syntax import parse_json
from surgbench.tasks.viewpoint.format import (
    CONTACT,
    FEATURE_COLUMNS,
    SceneTruth,
    TrialEntry,
    ViewpointManifest,
    WireEntry,
    feature_path,
    scene_path,
)
from surgbench.viewpoint.arm_files import arm_of
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.registration import Touches, register
from surgbench.viewpoint.setting_up import unseen
from surgbench.viewpoint.trial import Trial, TrialTruth, Wire
from surgbench.viewpoint.workspace import NoGoZone, WorkspaceError

# A timestamp may differ by this share of a period from where a uniform clock has it.
UNIFORM = 0.01
# Angles computed in float64 may pass a limit by rounding.
TOLERANCE = 1e-9


@dataclass(frozen=True)
class TrialUnit:
    """What one run of a controller is about: a trial.

    Attributes:
        id: The trial's.
    """

    id: str

    @property
    def sequence(self) -> str:
        """The trial's id."""
        return self.id

    def spec(self) -> dict[str, Any]:
        """What a record's specification says of it beside its id: nothing."""
        return {}


@dataclass(frozen=True)
class TrialInfo:
    """What is known of a trial without reading its tables.

    Attributes:
        entry: Its part of the manifest.
    """

    entry: TrialEntry

    @property
    def id(self) -> str:
        """The trial's id."""
        return self.entry.id

    @property
    def frames(self) -> int:
        """Number of samples."""
        return self.entry.samples


class ViewpointDataset(Dataset[ViewpointManifest]):
    """A dataset of the viewpoint task on disk.

    Attributes:
        trials: In the manifest's order.
        arm: The arm that holds the camera.
    """

    task: ClassVar[str] = "viewpoint"

    def __init__(self, path: Path, manifest: ViewpointManifest, hash_: str) -> None:
        super().__init__(path, manifest, hash_)
        self.trials = tuple(TrialInfo(entry) for entry in manifest.trials)
        self.arm = arm_of(manifest.camera_arm)

    def length(self, sequence: str) -> int:
        """Number of steps of a trial."""
        return self.sequence(sequence).frames

    def sequence(self, trial_id: str) -> TrialInfo:
        """The trial with this id, its tables unread.

        Raises:
            DatasetError: There is none.
        """
        for trial in self.trials:
            if trial.id == trial_id:
                return trial
        raise DatasetError(f"{self.path}: {unknown_name('trial', trial_id, [trial.id for trial in self.trials])}")

    def units(self, arms: str = "single") -> tuple[TrialUnit, ...]:
        """What a controller runs on, in order; ``arms`` is the instrument task's."""
        return tuple(TrialUnit(trial.id) for trial in self.trials)

    def trial(self, trial_id: str) -> Trial:
        """One trial, with its truth where there is one.

        Raises:
            DatasetError: There is none, or a file of it is missing, altered, or says something impossible; one line.
        """
        entry = self.sequence(trial_id).entry
        problems = entry_problems(self.path, entry, self.arm)
        poses, times, found = read_observations(self.path, entry, self._read(observations_path(entry.id)))
        for problem in (*problems, *found, *reach_problems(self.path, entry, self.arm, poses)):
            raise DatasetError(problem)
        truth = None
        if entry.truth:
            true, contact, found = read_feature(self.path, entry, self._read(feature_path(entry.id)))
            for problem in found:
                raise DatasetError(problem)
            scene = read_scene(self.path, entry, self._read(scene_path(entry.id)))
            truth = TrialTruth(true, np.reshape(scene.T_world_base, (4, 4)), contact, _wire(scene.wire))
        return Trial(
            entry.id,
            entry.dt_s,
            times,
            poses,
            np.reshape(entry.T_world_base, (4, 4)).astype(np.float64),
            _touches(entry),
            np.array(entry.zone_m),
            np.array(entry.start),
            truth,
            entry.distance_m,
            entry.floor_m,
            entry.proximity_m,
            entry.preferred_side,
            self.arm,
        )

    def _read(self, file: str) -> bytes:
        """A file's bytes, which must be those that the manifest lists."""
        return read_listed(self.path, file, self.manifest.files)


def trial_files(entry: TrialEntry) -> list[str]:
    """Every file that a trial must have, in order."""
    truth = [feature_path(entry.id), scene_path(entry.id)] if entry.truth else []
    return [observations_path(entry.id), *truth]


def entry_problems(root: Path, entry: TrialEntry, arm: CameraArm) -> list[str]:
    """What is wrong with a trial's part of the manifest beyond its form, one line each."""
    place = f"{root}: trial '{entry.id}'"
    problems = []
    try:
        NoGoZone(np.array(entry.zone_m))
    except WorkspaceError as error:
        problems.append(f"{place}: {error}")
    start = np.array(entry.start)
    if not arm.within_limits(start, TOLERANCE):
        joint = int(np.argmax((start < arm.lower - TOLERANCE) | (start > arm.upper + TOLERANCE)))
        problems.append(
            f"{place}: start joint {joint + 1} is {start[joint]:.6g}, outside its limits "
            f"[{arm.lower[joint]:.6g}, {arm.upper[joint]:.6g}]"
        )
    return problems


def reach_problems(root: Path, entry: TrialEntry, arm: CameraArm, poses: FloatArray) -> list[str]:
    """One line where the camera arm sees the feature at no time, given where the touched points say that its base is.

    Args:
        root: The dataset's folder.
        entry: The trial.
        arm: Holds the camera.
        poses: ``(T, 4, 4)`` the feature as measured.
    """
    base = np.reshape(entry.T_world_base, (4, 4)).astype(np.float64)
    touches = _touches(entry)
    if len(touches.base_m):
        base = register(base, touches, "translation")
    problem = unseen(arm, base, poses, entry.distance_m)
    return [] if problem is None else [f"{root}: trial '{entry.id}': {problem}"]


def read_observations(root: Path, entry: TrialEntry, data: bytes) -> tuple[FloatArray, FloatArray, list[str]]:
    """A trial's observations: ``(T, 4, 4)`` poses as measured, ``(T,)`` timestamps, and what is wrong with them."""
    name = str(root / observations_path(entry.id))
    values = tables.decode_table(data, name, entry.samples, [tables.TIMESTAMP, *FEATURE_COLUMNS])
    poses, numbers = _poses(values)
    missing = np.asarray(np.isnan(numbers).all(axis=1))
    problems = _pose_problems(f"{name}: trial '{entry.id}'", numbers, missing)
    times = values[tables.TIMESTAMP]
    off = np.asarray(~np.isfinite(times))
    if off.any():
        problems.append(f"{name}: trial '{entry.id}': row {_first(off)}: 'timestamp_s' is not a finite number")
        return poses, times, problems
    # Against the row before, so that the row after a gap is named; and against the clock, so that no drift adds up.
    steps = np.asarray(np.abs(np.diff(times, prepend=times[0] - entry.dt_s) - entry.dt_s) > UNIFORM * entry.dt_s)
    drift = np.asarray(np.abs(times - times[0] - entry.dt_s * np.arange(len(times))) > UNIFORM * entry.dt_s)
    bad = steps if steps.any() else drift
    if bad.any():
        row = _first(bad)
        since = float(np.diff(times, prepend=times[0])[row])
        problems.append(
            f"{name}: trial '{entry.id}': row {row}: a gap in time, {since:.6g} s after the row before; "
            f"expected one sample every {entry.dt_s:g} s"
        )
    return poses, times, problems


def read_feature(root: Path, entry: TrialEntry, data: bytes) -> tuple[FloatArray, np.ndarray, list[str]]:
    """A trial's truth: ``(T, 4, 4)`` poses, ``(T,)`` bool contacts, and what is wrong with them."""
    name = str(root / feature_path(entry.id))
    values = tables.decode_table(data, name, entry.samples, [*FEATURE_COLUMNS, CONTACT])
    poses, numbers = _poses(values)
    problems = _pose_problems(f"{name}: trial '{entry.id}'", numbers, np.zeros(len(numbers), dtype=bool))
    other = ~np.isin(values[CONTACT], (0.0, 1.0))
    if other.any():
        problems.append(f"{name}: trial '{entry.id}': row {_first(other)}: '{CONTACT}' must be 0 or 1")
    return poses, values[CONTACT] == 1.0, problems


def read_scene(root: Path, entry: TrialEntry, data: bytes) -> SceneTruth:
    """What is true over a whole trial.

    Raises:
        DatasetError: It is not that; one line.
    """
    path = root / scene_path(entry.id)
    try:
        return SceneTruth.model_validate(parse_json(data))
    except ValidationError as error:
        raise DatasetError(f"{path}: {explain(SceneTruth, error)}") from None
    except ValueError:
        raise DatasetError(f"{path}: not valid JSON") from None


def pose_columns(poses: FloatArray) -> dict[str, FloatArray]:
    """Columns of ``(T, 4, 4)`` poses, NaN where they are."""
    missing = np.asarray(np.isnan(poses).any(axis=(1, 2)))
    whole = np.where(missing[:, None, None], np.eye(4), poses)
    numbers = np.hstack([rotation_vector(whole[:, :3, :3]), whole[:, :3, 3]])
    numbers[missing] = np.nan
    return dict(zip(FEATURE_COLUMNS, numbers.T, strict=True))


def _touches(entry: TrialEntry) -> Touches:
    return Touches(np.reshape(entry.touches.world_m, (-1, 3)), np.reshape(entry.touches.base_m, (-1, 3)))


def _poses(values: dict[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
    numbers = tables.stack(values, FEATURE_COLUMNS)
    poses = rigid_transform(rotation_from_vector(numbers[:, :3]), numbers[:, 3:])
    poses[np.isnan(numbers).any(axis=1)] = np.nan
    return poses, numbers


def _pose_problems(place: str, numbers: FloatArray, missing: np.ndarray) -> list[str]:
    turn = np.linalg.norm(numbers[:, :3], axis=1)
    bad = ~missing & ~(np.isfinite(numbers).all(axis=1) & (turn <= np.pi + TOLERANCE))
    if not bad.any():
        return []
    return [f"{place}: row {_first(bad)}: the feature's pose is not finite, or its rotation vector is longer than pi"]


def _wire(entry: WireEntry | None) -> Wire | None:
    if entry is None:
        return None
    return Wire(np.array(entry.points_m), entry.radius_m, entry.ring_radius_m, entry.tube_radius_m)


def _first(bad: np.ndarray) -> int:
    return int(np.argmax(bad))
