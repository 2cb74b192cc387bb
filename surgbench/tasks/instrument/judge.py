"""Runs held against the robot's readings of its tools: what a record of a recording without truth has of it."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.errors import DatasetError, SurgbenchError
from surgbench.geometry import FloatArray, look_at_rotation, rigid_transform
from surgbench.handeye import HandEye, TooLittleMotionError, estimate_hand_eye
from surgbench.instrument import Instrument
from surgbench.registry import find
from surgbench.sources import own_modules
from surgbench.state import ANGLES, POSITION
from surgbench.syntax import parse_file
from surgbench.tasks.instrument.dataset import Sequence
from surgbench.tasks.instrument.format import Arm
from surgbench.tasks.instrument.records import JUDGED

# Attribute of an observation that holds the readings that a run is judged by.
KINEMATICS = "kinematics"


def judge(
    sequence: Sequence, arm: Arm, instrument: Instrument, states: FloatArray, counts: NDArray[np.bool_]
) -> HandEye:
    """Hold one arm's estimates against the robot's readings of it.

    Args:
        sequence: What was tracked.
        arm: Which arm.
        instrument: What it holds.
        states: ``(n, 9)`` estimates of the first n frames.
        counts: ``(n,)`` which of them to learn hand-eye transform and lag from.

    Raises:
        DatasetError: The sequence has no readings of the arm's pose.
        TooLittleMotionError: Too few frames, or too little motion, to say anything; one line.
    """
    readings = sequence.arm_poses(arm)
    if readings is None:
        raise DatasetError(
            f"{sequence.root}: sequence '{sequence.id}' has no readings of the arm's pose to judge by; "
            "import a recording with the readings of all joints of its arm (surgbench import masks … --joints-arm)"
        )
    tracked = np.full((sequence.frames, 4, 4), np.nan)
    tracked[: len(states)] = rigid_transform(look_at_rotation(states[:, ANGLES]), states[:, POSITION])
    learnt = np.zeros(sequence.frames, dtype=bool)
    learnt[: len(states)] = counts
    try:
        return estimate_hand_eye(
            sequence.timestamps_s, tracked, readings, sequence.dt_s, learnt, symmetry=instrument.symmetry
        )
    except TooLittleMotionError as error:
        raise TooLittleMotionError(f"{sequence.root}: sequence '{sequence.id}', {arm} arm: {error}") from None


def judged_columns(
    sequence: Sequence,
    arms: tuple[Arm, ...],
    instruments: tuple[Instrument, ...],
    states: FloatArray,
    counts: NDArray[np.bool_],
    readings: str,
    references: Mapping[str, str],
) -> dict[str, list[float | None]]:
    """What a record has of it: of each arm the median residuals and the lag, ``None`` where there is no saying.

    Args:
        sequence: What was tracked.
        arms: Of the states.
        instruments: What they hold.
        states: ``(n, arms, 9)`` of the first n frames.
        counts: ``(n,)`` which frames to learn from.
        readings: Which the run was given.
        references: Its plug-ins, by kind.

    Returns:
        Empty where there is truth, or nothing to judge by, or where the run was given what it would be judged by.
    """
    read = bool(sequence.entry.T_cam_base) or sequence.entry.arm_joints
    if sequence.entry.truth or not read or was_given(readings, references):
        return {}
    columns: dict[str, list[float | None]] = {name: [] for name in JUDGED}
    for index, (arm, instrument) in enumerate(zip(arms, instruments, strict=True)):
        try:
            found = judge(sequence, arm, instrument, states[:, index], counts)
        except TooLittleMotionError:
            values: tuple[float | None, ...] = (None,) * len(JUDGED)
        else:
            values = (float(np.median(found.rotation_rad)), float(np.median(found.translation_m)), found.lag_frames)
        for name, value in zip(JUDGED, values, strict=True):
            columns[name].append(value)
    return columns


def was_given(readings: str, references: Mapping[str, str]) -> bool:
    """Whether a run may have used the robot's readings of its arm, by which it then can't be judged.

    They come with joint readings. A plug-in that names them in its code is taken to use them, and so is one whose code
    is not here.

    Args:
        readings: Which the run was given.
        references: Its plug-ins, by kind.
    """
    if readings == "none":
        return False
    try:
        return any(_names_kinematics(find(kind, name).modules) for kind, name in references.items())
    except SurgbenchError:
        return True


def frames_that_count(lost: Iterable[bool], mask_errors: Iterable[Any]) -> NDArray[np.bool_]:
    """Frames to learn from, ``(n,)``: of which a tracker does not say that it is lost, and which show an instrument."""
    shown = [error is not None and not np.isnan(error) for error in mask_errors]
    return np.asarray(~np.array(list(lost), dtype=bool) & np.array(shown, dtype=bool))


def _names_kinematics(modules: Iterable[str]) -> bool:
    return any(_reads(module.path, module.path.stat().st_mtime_ns) for module in own_modules(modules))


@lru_cache(maxsize=1024)
def _reads(path: Path, _stamp: int) -> bool:
    """Whether a file has an attribute of that name."""
    tree = parse_file(path)
    return any(isinstance(node, ast.Attribute) and node.attr == KINEMATICS for node in ast.walk(tree))
