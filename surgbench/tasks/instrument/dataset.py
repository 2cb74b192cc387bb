"""Reading datasets: sequences of observations, their truth, and the units that trackers run on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.config import parse_model, read_yaml
from surgbench.dataset import tables
from surgbench.dataset.base import Dataset
from surgbench.dataset.integrity import check_inside, read_listed
from surgbench.dataset.manifest import FileEntry, observations_path
from surgbench.dataset.masks import Mask, decode_levels, decode_mask
from surgbench.errors import DatasetError, unknown_name
from surgbench.geometry import FloatArray, rigid_transform, rotation_from_vector
from surgbench.instrument import Instrument, load_instrument
from surgbench.instrument.arms import DEFAULT_ARM, load_arm
from surgbench.instrument.arms import Arm as RobotArm
from surgbench.tasks.instrument.auxiliary import AuxiliaryView, listed_image
from surgbench.tasks.instrument.format import (
    DEPTH_KIND,
    DEPTH_UNIT_M,
    IMAGE_KIND,
    LINKS_KIND,
    ROBOT_ARM,
    Arm,
    InstrumentManifest,
    MaskKind,
    SequenceEntry,
    clean_mask_path,
    labels_path,
    look_path,
    observed_path,
    states_path,
    truth_picture_path,
    visibility_path,
)
from surgbench.tasks.instrument.tables import (
    ARM_JOINT_COLUMNS,
    KEYPOINT_COLUMNS,
    KINEMATICS_COLUMNS,
    READING_COLUMNS,
    STATE_COLUMNS,
    VISIBILITY_COLUMNS,
    arm_columns,
    label_columns,
)


@dataclass(frozen=True)
class InstrumentUnit:
    """What one run of a tracker is about: one arm of a sequence, or its pair.

    Attributes:
        id: ``000-left``, ``000-right``, or the sequence's own id for a pair or a sequence with one arm.
        sequence: The sequence's id.
        arms: Arms in the state's order.
        kind: Which masks show exactly these arms.
    """

    id: str
    sequence: str
    arms: tuple[Arm, ...]
    kind: str

    def spec(self) -> dict[str, Any]:
        """What a record's specification says of it beside its id and sequence."""
        return {"arms": list(self.arms), "mask_kind": self.kind}


