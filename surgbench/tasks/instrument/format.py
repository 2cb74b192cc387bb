"""What ``dataset.json`` says of the instrument task, and where everything lies in such a dataset's folder."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from surgbench.camera import Camera
from surgbench.config import Finite, Name, Section, Step
from surgbench.dataset.manifest import Frames, Manifest, observations_path
from surgbench.geometry import is_rigid

Arm = Literal["left", "right"]


MaskKind = Literal["left", "right", "both", "visible_left", "visible_right"]


ARMS: tuple[Arm, Arm] = ("left", "right")


IMAGE_KIND = "image"
# Kinds of pictures under ``truth/``, where there are images: depth, and which link is seen.
DEPTH_KIND, LINKS_KIND = "depth", "links"
# A level of a depth picture.
DEPTH_UNIT_M = 1e-5
# Of a camera, focal lengths and how far the principal point may lie.
FURTHEST_PX = 1e7


CONVENTIONS = {
    "camera_frame": "OpenCV: x right, y down, z forward; pixel centres at integers, the top left one at (0, 0)",
    "state": "[alpha, beta, gamma, x, y, z, q1, q2, q3]: R = Ry(gamma) Rx(alpha) Rz(beta) and t = (x, y, z) put the "
    "wrist-pitch frame (z along the shaft towards the jaws) in the camera frame; q1 wrist pitch, q2 wrist yaw, "
    "q3 angle of each jaw from the midline",
    "angles": "alpha in [-pi/2, pi/2]; beta and gamma in [-pi, pi], wrapped",
    "twin": "(beta + pi, -q1, -q2) has nearly the same silhouette",
    "masks": "1-bit PNG, white is instrument; left, right: that arm alone, as if the other were not there; "
    "both: their union",
    "keypoints": "two jaw tips per arm, in no particular order; NaN: not seen",
    "readings": "joint readings as the robot gives them (q1, q2, q3; may lie outside the limits); NaN: no reading",
    "kinematics": "T_base_tool as the robot reads it: the wrist-pitch frame in the frame of the arm's base, as a "
    "rotation vector (rx, ry, rz) and a position (x, y, z); T_cam_base, row by row: the nominal place of that base in "
    "the camera frame; NaN: no reading",
    "missing": "NaN",
}


# Added to the conventions of a dataset that has such views.
AUXILIARY_CONVENTION = {
    "auxiliary views": "T_view_cam, from the frame of the sequence's camera to that of the auxiliary one, as a "
    "rotation vector (rx, ry, rz) and a position (x, y, z), for each kind of mask; observations.parquet has it as "
    "reported, poses.parquet as it is",
}


# Added to the conventions of a dataset that has them.
ARM_JOINTS_CONVENTION = {
    "arm joints": "all six joints of the arm as the robot reads them: yaw, pitch, insertion, roll, wrist pitch, wrist "
    "yaw; NaN: no reading",
}


# Key of the manifest's configuration: the arm's file (:mod:`surgbench.instrument.arms`) whose joints these are.
ROBOT_ARM = "robot_arm"


# Likewise, where the arms are told apart.
VISIBILITY_CONVENTION = {
    "instances": "masks visible_left and visible_right: what is seen of that arm, no pixel of both; the observed ones "
    "are each arm's as a segmentation gives them, in some frames (swapped) each under the other's name; the clean ones "
    "are without occluders",
    "visibility": "per arm, in visibility.parquet: visible, the share of its silhouette in the picture that is seen, "
    "tool_visible, the same of its links but the shaft, front, the share of both arms' overlap in which it is in "
    "front, and swapped, 1 where observed instance masks are exchanged; NaN: share of nothing",
}


# Likewise.
LOOK_CONVENTION = {
    "images": "8-bit RGB of the sequence's camera, whose masks fit them; truth/<id>/look.yaml says how they were made",
    "depth": "16-bit PNG under truth/<id>/depth/: distance from the camera's plane in units of 0.01 mm; 0: nothing",
    "links": "8-bit PNG under truth/<id>/links/: 0 nothing, else 1 + the link's place in the instrument file, and 64 "
    "more of the right arm: what is seen at the pixel's centre",
}


# Likewise.
LABELS_CONVENTION = {
    "labels": "points of the instruments as somebody marked them, in labels.parquet; (u, v) pixels, NaN: not marked",
}


class AuxiliaryEntry(Section):
    """A further camera of a sequence, which may move.

    Attributes:
        camera: Key in the manifest's ``cameras``.
        kinds: Mask kinds that it has; each may be seen from a pose of its own.
        keypoints: Whether its observations have tip keypoints.
        images: Whether ``observed/image/`` is there. Left out of the file where it is not.
    """

    camera: str
    kinds: Annotated[tuple[MaskKind, ...], Field(min_length=1)]
    keypoints: bool = False
    images: bool = False

    @model_serializer(mode="wrap")
    def _without_what_is_not_there(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in serialise(self).items() if key != "images" or value}


class SequenceEntry(Section):
    """One sequence: consecutive frames of one camera, and of further ones.

    Attributes:
        id: Names its folders.
        frames: How many, numbered from 0.
        dt_s: Seconds between frames.
        speed: How fast the instruments move.
        camera: Key in the manifest's ``cameras``.
        arms: The arms in the picture, left before right.
        instruments: Arm to key in the manifest's ``instruments``.
        kinds: Mask kinds under ``observed/``; none in a recording without masks.
        images: Whether ``observed/image/`` is there.
        keypoints: Whether observations have tip keypoints.
        readings: Whether observations have joint readings.
        arm_joints: Whether observations have all six joints of the arm that holds the instrument. Left out of the file
            where they have not.
        labels: Names of the points that somebody marked, under ``truth/<id>/``. Left out of the file where there are
            none.
        truth: Whether ``truth/<id>/`` is there.
        visibility: Whether that holds how much of each arm is seen. Left out of the file where it does not.
        look: Whether that holds how the images were made. Left out of the file where it does not.
        depth: Whether it holds depth pictures. Likewise.
        links: Whether it holds pictures of which link is seen. Likewise.
        T_cam_base: Arm to the nominal place of its base frame in the camera frame, ``(4, 4)`` row by row, of every arm
            whose tool poses the observations hold; empty where they hold none.
        source_frames: File stems in the recording this was imported from.
        auxiliary: Name to what is known of a further view. Left out of the file where there is none.
    """

    id: Name
    frames: Frames
    dt_s: Step
    speed: Literal["nominal", "fast"] = "nominal"
    camera: str
    arms: Annotated[tuple[Arm, ...], Field(min_length=1, max_length=2)]
    instruments: dict[Arm, str]
    kinds: tuple[MaskKind, ...]
    images: bool = False
    keypoints: bool = False
    readings: bool = False
    arm_joints: bool = False
    labels: tuple[Annotated[str, Field(pattern=r"^[a-z0-9_]+$")], ...] = ()
    truth: bool = False
    visibility: bool = False
    look: bool = False
    depth: bool = False
    links: bool = False
    T_cam_base: dict[Arm, Annotated[tuple[Finite, ...], Field(min_length=16, max_length=16)]] = {}
    source_frames: tuple[str, ...] = ()
    auxiliary: dict[Name, AuxiliaryEntry] = {}

    @model_serializer(mode="wrap")
    def _without_what_is_not_there(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # So that the hash of a dataset without them does not know of them.
        optional = ("auxiliary", "arm_joints", "labels", "visibility", "look", "depth", "links")
        return {key: value for key, value in serialise(self).items() if key not in optional or value}

    @model_validator(mode="after")
    def _consistent(self) -> SequenceEntry:
        if list(self.arms) != sorted(set(self.arms)):
            raise ValueError("arms must be ['left'], ['right'] or ['left', 'right']")
        if set(self.instruments) != set(self.arms):
            raise ValueError("instruments must name one instrument per arm")
        if len(set(self.kinds)) != len(self.kinds):
            raise ValueError("a kind is named twice")
        if len(set(self.labels)) != len(self.labels):
            raise ValueError("a label is named twice")
        if self.truth and not self.kinds:
            raise ValueError("a sequence with truth must have masks")
        if self.visibility and not self.truth:
            raise ValueError("a sequence with visibility must have truth")
        if (self.look or self.depth or self.links) and not (self.truth and self.images):
            raise ValueError("a sequence with look, depth or links must have truth and images")
        if self.T_cam_base and set(self.T_cam_base) != set(self.arms):
            raise ValueError("T_cam_base must have every arm, or none")
        for arm, numbers in self.T_cam_base.items():
            if not is_rigid(np.reshape(numbers, (4, 4))):
                raise ValueError(f"T_cam_base of the {arm} arm is not a rotation and a translation")
        for name, view in self.auxiliary.items():
            for kind in view.kinds:
                if kind not in self.kinds:
                    raise ValueError(f"auxiliary view '{name}' has the kind '{kind}', which the sequence has not")
            if view.keypoints and not self.keypoints:
                raise ValueError(f"auxiliary view '{name}' has keypoints, which the sequence has not")
        return self


class InstrumentManifest(Manifest):
    """The whole of ``dataset.json`` of the instrument task.

    Attributes:
        task: What trackers do on it.
        cameras: By name.
        instruments: Name to the instrument file's place in the folder.
        sequences: In order.
    """

    task: Literal["instrument"] = "instrument"
    conventions: dict[str, str] = CONVENTIONS
    cameras: dict[str, Camera]
    instruments: dict[str, str]
    sequences: Annotated[tuple[SequenceEntry, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _references(self) -> InstrumentManifest:
        ids = [sequence.id for sequence in self.sequences]
        if len(set(ids)) != len(ids):
            raise ValueError("two sequences have the same id")
        for sequence in self.sequences:
            if sequence.camera not in self.cameras:
                raise ValueError(f"sequence '{sequence.id}' names the unknown camera '{sequence.camera}'")
            for name, view in sequence.auxiliary.items():
                if view.camera not in self.cameras:
                    raise ValueError(
                        f"sequence '{sequence.id}': auxiliary view '{name}' names the unknown camera '{view.camera}'"
                    )
            for instrument in sequence.instruments.values():
                if instrument not in self.instruments:
                    raise ValueError(f"sequence '{sequence.id}' names the unknown instrument '{instrument}'")
        pictured = sum(entry.frames for entry in self.sequences if entry.kinds or entry.images)
        if pictured > len(self.files):  # before somebody counts to ten million
            raise ValueError(f"sequences of {pictured} frames, each with a picture, but only {len(self.files)} files")
        for name, path in self.instruments.items():
            if path not in self.files:
                raise ValueError(f"instrument '{name}': '{path}' is not among the files")
        return self

    @model_validator(mode="after")
    def _lenses(self) -> InstrumentManifest:
        # Wider than what importers take for plausible: only what makes sizes and gradients that are no numbers.
        for name, camera in self.cameras.items():
            for key, least in (("fx", 1e-3), ("fy", 1e-3), ("cx", -FURTHEST_PX), ("cy", -FURTHEST_PX)):
                value = getattr(camera, key)
                if not least <= value <= FURTHEST_PX:
                    raise ValueError(
                        f"camera '{name}': {key} is {value:g}; expected {least:g} to {FURTHEST_PX:g} pixels"
                    )
        return self

    @property
    def counts(self) -> str:
        """Sequences and frames."""
        return f"{len(self.sequences)} sequences, {sum(entry.frames for entry in self.sequences)} frames"


def frame_name(frame: int) -> str:
    """File name of a frame's mask or image."""
    return f"{frame:06d}.png"


