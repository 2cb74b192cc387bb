"""Reading a sequence's auxiliary views: what further cameras see, and where they are."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.dataset import tables
from surgbench.dataset.integrity import check_inside, read_listed, read_unaltered
from surgbench.dataset.manifest import MANIFEST_NAME, FileEntry, observations_path
from surgbench.dataset.masks import Mask, decode_image, decode_mask
from surgbench.errors import DatasetError, unknown_name
from surgbench.geometry import FloatArray, rigid_transform, rotation_from_vector
from surgbench.tasks.instrument.format import (
    ARMS,
    IMAGE_KIND,
    Arm,
    AuxiliaryEntry,
    clean_mask_path,
    observed_path,
    poses_path,
    view_folder,
)
from surgbench.tasks.instrument.tables import KEYPOINT_COLUMNS, VIEW_COLUMNS, arm_columns


class AuxiliaryView:
    """A further camera of a sequence. Masks are read when asked for; tables once.

    Args:
        root: The dataset's folder.
        sequence: The sequence's id.
        name: Of the view.
        entry: Its part of the manifest.
        camera: Its camera.
        files: What the manifest says of the dataset's files.
        frames: Of the sequence.
        truth: Whether the sequence has ground truth.
    """

    def __init__(
        self,
        root: Path,
        sequence: str,
        name: str,
        entry: AuxiliaryEntry,
        camera: Camera,
        files: Mapping[str, FileEntry],
        frames: int,
        truth: bool,
    ) -> None:
        self._files = files
        self.root, self.name, self.entry, self.camera, self.frames = root, name, entry, camera, frames
        self._folder = view_folder(sequence, name)
        self._truth = truth

    def mask(self, kind: str, frame: int) -> Mask:
        """The mask a tracker sees, ``(height, width)`` bool.

        Raises:
            DatasetError: There is no such kind or frame, or the file is missing, truncated, or of a wrong size.
        """
        self._check(kind, frame)
        return self._read_mask(observed_path(self._folder, kind, frame))

    def clean_mask(self, kind: str, frame: int) -> Mask:
        """The rendered mask before corruption, ``(height, width)`` bool.

        Raises:
            DatasetError: The sequence has no truth, or as for :meth:`mask`.
        """
        self._check_truth()
        self._check(kind, frame)
        return self._read_mask(clean_mask_path(self._folder, kind, frame))

    def image(self, frame: int) -> NDArray[np.uint8] | None:
        """The camera's image, ``(height, width, 3)`` uint8 RGB; ``None`` where there are no images."""
        read = self.image_reader(frame)
        return None if read is None else read()

    def image_reader(self, frame: int) -> Callable[[], NDArray[np.uint8]] | None:
        """As :meth:`surgbench.tasks.instrument.dataset.Sequence.image_reader`."""
        if not self.entry.images:
            return None
        self._check(self.entry.kinds[0], frame)
        return listed_image(self.root, observed_path(self._folder, IMAGE_KIND, frame), self._files, self.camera)

    def keypoints(self, kind: str, arm: Arm) -> FloatArray:
        """``(frames, 2, 2)`` tip pixels (u, v) in no particular order; NaN where a tip was not seen.

        Args:
            kind: Of the masks that the tips belong to: each kind may be seen from a pose of its own.
            arm: One that the kind shows.
        """
        self._check(kind, 0)
        if not self.entry.keypoints:
            return np.full((self.frames, 2, 2), np.nan)
        return tables.stack(self._observations, keypoint_columns(kind, arm)).reshape(-1, 2, 2)

    def T_view_cam(self, kind: str) -> FloatArray:  # noqa: N802
        """``(frames, 4, 4)`` from the sequence's camera to this one as it is reported, errors included."""
        self._check(kind, 0)
        return _transforms(self._observations, kind)

    def true_T_view_cam(self, kind: str) -> FloatArray:  # noqa: N802
        """The same as it is.

        Raises:
            DatasetError: The sequence has no truth.
        """
        self._check_truth()
        self._check(kind, 0)
        return _transforms(self._poses, kind)

    @cached_property
    def _observations(self) -> dict[str, FloatArray]:
        return tables.decode_table(
            *self._read(observations_path(self._folder)), self.frames, auxiliary_columns(self.entry)
        )

    @cached_property
    def _poses(self) -> dict[str, FloatArray]:
        return tables.decode_table(*self._read(poses_path(self._folder)), self.frames, pose_columns(self.entry))

    def _read_mask(self, relative: str) -> Mask:
        return decode_mask(*self._read(relative), self.camera.width, self.camera.height)

    def _read(self, relative: str) -> tuple[bytes, str]:
        """A file's bytes, and what it is called in messages."""
        return read_listed(self.root, relative, self._files), str(self.root / relative)

    def _check(self, kind: str, frame: int) -> None:
        if kind not in self.entry.kinds:
            problem = unknown_name("mask kind", kind, self.entry.kinds)
            raise DatasetError(f"{self.root}: auxiliary view '{self.name}': {problem}")
        if not 0 <= frame < self.frames:
            raise DatasetError(
                f"{self.root}: auxiliary view '{self.name}' has frames 0 to {self.frames - 1}, not {frame}"
            )

    def _check_truth(self) -> None:
        if not self._truth:
            raise DatasetError(f"{self.root}: auxiliary view '{self.name}' has no ground truth")


def listed_image(
    root: Path, file: str, files: Mapping[str, FileEntry], camera: Camera
) -> Callable[[], NDArray[np.uint8]]:
    """What reads an image of a dataset when it is called, and tells where it is altered.

    It may be sent to a tracker: it knows the place and the hash of one file, and not the sequence and its truth.

    Raises:
        DatasetError: It is not listed, or does not lie in the dataset's folder; one line.
    """
    if file not in files:
        raise DatasetError(f"{root / file}: not listed in {MANIFEST_NAME}, but its sequence needs it")
    check_inside(root, root / file)
    return partial(_read_image, (root / file).resolve(), files[file], camera.width, camera.height)


def _read_image(path: Path, listed: FileEntry, width: int, height: int) -> NDArray[np.uint8]:
    return decode_image(read_unaltered(path, listed), str(path), width, height)


def _transforms(values: dict[str, FloatArray], kind: str) -> FloatArray:
    poses = tables.stack(values, arm_columns(kind, VIEW_COLUMNS))
    return rigid_transform(rotation_from_vector(poses[:, :3]), poses[:, 3:])


def pose_columns(entry: AuxiliaryEntry) -> list[str]:
    """Columns that an auxiliary view's ``poses.parquet`` has besides ``frame``."""
    return [column for kind in entry.kinds for column in arm_columns(kind, VIEW_COLUMNS)]


def kind_arms(kind: str) -> tuple[Arm, ...]:
    """The arms that a kind of mask shows."""
    return ARMS if kind == "both" else tuple(arm for arm in ARMS if kind.endswith(arm))


def keypoint_columns(kind: str, arm: Arm) -> list[str]:
    """Columns of one arm's tips as they are seen with one kind of mask."""
    return arm_columns(f"both_{arm}" if kind == "both" else kind, KEYPOINT_COLUMNS)


def auxiliary_columns(entry: AuxiliaryEntry) -> list[str]:
    """Columns that an auxiliary view's ``observations.parquet`` has besides ``frame``."""
    columns = pose_columns(entry)
    if entry.keypoints:
        columns += [column for kind in entry.kinds for arm in kind_arms(kind) for column in keypoint_columns(kind, arm)]
    return columns