class Sequence:
    """One sequence of a dataset. Masks and images are read when asked for; tables once.

    Args:
        root: The dataset's folder.
        entry: Its part of the manifest.
        cameras: All of the dataset's.
        files: What the manifest says of the dataset's files, which must be so when they are read.
        robot_arm: What the manifest says of the arm whose joints the observations have; the default one's unless told.
    """

    def __init__(
        self,
        root: Path,
        entry: SequenceEntry,
        cameras: dict[str, Camera],
        files: Mapping[str, FileEntry],
        robot_arm: dict[str, Any] | None = None,
    ) -> None:
        self.root = root
        self.entry = entry
        self._files = files
        self.camera = cameras[entry.camera]
        self._robot_arm = robot_arm
        self._auxiliary = {
            name: AuxiliaryView(root, entry.id, name, view, cameras[view.camera], files, entry.frames, entry.truth)
            for name, view in entry.auxiliary.items()
        }

    @property
    def id(self) -> str:
        """The sequence's id."""
        return self.entry.id

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.entry.frames

    @property
    def dt_s(self) -> float:
        """Seconds between frames."""
        return self.entry.dt_s

    @property
    def speed(self) -> str:
        """``nominal`` or ``fast``."""
        return self.entry.speed

    @property
    def arms(self) -> tuple[Arm, ...]:
        """The arms in the picture, left before right."""
        return self.entry.arms

    @property
    def instance_kinds(self) -> tuple[MaskKind, ...] | None:
        """Kinds of the masks that tell what shows of each of two arms; ``None`` where not both are there.

        In a recording they are those of the arms: what a segmenter marks of an arm is what shows of it.
        """
        if len(self.arms) < 2:
            return None
        visible: tuple[MaskKind, ...] = ("visible_left", "visible_right")
        alone: tuple[MaskKind, ...] = ("left", "right")
        for kinds in (visible,) if self.entry.truth else (visible, alone):
            if set(kinds) <= set(self.entry.kinds):
                return kinds
        return None

    def instance_masks(self, frame: int) -> tuple[Mask, ...] | None:
        """What shows of each arm as somebody has segmented it, left before right; ``None`` where that is not there."""
        kinds = self.instance_kinds
        return None if kinds is None else tuple(self.mask(kind, frame) for kind in kinds)

    def mask(self, kind: str, frame: int) -> Mask:
        """The mask a tracker sees, ``(height, width)`` bool.

        Raises:
            DatasetError: There is no such kind or frame, or the file is missing, truncated, or of a wrong size.
        """
        self._check(kind, frame)
        return self._read_mask(observed_path(self.id, kind, frame))

    def clean_mask(self, kind: str, frame: int) -> Mask:
        """The rendered mask before corruption, ``(height, width)`` bool.

        Raises:
            DatasetError: The sequence has no truth, or as for :meth:`mask`.
        """
        if not self.entry.truth:
            raise DatasetError(f"{self.root}: sequence '{self.id}' has no ground truth")
        self._check(kind, frame)
        return self._read_mask(clean_mask_path(self.id, kind, frame))

    def image(self, frame: int) -> NDArray[np.uint8] | None:
        """The camera's image, ``(height, width, 3)`` uint8 RGB; ``None`` where there are no images."""
        read = self.image_reader(frame)
        return None if read is None else read()

    def image_reader(self, frame: int) -> Callable[[], NDArray[np.uint8]] | None:
        """What reads a frame's image, and knows of nothing else; ``None`` where there are no images.

        Raises:
            DatasetError: It is not listed, or does not lie in the dataset's folder.
        """
        if not self.entry.images:
            return None
        self._check(None, frame)
        return listed_image(self.root, observed_path(self.id, IMAGE_KIND, frame), self._files, self.camera)

    def image_path(self, frame: int) -> Path | None:
        """Where a frame's image lies; ``None`` where there are no images.

        Raises:
            DatasetError: Not in the dataset's folder.
        """
        if not self.entry.images:
            return None
        self._check(None, frame)
        path = self.root / observed_path(self.id, IMAGE_KIND, frame)
        check_inside(self.root, path)
        return path.resolve()

    def look(self) -> dict[str, Any] | None:
        """How the images were made, as ``truth/<id>/look.yaml`` says; ``None`` where they were not."""
        return read_yaml(self.root / look_path(self.id), "look") if self.entry.look else None

    def depth_m(self, frame: int) -> FloatArray | None:
        """``(height, width)`` metres from the camera's plane, 0 where nothing is; ``None`` if there are none."""
        if not self.entry.depth:
            return None
        self._check(None, frame)
        file = truth_picture_path(self.id, DEPTH_KIND, frame)
        depth = decode_levels(*self._read(file), self.camera.width, self.camera.height, np.uint16)
        return np.asarray(depth, np.uint16) * np.float64(DEPTH_UNIT_M)

    def links(self, frame: int) -> NDArray[np.uint8] | None:
        """``(height, width)`` which link is seen: 0 for none, else 1 + its place in the instrument file, 64 more of the
        right arm; ``None`` if there are none.
        """  # noqa: D205
        if not self.entry.links:
            return None
        self._check(None, frame)
        file = truth_picture_path(self.id, LINKS_KIND, frame)
        links = decode_levels(*self._read(file), self.camera.width, self.camera.height, np.uint8)
        return np.asarray(links, np.uint8)

    def auxiliary(self, name: str) -> AuxiliaryView:
        """One of the sequence's auxiliary views.

        Raises:
            DatasetError: There is none of this name.
        """
        if name not in self._auxiliary:
            problem = unknown_name("auxiliary view", name, self._auxiliary)
            raise DatasetError(f"{self.root}: sequence '{self.id}': {problem}")
        return self._auxiliary[name]

    @cached_property
    def timestamps_s(self) -> FloatArray:
        """``(frames,)`` seconds since the first frame."""
        return self._observations[tables.TIMESTAMP]

    def keypoints(self, arm: Arm) -> FloatArray:
        """``(frames, 2, 2)`` tip pixels (u, v) in no particular order; NaN where a tip was not seen."""
        self._check_arm(arm)
        if not self.entry.keypoints:
            return np.full((self.frames, 2, 2), np.nan)
        columns = arm_columns(arm, KEYPOINT_COLUMNS)
        return tables.stack(self._observations, columns).reshape(-1, 2, 2)

    def readings(self, arm: Arm) -> FloatArray | None:
        """``(frames, 3)`` raw joint readings, NaN where one is missing; ``None`` if the sequence has none."""
        self._check_arm(arm)
        if not self.entry.readings:
            return None
        return tables.stack(self._observations, arm_columns(arm, READING_COLUMNS))

    def arm_joints(self, arm: Arm) -> FloatArray | None:
        """``(frames, 6)`` the robot's readings of the whole arm, NaN where one is missing; ``None`` if there are none.

        Yaw, pitch (rad), insertion (m), roll, wrist pitch and wrist yaw (rad): those of
        :class:`surgbench.instrument.arm.Manipulator`, and the first two of :meth:`readings`.
        """
        self._check_arm(arm)
        if not self.entry.arm_joints:
            return None
        return tables.stack(self._observations, arm_columns(arm, ARM_JOINT_COLUMNS))

    def arm_poses(self, arm: Arm) -> FloatArray | None:
        """``(frames, 4, 4)`` T_base_wrist as the robot reads it, NaN where a reading is missing.

        From :meth:`arm_joints` by forward kinematics of the arm, whose base's place nobody knows; else
        :meth:`kinematics`. ``None`` if the sequence has neither.

        Raises:
            ConfigError: What the manifest says of the arm is wrong.
        """
        joints = self.arm_joints(arm)
        if joints is None:
            return self.kinematics(arm)
        told = self._robot_arm
        robot = load_arm(DEFAULT_ARM) if told is None else parse_model(RobotArm, told, f"{self.root}: {ROBOT_ARM}")
        return robot.forward(joints)

    def labels(self, arm: Arm) -> dict[str, FloatArray]:
        """Points of an arm that somebody marked: name to ``(frames, 2)`` pixels (u, v), NaN where there is none."""
        self._check_arm(arm)
        return {
            label: tables.stack(self._labels, arm_columns(arm, label_columns(label))) for label in self.entry.labels
        }

    def kinematics(self, arm: Arm) -> FloatArray | None:
        """``(frames, 4, 4)`` the robot's own readings of T_base_tool, NaN where one is missing.

        ``None`` if the sequence has none. The base is that of :meth:`T_cam_base`.
        """
        self._check_arm(arm)
        if not self.entry.T_cam_base:
            return None
        poses = tables.stack(self._observations, arm_columns(arm, KINEMATICS_COLUMNS))
        transforms = rigid_transform(rotation_from_vector(poses[:, :3]), poses[:, 3:])
        transforms[np.isnan(poses).any(axis=1)] = np.nan
        return transforms

    def T_cam_base(self, arm: Arm) -> FloatArray | None:  # noqa: N802
        """``(4, 4)`` nominal place of the arm's base in the camera frame; ``None`` if there are no kinematics."""
        self._check_arm(arm)
        numbers = self.entry.T_cam_base.get(arm)
        return None if numbers is None else np.reshape(numbers, (4, 4)).astype(np.float64)

    def states(self, arm: Arm) -> FloatArray | None:
        """``(frames, 9)`` true states; ``None`` if the sequence has no truth."""
        self._check_arm(arm)
        if not self.entry.truth:
            return None
        return tables.stack(self._states, arm_columns(arm, STATE_COLUMNS))

    def visibility(self, arm: Arm) -> dict[str, FloatArray] | None:
        """How much of an arm is seen in each frame; ``None`` if the sequence does not say.

        Returns:
            Each ``(frames,)``: ``visible``, the share of its silhouette in the picture that neither the other arm nor
            an occluder hides; ``tool_visible``, the same of its links but the shaft; ``front``, the share of the pixels
            that both arms cover in which it is in front; ``swapped``, 1 where the observed ``visible_left`` and
            ``visible_right`` are exchanged. Shares of nothing are NaN.
        """
        self._check_arm(arm)
        if not self.entry.visibility:
            return None
        return {name: self._visibility[f"{arm}_{name}"] for name in VISIBILITY_COLUMNS}

    @cached_property
    def _observations(self) -> dict[str, FloatArray]:
        return tables.decode_table(
            *self._read(observations_path(self.id)), self.frames, observation_columns(self.entry)
        )

    @cached_property
    def _labels(self) -> dict[str, FloatArray]:
        return tables.decode_table(*self._read(labels_path(self.id)), self.frames, labelled_columns(self.entry))

    @cached_property
    def _visibility(self) -> dict[str, FloatArray]:
        return tables.decode_table(*self._read(visibility_path(self.id)), self.frames, visibility_columns(self.entry))

    @cached_property
    def _states(self) -> dict[str, FloatArray]:
        return tables.decode_table(*self._read(states_path(self.id)), self.frames, state_columns(self.entry))

    def _read_mask(self, relative: str) -> Mask:
        return decode_mask(*self._read(relative), self.camera.width, self.camera.height)

    def _read(self, relative: str) -> tuple[bytes, str]:
        """A file's bytes, and what it is called in messages."""
        return read_listed(self.root, relative, self._files), str(self.root / relative)

    def _check(self, kind: str | None, frame: int) -> None:
        if kind is not None and kind not in self.entry.kinds:
            raise DatasetError(
                f"{self.root}: sequence '{self.id}': {unknown_name('mask kind', kind, self.entry.kinds)}"
            )
        if not 0 <= frame < self.frames:
            raise DatasetError(f"{self.root}: sequence '{self.id}' has frames 0 to {self.frames - 1}, not {frame}")

    def _check_arm(self, arm: str) -> None:
        if arm not in self.arms:
            raise DatasetError(f"{self.root}: sequence '{self.id}': {unknown_name('arm', arm, self.arms)}")