def view_folder(sequence: str, view: str) -> str:
    """What stands for the sequence's id in the paths below where they are those of an auxiliary view."""
    return f"{sequence}/views/{view}"


def poses_path(folder: str) -> str:
    """Where the true poses of an auxiliary view lie; ``folder`` is from :func:`view_folder`."""
    return f"truth/{folder}/poses.parquet"


def observed_path(sequence: str, kind: str, frame: int) -> str:
    """Where what was seen in a frame lies in the folder; ``kind`` is a mask kind or ``image``."""
    return f"sequences/{sequence}/observed/{kind}/{frame_name(frame)}"


def clean_mask_path(sequence: str, kind: str, frame: int) -> str:
    """Where the uncorrupted mask of a frame lies."""
    return f"truth/{sequence}/masks/{kind}/{frame_name(frame)}"


def states_path(sequence: str) -> str:
    """Where a sequence's true states lie."""
    return f"truth/{sequence}/states.parquet"


def visibility_path(sequence: str) -> str:
    """Where it lies how much of each arm is seen in a sequence."""
    return f"truth/{sequence}/visibility.parquet"


def look_path(sequence: str) -> str:
    """Where it lies how a sequence's images were made."""
    return f"truth/{sequence}/look.yaml"


def truth_picture_path(sequence: str, kind: str, frame: int) -> str:
    """Where a frame's picture under ``truth/`` lies; ``kind`` is ``depth`` or ``links``."""
    return f"truth/{sequence}/{kind}/{frame_name(frame)}"


