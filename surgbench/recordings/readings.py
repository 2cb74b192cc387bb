"""``joints.csv``: a robot's joint readings, whose unit and jaw are as they are called, as is told, or doubted.

What a file means is decided once, over the whole recording: a wrist at 44 is in degrees, and jaws that open further
than the instrument's can are the whole angle between them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.recordings.arm_columns import THE_ONLY_ONE, Whose, of_arm
from surgbench.recordings.frame_table import Column, read_frame_table
from surgbench.recordings.joint_columns import (
    ARM_JOINTS,
    HALF_JAW,
    HEADER,
    INSERTION,
    JAW,
    WRIST_PITCH,
    WRIST_YAW,
    find_joints,
    says_half,
)
from surgbench.state import JOINTS

AngleUnit = Literal["rad", "deg"]
Jaw = Literal["half", "full"]

# Encoders read a little past the limits, and jaws that press each other well below 0; a wrong unit is far beyond.
SLACK_RAD, CLOSED_SLACK_RAD = 0.2, 0.5
# Half the jaws' opening beyond what the instrument's open to by so much is more than a wrong calibration.
OPEN_SLACK_RAD = 0.05
# Jaws of which either reading is nearer to the other than this are closed, whatever is meant.
CLOSED_RAD = 0.05
# An arm's insertion is 0 to 0.24 m, or 0.29 m.
LONGEST_INSERTION_M = 1.0


@dataclass(frozen=True)
class UntoldJaw:
    """A jaw whose column's name alone says whether it is half the opening or all of it; both are possible.

    Attributes:
        path: The file.
        column: The jaw's, as the file has it.
        taken: What it is taken for.
        joints: ``(frames, 3)`` as it is taken.
        otherwise: ``(frames, 3)`` if it is the other.
    """

    path: Path
    column: str
    taken: Jaw
    joints: FloatArray
    otherwise: FloatArray


@dataclass(frozen=True)
class Readings:
    """Joint readings of a recording.

    Attributes:
        joints: ``(frames, 3)`` q1, q2, q3, rad, q3 from the midline, NaN where none was read; ``None`` where the file
            has no jaw.
        arm: ``(frames, 6)`` the arm's joints, rad and (insertion) m, likewise, where they were asked for.
        note: One line that says how the file was read.
        jaw: What is left to be doubted, by who has masks; ``None`` where nothing is.
    """

    joints: FloatArray | None
    arm: FloatArray | None
    note: str
    jaw: UntoldJaw | None = None


def read_joints(
    path: Path,
    numbers: Sequence[int],
    instrument: Instrument,
    *,
    unit: AngleUnit | None = None,
    jaw: Jaw | None = None,
    arm: bool = False,
    whose: Whose = THE_ONLY_ONE,
    maskless: Collection[int] = (),
) -> Readings | None:
    """Read and doubt a recording's joint readings.

    Args:
        path: Columns ``frame,q1,q2,q3``, or the dVRK's names, in any order (:mod:`surgbench.recordings.joint_columns`).
        numbers: The recording's frames; each needs a row, which may be empty.
        instrument: Its limits are what readings are held against, and joints that it has not need no column.
        unit: Of all angles; unless told, as the column's name says (``jaw_deg``), else radians.
        jaw: Whether the jaw's column is each jaw's angle from the midline, or the whole angle between both; unless
            told, q3 is half and ``jaw`` is whole.
        arm: Take the six joints of the arm too.
        whose: Arm whose columns or rows are meant, where the file has those of two
            (:mod:`surgbench.recordings.arm_columns`).
        maskless: Frames without a mask, whose rows are left out.

    Returns:
        ``None`` if there is no such file.

    Raises:
        DatasetError: Something in the file is wrong, or cannot be what it is taken for; one line that names the option
            that would make it right.
    """
    table = read_frame_table(path, HEADER)
    if table is None:
        if arm:
            raise DatasetError(f"{path}: missing; --joints-arm takes the arm's six joints from it")
        return None
    table = of_arm(table, whose)
    found = find_joints(table)
    if not found:
        raise DatasetError(f"{path}: line 1 must be '{HEADER}': it has no joint")
    if arm and (missing := [name for name in ARM_JOINTS if name not in found]):
        raise DatasetError(f"{path}: --joints-arm needs all six joints of the arm; there is no '{missing[0]}'")
    values = table.values(list(found.values()), numbers, complete=True, maskless=maskless)
    if np.isnan(values).all():
        raise DatasetError(f"{path}: holds no reading of any frame; move it away if there are none")
    read = {
        name: _in_metres(column, values[:, place], path)
        if name == INSERTION
        else _in_radians(column, values[:, place], unit, path)
        for place, (name, column) in enumerate(found.items())
    }
    told = _Told(unit, jaw, any(column.unit in ("rad", "deg") for column in found.values()), jaw or _usual_jaw(found))
    joints = _of_instrument(read, instrument, told, path, may_lack_jaw=arm)
    _doubt(joints, instrument, numbers, path, told)
    six = np.stack([read[name] for name in ARM_JOINTS], axis=1) if arm else None
    has_jaw = "jaw" not in instrument.observable or JAW in found or HALF_JAW in found
    untold = _untold_jaw(joints, found, told, instrument, path)
    said = _note(whose.title(path.name), joints, found, told, arm)
    return Readings(joints if has_jaw else None, six, said, untold)


@dataclass(frozen=True)
class _Told:
    """What is known of a file's angles.

    Attributes:
        unit: By the option.
        jaw: By the option.
        unit_in_names: Columns say their units.
        jaw_as: What the jaw's column is taken for.
    """

    unit: AngleUnit | None
    jaw: Jaw | None
    unit_in_names: bool
    jaw_as: Jaw

    @property
    def options(self) -> str:
        """As they were given."""
        given = (("--joints-unit", self.unit), ("--jaw", self.jaw))
        return " ".join(f"{option} {value}" for option, value in given if value is not None)


def _usual_jaw(found: Mapping[str, Column]) -> Jaw:
    """The dVRK's jaw is the angle between both."""
    return "full" if JAW in found else "half"