def observation_columns(entry: SequenceEntry) -> list[str]:
    """Columns that a sequence's ``observations.parquet`` has besides ``frame``."""
    columns = [tables.TIMESTAMP]
    for arm in entry.arms:
        if entry.keypoints:
            columns += arm_columns(arm, KEYPOINT_COLUMNS)
        if entry.readings:
            columns += arm_columns(arm, READING_COLUMNS)
        if entry.arm_joints:
            columns += arm_columns(arm, ARM_JOINT_COLUMNS)
        if entry.T_cam_base:
            columns += arm_columns(arm, KINEMATICS_COLUMNS)
    return columns


def visibility_columns(entry: SequenceEntry) -> list[str]:
    """Columns that a sequence's ``visibility.parquet`` has besides ``frame``."""
    return [column for arm in entry.arms for column in arm_columns(arm, VISIBILITY_COLUMNS)]


def labelled_columns(entry: SequenceEntry) -> list[str]:
    """Columns that a sequence's ``labels.parquet`` has besides ``frame``."""
    return [column for arm in entry.arms for label in entry.labels for column in arm_columns(arm, label_columns(label))]


def state_columns(entry: SequenceEntry) -> list[str]:
    """Columns that a sequence's ``states.parquet`` has besides ``frame``."""
    return [column for arm in entry.arms for column in arm_columns(arm, STATE_COLUMNS)]


