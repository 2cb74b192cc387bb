"""A sequence's numbers: how the arms truly move, and what is observed of it but the masks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.dataset import tables
from surgbench.generators.auxiliary import ViewTables, make_views
from surgbench.generators.instances import swapped_frames
from surgbench.generators.looks.sequence import EYE, SequenceLook, eye_tables, make_look
from surgbench.generators.observations import (
    lagged,
    observe_arm,
    observe_free_tool,
    observe_joints,
    observe_keypoints,
)
from surgbench.generators.occluders import InTheWay, put_in_the_way
from surgbench.generators.presets import Preset
from surgbench.generators.seen_tips import seen_tips
from surgbench.generators.trajectories import make_motion
from surgbench.geometry import FloatArray, rotation_vector
from surgbench.instrument import Instrument
from surgbench.randomness import generator
from surgbench.tasks.instrument.format import Arm, SequenceEntry
from surgbench.tasks.instrument.tables import (
    KEYPOINT_COLUMNS,
    KINEMATICS_COLUMNS,
    READING_COLUMNS,
    STATE_COLUMNS,
    arm_columns,
)


@dataclass(frozen=True)
class ToldApart:
    """How the arms of a sequence are told apart.

    Attributes:
        swapped: ``(frames,)`` where the observed masks of the arms are exchanged.
        in_the_way: What hides them besides each other.
    """

    swapped: NDArray[np.bool_]
    in_the_way: InTheWay


@dataclass(frozen=True)
class SequenceTables:
    """Tables of a sequence.

    Attributes:
        states: ``(frames, 2, 9)``, left arm first.
        observed: Columns of ``observations.parquet``.
        truth: Columns of ``states.parquet``.
        T_cam_base: Nominal place of each arm's base, ``(4, 4)`` row by row.
        views: Those of the auxiliary views.
        apart: Of the whole sequence; ``None`` where the preset tells no arms apart.
        look: What images need, of the whole sequence; ``None`` for a preset without.
    """

    states: FloatArray
    observed: dict[str, FloatArray]
    truth: dict[str, FloatArray]
    T_cam_base: dict[Arm, tuple[float, ...]]
    views: dict[str, ViewTables]
    apart: ToldApart | None = None
    look: SequenceLook | None = None

    def first(self, frames: int) -> SequenceTables:
        """The same of the first frames alone."""
        observed = {name: values[:frames] for name, values in self.observed.items()}
        truth = {name: values[:frames] for name, values in self.truth.items()}
        views = {name: view.first(frames) for name, view in self.views.items()}
        return SequenceTables(self.states[:frames], observed, truth, self.T_cam_base, views, self.apart, self.look)


def make_tables(preset: Preset, entry: SequenceEntry, instrument: Instrument, camera: Camera) -> SequenceTables:
    """Move the arms of a sequence and observe them.

    Args:
        preset: How.
        entry: Which sequence.
        instrument: The real one.
        camera: The real one, distortion included.

    Raises:
        ConfigError: The workspace is too tight for the motion.
    """
    axes: dict[str, str | int] = {"dataset": preset.seed, "sequence": entry.id}
    # All of the sequence, also where only its first frames are wanted: what moves or errs slowly depends on its length.
    frames = preset.length(int(entry.id))
    seen_by = preset.model_copy(update={"camera": camera})
    motion = make_motion(
        seen_by, instrument, preset.half(int(entry.id)), frames, generator(**axes, purpose="trajectory")
    )
    apart, hidden = None, None
    if preset.instances is not None:
        swapped = swapped_frames(preset.instances, frames, generator(**axes, purpose="swaps"))
        hiding = put_in_the_way(preset.occluders, motion.states, instrument, camera, entry.dt_s, **axes)
        apart = ToldApart(swapped, hiding)
        hidden = ~seen_tips(motion.states, instrument, camera, hiding)
    observed: dict[str, FloatArray] = {tables.TIMESTAMP: np.arange(frames, dtype=np.float64) * entry.dt_s}
    truth: dict[str, FloatArray] = {}
    bases: dict[Arm, tuple[float, ...]] = {}
    lag = float(generator(**axes, purpose="lag").uniform(*preset.readings.lag_frames))
    for index, arm in enumerate(entry.arms):
        own, robot = motion.states[:, index], motion.arms[index]
        logged = lagged(own, lag)
        rng = generator(**axes, arm=arm, purpose="keypoints")
        own_hidden = None if hidden is None else hidden[:, index]
        points = observe_keypoints(own, instrument, camera, preset.keypoints, rng, own_hidden)
        readings = observe_joints(logged, preset.readings, entry.dt_s, generator(**axes, arm=arm, purpose="readings"))
        rng = generator(**axes, arm=arm, purpose="kinematics")
        if robot is None:
            tool = observe_free_tool(logged, preset.kinematics, rng)
        else:
            joints = lagged(robot.arm_joints, lag)
            tool = observe_arm(joints, robot.arm, robot.T_cam_base, preset.kinematics, entry.dt_s, rng)
        observed |= _columns(arm, KEYPOINT_COLUMNS, points.reshape(-1, 4))
        observed |= _columns(arm, READING_COLUMNS, readings + preset.mismatch.joint_offset_rad)
        poses = [rotation_vector(tool.T_base_tool[:, :3, :3]), tool.T_base_tool[:, :3, 3]]
        observed |= _columns(arm, KINEMATICS_COLUMNS, np.hstack(poses))
        bases[arm] = tuple(tool.T_cam_base.ravel().tolist())
        truth |= _columns(arm, STATE_COLUMNS, own)
    views = make_views(preset, entry.id, motion.states, instrument)
    look = make_look(preset, entry.id, motion.states, instrument)
    if look is not None and look.T_eye_cam is not None:
        views[EYE] = eye_tables(look.T_eye_cam, motion.states, instrument, camera, preset.keypoints, **axes)
    return SequenceTables(motion.states, observed, truth, bases, views, apart, look).first(entry.frames)


def _columns(arm: Arm, names: tuple[str, ...], values: FloatArray) -> dict[str, FloatArray]:
    return dict(zip(arm_columns(arm, names), values.T, strict=True))