def _in_metres(column: Column, values: FloatArray, path: Path) -> FloatArray:
    metres = values / 1000 if column.unit == "mm" else values
    longest = float(np.nanmax(np.abs(metres), initial=0.0))
    if longest > LONGEST_INSERTION_M:
        raise DatasetError(
            f"{path}: '{column.title}' reaches {longest:g} m, further than an arm; if it is in millimetres, call the "
            f"column '{column.name}_mm'"
        )
    return metres


def _in_radians(column: Column, values: FloatArray, unit: AngleUnit | None, path: Path) -> FloatArray:
    if unit is not None and column.unit in ("rad", "deg") and column.unit != unit:
        raise DatasetError(f"{path}: '{column.title}' says {column.unit}, but --joints-unit says {unit}")
    return np.deg2rad(values) if (unit or column.unit) == "deg" else values


def _of_instrument(
    read: Mapping[str, FloatArray], instrument: Instrument, told: _Told, path: Path, *, may_lack_jaw: bool
) -> FloatArray:
    """q1, q2, q3, ``(frames, 3)``; 0 for what the instrument, or a file of the arm's six joints, has not."""
    opening = read.get(JAW, read.get(HALF_JAW))
    if opening is not None and told.jaw_as == "full":
        opening = opening / 2
    given = (("wrist_pitch", read.get(WRIST_PITCH)), ("wrist_yaw", read.get(WRIST_YAW)), ("jaw", opening))
    for number, (name, values) in enumerate(given, start=1):
        if values is None and name in instrument.observable and not (name == "jaw" and may_lack_jaw):
            raise DatasetError(f"{path}: line 1 must be '{HEADER}': it has no column 'q{number}' or '{name}'")
    none = np.zeros(len(next(iter(read.values()))))
    return np.stack([none if values is None else values for _, values in given], axis=1)


