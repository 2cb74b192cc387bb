"""Trajectories in the format of the TUM RGB-D benchmark: ``timestamp tx ty tz qx qy qz qw``, metres and seconds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import numpy as np

from surgbench.contract import Plugin
from surgbench.exporting import Material
from surgbench.geometry import FloatArray, look_at_rotation, rigid_transform
from surgbench.tasks.instrument.exported import dataset_of, frames_in, rows_in, with_truth
from surgbench.tasks.instrument.pose_table import quaternions
from surgbench.tasks.instrument.tracks import Track, truth_tracks


class TumExporter(Plugin):
    """A folder for the truth or each row, with three trajectories and a table of joints per arm."""

    name: ClassVar[str] = "tum"
    summary: ClassVar[str] = "trajectories of wrist and both tips in the camera frame, as TUM and evo have them; joints"

    def count(self, material: Material) -> int:
        """Frames."""
        dataset = dataset_of(material)
        if dataset is not None:
            with_truth(dataset, self.name)
        return frames_in(material)

    def write(self, material: Material, folder: Path, progress: Callable[[float], None]) -> None:
        """Write the trajectories."""
        dataset = dataset_of(material)
        if dataset is not None:
            parts = [("truth", truth_tracks(with_truth(dataset, self.name)))]
        else:
            parts = [(row.name, row.tracks()) for row in rows_in(material)]
        for name, tracks in parts:
            (folder / name).mkdir()
            for track in tracks:
                _write_track(folder / name, track)
                progress(len(track.frames))


def _write_track(folder: Path, track: Track) -> None:
    states, tips = track.states, track.tips()
    wrist = rigid_transform(look_at_rotation(states[:, :3]), states[:, 3:6])
    for name, poses in (("wrist", wrist), ("tip1", tips[:, 0]), ("tip2", tips[:, 1])):
        path = folder / f"{track.sequence}-{track.arm}-{name}.tum"
        path.write_text(_lines("# timestamp tx ty tz qx qy qz qw", _tum(track.timestamps_s, poses)), encoding="utf-8")
    joints = np.concatenate([track.timestamps_s[:, None], states[:, 6:]], axis=1)
    path = folder / f"{track.sequence}-{track.arm}-joints.txt"
    path.write_text(_lines("# timestamp q1 q2 q3", joints), encoding="utf-8")


def _tum(times_s: FloatArray, poses: FloatArray) -> FloatArray:
    """``(T, 8)`` of ``(T, 4, 4)`` poses."""
    turns = quaternions(poses[:, :3, :3])[:, [1, 2, 3, 0]]
    return np.concatenate([times_s[:, None], poses[:, :3, 3], turns], axis=1)


def _lines(header: str, rows: FloatArray) -> str:
    return "\n".join([header, *(" ".join(repr(value) for value in row) for row in rows.tolist())]) + "\n"
