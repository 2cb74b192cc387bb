"""Poses, tips and joints as CSV, a row per arm and frame: what ``surgbench score`` reads."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from surgbench.contract import Plugin
from surgbench.exporting import Material
from surgbench.geometry import FloatArray
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.exported import dataset_of, frames_in, rows_in
from surgbench.tasks.instrument.pose_table import DEVIATION_COLUMNS, POSE_COLUMNS, TIP_COLUMNS, pose_columns
from surgbench.tasks.instrument.tables import ARM_JOINT_COLUMNS, KEYPOINT_COLUMNS, READING_COLUMNS, label_columns
from surgbench.tasks.instrument.tracks import Track, truth_tracks

HEAD = ("sequence", "arm", "frame", "timestamp_s")
ESTIMATE_COLUMNS = ("confidence", "lost", "latency_ms")


class CsvExporter(Plugin):
    """``truth.csv`` and ``observed.csv`` of a dataset; of runs ``ROW.csv`` each."""

    name: ClassVar[str] = "csv"
    summary: ClassVar[str] = "poses of wrist and tips, joints: a row per arm and frame; surgbench score reads it"

    def count(self, material: Material) -> int:
        """Frames."""
        return frames_in(material)

    def write(self, material: Material, folder: Path, progress: Callable[[float], None]) -> None:
        """Write the tables."""
        dataset = dataset_of(material)
        if dataset is None:
            for row in rows_in(material):
                write_tracks(folder / f"{row.name}.csv", row.tracks(), progress)
            return
        truth = truth_tracks(dataset)
        if truth:
            write_tracks(folder / "truth.csv", truth, lambda frames: None)
        labels = list(dict.fromkeys(label for sequence in dataset.sequences for label in sequence.entry.labels))
        six = any(sequence.entry.arm_joints for sequence in dataset.sequences)
        header = [*HEAD, *KEYPOINT_COLUMNS, *READING_COLUMNS, *(ARM_JOINT_COLUMNS if six else ())]
        header += [column for label in labels for column in label_columns(label)]
        _write(folder / "observed.csv", header, _observed(dataset, labels, progress, six=six))


def write_tracks(path: Path, tracks: list[Track], progress: Callable[[float], None]) -> None:
    """Write tracks, estimated or true, as one table.

    Numbers are the shortest that give the same float64 again, so that a state is the same to the last bit.
    """
    estimated = any(track.confidence is not None for track in tracks)
    deviations = DEVIATION_COLUMNS if any(track.deviations is not None for track in tracks) else ()
    header = (*HEAD, *POSE_COLUMNS, *TIP_COLUMNS, *(ESTIMATE_COLUMNS if estimated else ()), *deviations)

    def rows() -> Iterable[list[Any]]:
        for track in tracks:
            columns = [pose_columns(track.states), track.tips()[:, :, :3, 3].reshape(-1, 6)]
            if estimated:
                assert track.confidence is not None
                assert track.lost is not None
                assert track.latency_ms is not None
                columns.append(np.stack([track.confidence, track.lost.astype(np.float64), track.latency_ms], axis=1))
            if deviations:
                columns.append(
                    np.full((len(track.frames), 9), np.nan) if track.deviations is None else track.deviations
                )
            yield from _numbered(track.sequence, track.arm, track.frames, track.timestamps_s, columns)
            progress(len(track.frames))

    _write(path, header, rows())


def _observed(
    dataset: InstrumentDataset, labels: list[str], progress: Callable[[float], None], *, six: bool
) -> Iterable[list[Any]]:
    """Tips, readings, the arm's six joints and marked points, empty where there are none."""
    for sequence in dataset.sequences:
        for arm in sequence.arms:
            marked = sequence.labels(arm)
            known = [
                (sequence.keypoints(arm).reshape(-1, len(KEYPOINT_COLUMNS)), KEYPOINT_COLUMNS),
                (sequence.readings(arm), READING_COLUMNS),
                (sequence.arm_joints(arm), ARM_JOINT_COLUMNS if six else ()),
                *((marked.get(label), label_columns(label)) for label in labels),
            ]
            columns = [
                np.full((sequence.frames, len(names)), np.nan) if values is None else values for values, names in known
            ]
            yield from _numbered(sequence.id, arm, range(sequence.frames), sequence.timestamps_s, columns)
            progress(sequence.frames)


def _numbered(
    sequence: str, arm: str, frames: Iterable[int], times_s: FloatArray, columns: list[FloatArray]
) -> Iterable[list[Any]]:
    values = np.concatenate([times_s[:, None], *columns], axis=1)
    for frame, row in zip(frames, values.tolist(), strict=True):
        yield [sequence, arm, int(frame), *row]


def _write(path: Path, header: Iterable[str], rows: Iterable[list[Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join(header) + "\n")
        for row in rows:
            # NaN is an empty cell, and a whole number has no point: 1 for lost.
            file.write(",".join(_cell(value) for value in row) + "\n")


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "" if np.isnan(value) else repr(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
    return str(value)