def _doubt(joints: FloatArray, instrument: Instrument, numbers: Sequence[int], path: Path, told: _Told) -> None:
    """Refuse readings that the instrument cannot have.

    Raises:
        DatasetError: One line, with the option under which they fit.
    """
    ask_jaw = told.jaw is None and told.jaw_as == "half"
    far = _far(joints, instrument)
    if far.any():
        place, joint = np.argwhere(far)[0]
        low, high = instrument.search_limits.lower_rad[joint], instrument.search_limits.upper_rad[joint]
        count = int(far.any(axis=1).sum())
        what = (
            f"{path}: frame {numbers[place]}: q{joint + 1} is {joints[place, joint]:.4g} rad, far outside the "
            f"instrument's [{low:.4g}, {high:.4g}], as in {count} of {len(joints)} frames"
        )
        halved = joints / [1, 1, 2 if ask_jaw else 1]
        if told.unit is None and not told.unit_in_names and not _far(np.deg2rad(halved), instrument).any():
            whole = ask_jaw and _opens_too_far(np.deg2rad(joints), instrument)
            option = "--joints-unit deg --jaw full" if whole else "--joints-unit deg"
            raise DatasetError(f"{what}; if the file is in degrees: {option}")
        if ask_jaw and not _far(halved, instrument).any():
            raise DatasetError(f"{what}; if that is the whole angle between the jaws: --jaw full")
        read_with = f" (read with {told.options})" if told.options else ""
        raise DatasetError(
            f"{what}{read_with}; mend the file, or say what it holds: --joints-unit rad|deg, --jaw half|full"
        )
    if ask_jaw and _opens_too_far(joints, instrument):
        raise DatasetError(
            f"{path}: the jaws reach {np.nanmax(joints[:, 2]):.4g} rad from the midline, and the instrument's open to "
            f"{instrument.generate_limits.upper_rad[2]:.4g}; if it is the whole angle between the jaws: --jaw full, "
            "else --jaw half"
        )


def _far(joints: FloatArray, instrument: Instrument) -> np.ndarray:
    """``(frames, 3)``: which joints are where the instrument's cannot be; of those that it has not, none."""
    limits = instrument.search_limits
    below = joints < limits.lower_rad - [SLACK_RAD, SLACK_RAD, CLOSED_SLACK_RAD]
    return np.asarray((below | (joints > limits.upper_rad + SLACK_RAD)) & instrument.observed[JOINTS])


def _opens_too_far(joints: FloatArray, instrument: Instrument) -> bool:
    opens_to = instrument.generate_limits.upper_rad[2] + OPEN_SLACK_RAD
    return "jaw" in instrument.observable and bool(np.nanmax(joints[:, 2], initial=0.0) > opens_to)


def _untold_jaw(
    joints: FloatArray, found: Mapping[str, Column], told: _Told, instrument: Instrument, path: Path
) -> UntoldJaw | None:
    column = found.get(JAW, found.get(HALF_JAW))
    if told.jaw is not None or column is None or says_half(column) or "jaw" not in instrument.observable:
        return None
    otherwise = joints * [1, 1, 2 if told.jaw_as == "full" else 0.5]
    apart = np.nanmax(np.abs(joints - otherwise)[:, 2], initial=0.0)
    if apart < CLOSED_RAD or _opens_too_far(otherwise, instrument):
        return None
    return UntoldJaw(path, column.title, told.jaw_as, joints, otherwise)


def _note(title: str, joints: FloatArray, found: Mapping[str, Column], told: _Told, arm: bool) -> str:
    units = sorted({told.unit or column.unit or "rad" for name, column in found.items() if name != INSERTION})
    read = joints[~np.isnan(joints).any(axis=1)]
    said = [f"{title}: {len(read)} readings, {' and '.join(units)}"]
    if len(read) < len(joints):
        said.append(f"{len(joints) - len(read)} frames without one")
    jaw = found.get(JAW, found.get(HALF_JAW))
    if jaw is None:
        said.append("no jaw, so that trackers are given no readings")
    else:
        how = "each jaw's angle from the midline" if told.jaw_as == "half" else "the whole angle between the jaws"
        other = "full" if told.jaw_as == "half" else "half"
        said.append(f"'{jaw.title}' is {how}" + (f" (--jaw {other} if not)" if told.jaw is None else ""))
    spans = zip(read.min(axis=0), read.max(axis=0), strict=True)
    said.append(", ".join(f"q{n} {low:.3g} to {high:.3g}" for n, (low, high) in enumerate(spans, start=1)) + " rad")
    if arm:
        said.append("all six joints of the arm are kept")
    elif INSERTION in found:
        said.append("the arm's other joints are left out (--joints-arm keeps them)")
    return "; ".join(said)
