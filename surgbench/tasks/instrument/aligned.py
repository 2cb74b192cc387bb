"""Datasets whose readings are moved in time, so that they belong to the pictures beside them."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from surgbench.dataset import tables
from surgbench.dataset.manifest import MANIFEST_NAME, observations_path
from surgbench.dataset.masks import read_bytes
from surgbench.dataset.storage import new_folder
from surgbench.dataset.writer import write_files
from surgbench.geometry import FloatArray, rotation_vector
from surgbench.handeye.track import ReadingTrack, Timeline
from surgbench.tasks.instrument.dataset import InstrumentDataset, Sequence, observation_columns
from surgbench.tasks.instrument.format import Arm
from surgbench.tasks.instrument.tables import ARM_JOINT_COLUMNS, KINEMATICS_COLUMNS, READING_COLUMNS, arm_columns

# Key of the manifest's configuration, which keeps what was done.
ALIGNED = "lag_frames_taken_out"


def write_aligned(dataset: InstrumentDataset, lags_frames: Mapping[tuple[str, Arm], float], out: Path) -> None:
    """Write a dataset again with its readings where they belong; all else is the same to the byte.

    Args:
        dataset: Where from.
        lags_frames: By sequence and arm, how late its readings are; one for each arm that has readings.
        out: A new or empty folder, in which it appears when it is complete. Readings that would come from before the
            first frame or from after the last are missing there.

    Raises:
        DatasetError: The folder holds something.
        SurgbenchError: The disk is full or something in the way.
    """
    with new_folder(out, "aligning", "--fix-lag") as scratch:
        tabled = {observations_path(sequence.id): sequence for sequence in dataset.sequences}
        files = dict(dataset.manifest.files)
        for file in files:
            if file in tabled:
                columns = _aligned(tabled[file], dataset, lags_frames)
                files |= write_files(scratch, {file: tables.encode_table(columns)})
            else:
                (scratch / file).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(dataset.path / file, scratch / file)
        done: dict[str, Any] = {}
        for (sequence, arm), lag in lags_frames.items():
            done.setdefault(sequence, {})[arm] = lag
        configuration = {**dataset.manifest.configuration, ALIGNED: done}
        manifest = dataset.manifest.model_copy(update={"files": files, "configuration": configuration})
        (scratch / MANIFEST_NAME).write_bytes(manifest.to_bytes())


def _aligned(
    sequence: Sequence, dataset: InstrumentDataset, lags_frames: Mapping[tuple[str, Arm], float]
) -> dict[str, FloatArray]:
    """Columns of a sequence's observations."""
    names, path = observation_columns(sequence.entry), dataset.path / observations_path(sequence.id)
    columns = tables.decode_table(read_bytes(path), str(path), sequence.frames, names)
    times = sequence.timestamps_s
    for arm in sequence.arms:
        wanted = times + lags_frames[sequence.id, arm] * sequence.dt_s
        joints, poses = sequence.readings(arm), sequence.kinematics(arm)
        if joints is not None:
            there = np.isfinite(joints).all(axis=1)
            moved = Timeline(times[there], sequence.dt_s).mix(joints[there], wanted)
            columns |= dict(zip(arm_columns(arm, READING_COLUMNS), moved.T, strict=True))
        arm_joints = sequence.arm_joints(arm)
        if arm_joints is not None:
            there = np.isfinite(arm_joints).all(axis=1)
            moved = Timeline(times[there], sequence.dt_s).mix(arm_joints[there], wanted)
            columns |= dict(zip(arm_columns(arm, ARM_JOINT_COLUMNS), moved.T, strict=True))
        if poses is not None:
            at = ReadingTrack(times, poses, sequence.dt_s).at(wanted)
            moved = np.full((len(at), 6), np.nan)
            there = np.isfinite(at).all(axis=(1, 2))
            moved[there] = np.hstack([rotation_vector(at[there, :3, :3]), at[there, :3, 3]])
            columns |= dict(zip(arm_columns(arm, KINEMATICS_COLUMNS), moved.T, strict=True))
    return columns
