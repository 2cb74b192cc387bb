"""Writes recordings as sequences of a dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.camera.undistortion import Undistortion, is_distorted
from surgbench.contract import Mask
from surgbench.dataset import tables
from surgbench.dataset.manifest import FileEntry, observations_path
from surgbench.dataset.masks import encode_image, encode_mask
from surgbench.dataset.writer import write_files
from surgbench.geometry import FloatArray
from surgbench.pictures import as_rgb
from surgbench.recordings.coding import WHOLE, Coding
from surgbench.recordings.files import read_picture
from surgbench.recordings.folder import Recording
from surgbench.recordings.shares import Shares
from surgbench.tasks.instrument.format import IMAGE_KIND, Arm, MaskKind, SequenceEntry, observed_path
from surgbench.tasks.instrument.tables import KEYPOINT_COLUMNS, READING_COLUMNS, arm_columns

CAMERA_NAME = "camera"
BOTH: Literal["both"] = "both"


class RecordingWriter:
    """Writes sequences of a recording, in the order of its frames.

    Args:
        recording: What lies in its folder.
        coding: What its masks mean.
        arms: That they show.
        root: The dataset's folder.
        progress: Takes the number of frames just written.

    Attributes:
        shares: How much of the masks written so far is instrument.
    """

    def __init__(
        self,
        recording: Recording,
        coding: Coding,
        arms: tuple[Arm, ...],
        root: Path,
        progress: Callable[[float], None],
    ) -> None:
        self._recording, self._coding, self._arms, self._root = recording, coding, arms, root
        self._progress = progress
        self._lens = Undistortion(recording.camera)
        self._pictures: Iterator[NDArray[Any]] = recording.masks.pictures()
        self.shares = Shares()

    @property
    def _kinds(self) -> tuple[MaskKind, ...]:
        if len(self._arms) == 1:
            return self._arms
        return (BOTH,) if self._coding.groups.keys() == {WHOLE} else (*self._arms, BOTH)

    def entry(self, part: list[int], sequence_id: str | None, instrument: str) -> SequenceEntry:
        """What the manifest says of a sequence with these of the recording's frames."""
        recording = self._recording
        return SequenceEntry(
            id=sequence_id or f"{recording.numbers[part[0]]:06d}",
            frames=len(part),
            dt_s=recording.timing.dt_s,
            camera=CAMERA_NAME,
            arms=self._arms,
            instruments=dict.fromkeys(self._arms, instrument),
            kinds=self._kinds,
            images=recording.images is not None,
            keypoints=recording.tips is not None,
            readings=recording.joints is not None,
            source_frames=tuple(recording.masks.names[index] for index in part),
        )

    def write(self, part: list[int], entry: SequenceEntry) -> dict[str, FileEntry]:
        """Write a sequence's pictures and table, of the next frames; returns what the manifest says of them."""
        files = write_files(self._root, {observations_path(entry.id): tables.encode_table(self._columns(part))})
        images = self._recording.images
        camera = self._recording.camera
        for frame, index in enumerate(part):
            contents = {
                observed_path(entry.id, kind, frame): encode_mask(mask)
                for kind, mask in self._masks(next(self._pictures), self._recording.numbers[index]).items()
            }
            if images is not None:
                picture = read_picture(images[index], camera.width, camera.height)
                contents[observed_path(entry.id, IMAGE_KIND, frame)] = encode_image(self._lens(as_rgb(picture)))
            files |= write_files(self._root, contents)
            self._progress(1)
        return files

    def _masks(self, picture: NDArray[Any], number: int) -> dict[str, Mask]:
        """A frame's mask of each kind, without the lens's distortion."""
        found = self._coding.masks(picture)
        union = np.logical_or.reduce(list(found.values()))
        self.shares.add(union, number)
        named = {kind: union if kind == BOTH or WHOLE in found else found[kind] for kind in self._kinds}
        return {kind: self._lens(mask.astype(np.uint8), cv2.INTER_NEAREST) > 0 for kind, mask in named.items()}

    def _columns(self, part: list[int]) -> dict[str, FloatArray]:
        recording = self._recording
        times_s = recording.timing.times_s[part]
        columns: dict[str, FloatArray] = {tables.TIMESTAMP: times_s - times_s[0]}
        for arm in self._arms:
            if recording.tips is not None:
                tips = recording.tips[arm][part]
                tips = undistort_points(tips, recording.camera) if is_distorted(recording.camera) else tips
                columns |= dict(zip(arm_columns(arm, KEYPOINT_COLUMNS), tips.reshape(-1, 4).T, strict=True))
            if recording.joints is not None:
                columns |= dict(zip(arm_columns(arm, READING_COLUMNS), recording.joints[arm][part].T, strict=True))
        return columns


def undistort_points(points: FloatArray, camera: Camera) -> FloatArray:
    """Where ``(..., 2)`` pixels lie in the undistorted image; NaN outside of it and where they are NaN already."""
    flat = points.reshape(-1, 1, 2)
    moved = np.asarray(
        cv2.undistortPoints(np.nan_to_num(flat), camera.matrix, np.array(camera.distortion), P=camera.matrix),
        np.float64,
    )
    moved[np.isnan(flat)] = np.nan
    moved[~camera.contains(moved)] = np.nan
    return moved.reshape(points.shape)