def labels_path(sequence: str) -> str:
    """Where the points lie that somebody marked in a sequence."""
    return f"truth/{sequence}/labels.parquet"


def instrument_folder(name: str) -> str:
    """Where an instrument's file and meshes lie."""
    return f"instruments/{name}"


def sequence_files(entry: SequenceEntry) -> list[str]:
    """Every file that a sequence must have, in order."""
    kinds = [*entry.kinds, *([IMAGE_KIND] if entry.images else [])]
    paths = [observations_path(entry.id)]
    paths += [observed_path(entry.id, kind, frame) for kind in kinds for frame in range(entry.frames)]
    if entry.truth:
        paths.append(states_path(entry.id))
        paths += [clean_mask_path(entry.id, kind, frame) for kind in entry.kinds for frame in range(entry.frames)]
    if entry.visibility:
        paths.append(visibility_path(entry.id))
    if entry.look:
        paths.append(look_path(entry.id))
    for kind, there in ((DEPTH_KIND, entry.depth), (LINKS_KIND, entry.links)):
        paths += [truth_picture_path(entry.id, kind, frame) for frame in range(entry.frames if there else 0)]
    if entry.labels:
        paths.append(labels_path(entry.id))
    for name, view in entry.auxiliary.items():
        folder = view_folder(entry.id, name)
        masks = [(kind, frame) for kind in view.kinds for frame in range(entry.frames)]
        paths.append(observations_path(folder))
        paths += [observed_path(folder, kind, frame) for kind, frame in masks]
        paths += [observed_path(folder, IMAGE_KIND, frame) for frame in range(entry.frames if view.images else 0)]
        if entry.truth:
            paths.append(poses_path(folder))
            paths += [clean_mask_path(folder, kind, frame) for kind, frame in masks]
    return paths