class InstrumentDataset(Dataset[InstrumentManifest]):
    """A dataset of the instrument task on disk.

    Attributes:
        sequences: In the manifest's order.
    """

    task: ClassVar[str] = "instrument"

    def __init__(self, path: Path, manifest: InstrumentManifest, hash_: str) -> None:
        super().__init__(path, manifest, hash_)
        robot_arm = manifest.configuration.get(ROBOT_ARM)
        self.sequences = tuple(
            Sequence(path, entry, manifest.cameras, manifest.files, robot_arm) for entry in manifest.sequences
        )

    def length(self, sequence: str) -> int:
        """Number of frames of a sequence."""
        return self.sequence(sequence).frames

    def sequence(self, sequence_id: str) -> Sequence:
        """The sequence with this id.

        Raises:
            DatasetError: There is none.
        """
        for sequence in self.sequences:
            if sequence.id == sequence_id:
                return sequence
        raise DatasetError(f"{self.path}: {unknown_name('sequence', sequence_id, [s.id for s in self.sequences])}")

    def instrument(self, name: str) -> Instrument:
        """One of the dataset's instruments, from the files in its folder.

        Raises:
            DatasetError: The dataset has no such instrument.
            SurgbenchError: Its file is wrong.
        """
        if name not in self._instruments:
            if name not in self.manifest.instruments:
                raise DatasetError(f"{self.path}: {unknown_name('instrument', name, self.manifest.instruments)}")
            self._instruments[name] = load_instrument(self.path / self.manifest.instruments[name])
        return self._instruments[name]

    @cached_property
    def _instruments(self) -> dict[str, Instrument]:
        return {}

    def units(self, arms: Literal["single", "dual"] = "single") -> tuple[InstrumentUnit, ...]:
        """What a tracker runs on, in order.

        Args:
            arms: ``single``: every arm is a sequence of its own, its mask rendered alone. ``dual``: the pair in one
                mask.

        Raises:
            DatasetError: Nothing in the dataset can be run that way.
        """
        units: list[InstrumentUnit] = []
        for sequence in self.sequences:
            entry = sequence.entry
            # Of a video alone, masks can be made.
            kinds = entry.kinds if entry.kinds or not entry.images else (*entry.arms, "both")
            if arms == "dual" and len(entry.arms) == 2 and "both" in kinds:
                units.append(InstrumentUnit(entry.id, entry.id, entry.arms, "both"))
            elif arms == "single":
                alone = [arm for arm in entry.arms if arm in kinds]
                units += [
                    InstrumentUnit(entry.id if len(entry.arms) == 1 else f"{entry.id}-{arm}", entry.id, (arm,), arm)
                    for arm in alone
                ]
        if not units:
            if not any(sequence.entry.kinds for sequence in self.sequences):
                raise DatasetError(
                    f"{self.path}: has neither masks, which trackers work on, nor images to make them of"
                )
            need = "two arms in one mask ('both')" if arms == "dual" else "a mask of one arm alone"
            other = "single" if arms == "dual" else "dual"
            raise DatasetError(f"{self.path}: no sequence has {need}; try --arms {other}")
        return tuple(units)
