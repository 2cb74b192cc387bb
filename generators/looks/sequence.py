"""What the images of one sequence need beside its states: its look, how fast everything moves, and the other eye."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surgbench.camera import Camera
from surgbench.camera.change_of_view import ChangeOfView
from surgbench.generators.auxiliary import ViewTables, pose_columns_of
from surgbench.generators.looks.look import Look, draw_look
from surgbench.generators.looks.sections import Images, Stereo
from surgbench.generators.observations import observe_keypoints
from surgbench.generators.presets import Keypoints, Preset
from surgbench.geometry import FloatArray, rigid_transform
from surgbench.instrument import Instrument
from surgbench.randomness import generator
from surgbench.state import ALPHA, BETA, GAMMA
from surgbench.tasks.instrument.auxiliary import keypoint_columns, kind_arms
from surgbench.tasks.instrument.format import ARMS, MaskKind

EYE = "right-eye"
EYE_KINDS: tuple[MaskKind, ...] = ("left", "right", "both")


@dataclass(frozen=True)
class SequenceLook:
    """What the images of a sequence need beside its states.

    Attributes:
        look: As drawn.
        first: ``(2, 9)`` states of the first frame, which the exposure is set for.
        steps: ``(frames, 2, 9)`` how states change from frame to frame.
        nearest_m: What lies behind the instruments comes no nearer to the camera's plane.
        T_eye_cam: ``(4, 4)`` of the other eye; ``None`` where there is none.
    """

    look: Look
    first: FloatArray
    steps: FloatArray
    nearest_m: float
    T_eye_cam: FloatArray | None


def make_look(preset: Preset, sequence: str, states: FloatArray, instrument: Instrument) -> SequenceLook | None:
    """What a sequence's images need; ``None`` for a preset without images.

    Args:
        preset: The whole one.
        sequence: Its id.
        states: ``(frames, 2, 9)`` of the whole sequence.
        instrument: The real one.
    """
    images: Images | None = preset.images
    if images is None:
        return None
    look = draw_look(images, dataset=preset.seed, sequence=sequence)
    deepest = -np.inf
    transforms = instrument.link_transforms(states)
    for name, mesh in instrument.meshes.items():
        placed = transforms[..., instrument.link_index[name], :, :]
        depth = mesh.vertices_m @ placed[..., 2, :3][..., None] + placed[..., 2, 3][..., None, None]
        deepest = max(deepest, float(depth.max()))
    eye = None if images.stereo is None else eye_pose(images.stereo)
    return SequenceLook(look, states[0], steps(states), deepest + look["gap_m"], eye)


def steps(states: FloatArray) -> FloatArray:
    """How states change from frame to frame, in the mean of the one before and the one after.

    Args:
        states: ``(frames, ..., 9)``.

    Returns:
        The same shape; angles by the shorter way.
    """
    change = np.diff(states, axis=0)
    angles = [ALPHA, BETA, GAMMA]
    change[..., angles] = (change[..., angles] + np.pi) % (2 * np.pi) - np.pi
    if not len(change):
        return np.zeros_like(states)
    return np.concatenate([change[:1], (change[1:] + change[:-1]) / 2, change[-1:]])


def eye_pose(stereo: Stereo) -> FloatArray:
    """``(4, 4)`` T_eye_cam: the right eye, from the sequence's camera, which is the left one."""
    cos, sin = np.cos(stereo.vergence_rad), np.sin(stereo.vergence_rad)
    # Turned to the left: what is ahead of the left eye moves to the right in the right one.
    turn = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    return rigid_transform(turn, -turn @ np.array([stereo.baseline_m, 0.0, 0.0]))


def eye_tables(
    T_eye_cam: FloatArray,
    states: FloatArray,
    instrument: Instrument,
    camera: Camera,
    keypoints: Keypoints,
    **axes: str | int,
) -> ViewTables:
    """Tables of the other eye, whose place is known exactly.

    Args:
        T_eye_cam: ``(4, 4)``.
        states: ``(frames, 2, 9)``.
        instrument: The real one.
        camera: The real one, distortion included; of both eyes.
        keypoints: How they err.
        axes: Dataset and sequence.
    """
    poses = np.tile(T_eye_cam, (len(states), 1, 1))
    seen = ChangeOfView(T_eye_cam).states(states.reshape(len(states), -1)).reshape(states.shape)
    truth: dict[str, FloatArray] = {}
    observed: dict[str, FloatArray] = {}
    for kind in EYE_KINDS:
        truth |= pose_columns_of(kind, poses)
    observed |= truth
    for kind in EYE_KINDS:
        for arm in kind_arms(kind):
            rng = generator(**axes, arm=arm, kind=kind, view=EYE, purpose="keypoints")
            points = observe_keypoints(seen[:, ARMS.index(arm)], instrument, camera, keypoints, rng)
            observed |= dict(zip(keypoint_columns(kind, arm), points.reshape(-1, 4).T, strict=True))
    return ViewTables(dict.fromkeys(ARMS, poses), observed, truth)
