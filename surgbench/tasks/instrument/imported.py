"""Writes what importers found as a dataset: one frame at a time, undistorted, all of it or nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from surgbench.camera import Camera
from surgbench.contract import Mask
from surgbench.dataset import tables
from surgbench.dataset.manifest import MANIFEST_NAME, FileEntry, dataset_name, observations_path
from surgbench.dataset.masks import encode_image, encode_mask
from surgbench.dataset.storage import file_entry, new_folder
from surgbench.dataset.writer import write_files
from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray, rotation_vector
from surgbench.instrument import Instrument, save_instrument
from surgbench.recordings.shares import Shares
from surgbench.tasks.instrument.auxiliary import keypoint_columns, kind_arms
from surgbench.tasks.instrument.footage import BOTH, Footage, SecondView, Shot, written
from surgbench.tasks.instrument.format import (
    ARM_JOINTS_CONVENTION,
    AUXILIARY_CONVENTION,
    CONVENTIONS,
    IMAGE_KIND,
    LABELS_CONVENTION,
    Arm,
    InstrumentManifest,
    clean_mask_path,
    instrument_folder,
    labels_path,
    observed_path,
    states_path,
    view_folder,
)
from surgbench.tasks.instrument.straightened import Straightened
from surgbench.tasks.instrument.tables import (
    ARM_JOINT_COLUMNS,
    KEYPOINT_COLUMNS,
    READING_COLUMNS,
    STATE_COLUMNS,
    VIEW_COLUMNS,
    arm_columns,
    label_columns,
)
from surgbench.version import __version__

CAMERA_NAME = "camera"


def write_import(
    out: Path,
    footages: Sequence[Footage],
    *,
    name: str,
    instruments: Mapping[Arm, Instrument],
    configuration: Mapping[str, Any],
    progress: Callable[[float], None] = lambda frames: None,
    tell: bool = True,
) -> list[str]:
    """Write sequences as a dataset.

    Args:
        out: Its folder: new or empty. It appears when all is written.
        footages: Their pictures are asked for one frame at a time.
        name: Of the dataset; what cannot stand in a name is replaced.
        instruments: Of each arm.
        configuration: The importer and its options.
        progress: Takes the number of frames just written.
        tell: Say of each sequence what was written; else the importer knows better.

    Returns:
        What is to be told of it, line by line; warnings begin with ``warning:``.

    Raises:
        SurgbenchError: Something in the pictures is wrong, ``out`` holds something, or the disk is full; one line.
    """
    if not footages:
        raise DatasetError(f"{name}: no frames")
    models = {model.name: model for model in instruments.values()}
    cameras = _named_cameras(
        [
            written(camera, halved=footage.halved)
            for footage in footages
            for camera in (footage.camera, *(view.camera for view in footage.views.values()))
        ]
    )
    lines: list[str] = []
    with new_folder(out) as scratch:
        files: dict[str, FileEntry] = {}
        for model in models.values():
            saved = save_instrument(model, scratch / instrument_folder(model.name))
            files |= {path.relative_to(scratch).as_posix(): file_entry(path.read_bytes()) for path in saved}
        entries = []
        for footage in footages:
            entries.append(footage.entry({camera: key for key, camera in cameras.items()}, instruments))
            writer = _Writer(footage, scratch, progress)
            files |= writer.write()
            lines += writer.told() if tell else ()
        manifest = InstrumentManifest(
            name=dataset_name(name),
            created_by=f"surgbench {__version__}",
            origin="imported",
            configuration={**configuration, **_optics(footages)},
            conventions=CONVENTIONS | _further_conventions(footages),
            cameras=cameras,
            instruments={model: f"{instrument_folder(model)}/instrument.yaml" for model in models},
            sequences=tuple(entries),
            files=files,
        )
        (scratch / MANIFEST_NAME).write_bytes(manifest.to_bytes())
    return lines


def _optics(footages: Sequence[Footage]) -> dict[str, Any]:
    sources = list(dict.fromkeys(footage.camera for footage in footages))
    told = [camera.model_dump(mode="json") for camera in sources]
    return {
        "undistorted": any(camera.is_distorted for camera in sources),
        "source_camera": told[0] if len(told) == 1 else told,
    }


def _further_conventions(footages: Sequence[Footage]) -> dict[str, str]:
    joints = any(footage.arm_joints is not None for footage in footages)
    labels = any(footage.labels for footage in footages)
    views = any(footage.views for footage in footages)
    return (
        (ARM_JOINTS_CONVENTION if joints else {})
        | (LABELS_CONVENTION if labels else {})
        | (AUXILIARY_CONVENTION if views else {})
    )


def _named_cameras(cameras: Sequence[Camera]) -> dict[str, Camera]:
    different = list(dict.fromkeys(cameras))
    if len(different) == 1:
        return {CAMERA_NAME: different[0]}
    return {f"{CAMERA_NAME}-{number}": camera for number, camera in enumerate(different)}


class _Writer:
    """Writes one sequence."""

    def __init__(self, footage: Footage, root: Path, progress: Callable[[float], None]) -> None:
        self._footage, self._root, self._progress = footage, root, progress
        self._straight = Straightened(footage.camera, halved=footage.halved, who=footage.id)
        self._views = {
            name: Straightened(view.camera, halved=footage.halved, who=f"{footage.id}, {name}")
            for name, view in footage.views.items()
        }
        self._shares = Shares()
        self._outside = 0

    def write(self) -> dict[str, FileEntry]:
        """Write it; returns what the manifest says of its files."""
        footage = self._footage
        contents = {observations_path(footage.id): tables.encode_table(self._observations())}
        if footage.labels:
            contents[labels_path(footage.id)] = tables.encode_table(self._labels())
        if footage.states is not None:
            columns = [
                dict(zip(arm_columns(arm, STATE_COLUMNS), footage.states[arm].T, strict=True)) for arm in footage.arms
            ]
            contents[states_path(footage.id)] = tables.encode_table({k: v for one in columns for k, v in one.items()})
        for name, view in footage.views.items():
            contents[observations_path(view_folder(footage.id, name))] = tables.encode_table(self._seen(name, view))
        files = write_files(self._root, contents)
        others = {name: view.masks() for name, view in footage.views.items()}
        count = 0
        for frame, shot in enumerate(footage.shots()):
            files |= write_files(self._root, self._pictures(frame, shot))
            for name, masks in others.items():
                files |= write_files(self._root, self._masks_of(name, frame, next(masks)))
            self._progress(1)
            count += 1
        if count != len(footage.times_s):
            raise DatasetError(f"sequence '{footage.id}': {count} frames can be read, not {len(footage.times_s)}")
        return files

    def told(self) -> Iterator[str]:
        """What is to be told of what was written."""
        footage = self._footage
        frames = f"{footage.id}: {len(footage.times_s)} frames"
        yield f"{frames}, {self._shares.said}" if footage.kinds else f"{frames} without masks"
        if self._outside:
            yield f"warning: {footage.id}: {self._outside} points lie outside the picture, and are left out"
        if footage.kinds:
            for line in self._shares.warnings(one_arm=len(footage.kinds) == 1 and BOTH not in footage.kinds):
                yield f"warning: {footage.id}: {line}"

    def _pictures(self, frame: int, shot: Shot) -> dict[str, bytes]:
        footage, straight, contents = self._footage, self._straight, dict[str, bytes]()
        if footage.kinds:
            masks = straight.masks(shot.masks)
            self._shares.add(masks[BOTH] if BOTH in masks else next(iter(masks.values())), frame)
            contents |= {observed_path(footage.id, kind, frame): encode_mask(mask) for kind, mask in masks.items()}
            if footage.states is not None:
                clean = masks if shot.clean is None else straight.masks(shot.clean)
                contents |= {
                    clean_mask_path(footage.id, kind, frame): encode_mask(mask) for kind, mask in clean.items()
                }
        if footage.images:
            assert shot.image is not None
            contents[observed_path(footage.id, IMAGE_KIND, frame)] = encode_image(straight.picture(shot.image))
        return contents

    def _masks_of(self, view: str, frame: int, masks: Mapping[str, Mask]) -> dict[str, bytes]:
        folder = view_folder(self._footage.id, view)
        return {
            observed_path(folder, kind, frame): encode_mask(mask)
            for kind, mask in self._views[view].masks(masks).items()
        }

    def _points(self, points: FloatArray, *, counted: bool) -> FloatArray:
        moved = self._straight.points(points)
        lost = ~np.isnan(points).any(axis=-1) & np.isnan(moved).any(axis=-1)
        self._outside += counted * int(lost.sum())
        return moved

    def _observations(self) -> dict[str, FloatArray]:
        footage = self._footage
        columns = {tables.TIMESTAMP: footage.times_s - footage.times_s[0]}
        for arm in footage.arms:
            if footage.tips is not None:
                tips = self._points(footage.tips[arm], counted=not footage.labels)  # else they are among the labels
                columns |= dict(zip(arm_columns(arm, KEYPOINT_COLUMNS), tips.reshape(-1, 4).T, strict=True))
            if footage.joints is not None:
                columns |= dict(zip(arm_columns(arm, READING_COLUMNS), footage.joints[arm].T, strict=True))
            if footage.arm_joints is not None:
                columns |= dict(zip(arm_columns(arm, ARM_JOINT_COLUMNS), footage.arm_joints[arm].T, strict=True))
        return columns

    def _seen(self, name: str, view: SecondView) -> dict[str, FloatArray]:
        """Columns of a further view: where it is, and the tips that are seen in it."""
        pose = np.concatenate([rotation_vector(view.T_view_cam[:3, :3]), view.T_view_cam[:3, 3]])
        columns: dict[str, FloatArray] = {}
        for kind in self._footage.all_kinds:
            poses = np.tile(pose, (len(self._footage.times_s), 1))
            columns |= dict(zip(arm_columns(kind, VIEW_COLUMNS), poses.T, strict=True))
            for arm in kind_arms(kind):
                if view.tips is not None:
                    tips = self._views[name].points(view.tips[arm]).reshape(-1, 4)
                    columns |= dict(zip(keypoint_columns(kind, arm), tips.T, strict=True))
        return columns

    def _labels(self) -> dict[str, FloatArray]:
        columns: dict[str, FloatArray] = {}
        for arm in self._footage.arms:
            for label, by_arm in self._footage.labels.items():
                points = self._points(by_arm[arm], counted=True)
                columns |= dict(zip(arm_columns(arm, label_columns(label)), points.T, strict=True))
        return columns
