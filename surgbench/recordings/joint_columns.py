"""Which column of ``joints.csv`` is which joint: our own names, and those of the dVRK."""

from __future__ import annotations

import re

from surgbench.errors import DatasetError
from surgbench.recordings.frame_table import Column, FrameTable

HEADER = "frame,q1,q2,q3"
ARM_JOINTS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")
INSERTION = ARM_JOINTS[2]
WRIST_PITCH, WRIST_YAW = ARM_JOINTS[4:]
# Each jaw's angle from the midline, as a state has it; and the angle between the two, as the dVRK reports it.
HALF_JAW, JAW = "half_jaw", "jaw"

# What robots' topics and models put before and behind a joint's name.
_BEFORE = re.compile(r"^(?:(?:measured|setpoint|state|position|psm\d?|arm|tool|outer)_)+")
_BEHIND = re.compile(r"(?:_(?:joint|position|angle))+$")
_NUMBERED = re.compile(r"(?:q|j|jp|joint|axis)_?(\d)")
_NAMES = {
    **{name: name for name in ARM_JOINTS},
    "tool_roll": "roll", "jaw": JAW, "gripper": JAW, "half_jaw": HALF_JAW, "jaw_half": HALF_JAW,
}  # fmt: skip


def find_joints(table: FrameTable) -> dict[str, Column]:
    """Find the joints among a table's columns; others are left out.

    q1, q2, q3 alone are our own: wrist pitch, wrist yaw and half the jaws' opening. With q5 and q6, q1 to q6 are the
    six joints of the arm.

    Returns:
        Of ``ARM_JOINTS``, ``HALF_JAW`` and ``JAW``, those that there are, to their columns.

    Raises:
        DatasetError: Two columns are the same joint, or what they are cannot be told; one line.
    """
    numbered: dict[int, Column] = {}
    named: list[tuple[str, Column]] = []
    for column in table.columns:
        number, name = _number(column.name), _name(column.name)
        if number is not None:
            if number in numbered:
                raise _twice(table, numbered[number], column)
            numbered[number] = column
        elif name is not None:
            named.append((name, column))
    if set(numbered) == {1, 2, 3}:
        named += [(WRIST_PITCH, numbered[1]), (WRIST_YAW, numbered[2]), (HALF_JAW, numbered[3])]
    elif {5, 6} <= set(numbered) <= set(range(1, 8)):
        joints = (*ARM_JOINTS, JAW)
        named += [(joints[number - 1], column) for number, column in sorted(numbered.items())]
    elif numbered:
        titles = ", ".join(column.title for column in numbered.values())
        raise DatasetError(
            f"{table.path}: line 1 must be '{HEADER}' (wrist pitch, wrist yaw, half the jaws' opening), or have the "
            f"arm's joints q1 to q6 and 'jaw'; it has {titles}"
        )
    found: dict[str, Column] = {}
    for name, column in named:
        if name in found:
            raise _twice(table, found[name], column)
        found[name] = column
    if HALF_JAW in found and JAW in found:
        raise _twice(table, found[HALF_JAW], found[JAW])
    return found


def says_half(column: Column) -> bool:
    """Whether the column's own name says that it is half an opening: ``half_jaw``, where ``q3`` is anybody's."""
    return _name(column.name) == HALF_JAW


def _number(name: str) -> int | None:
    match = _NUMBERED.fullmatch(_bare(name))
    return None if match is None else int(match[1])


def _name(name: str) -> str | None:
    return _NAMES.get(_bare(name))


def _bare(name: str) -> str:
    return _BEHIND.sub("", _BEFORE.sub("", name))


def _twice(table: FrameTable, first: Column, second: Column) -> DatasetError:
    return DatasetError(
        f"{table.path}: '{first.title}' and '{second.title}' are the same joint; leave one of the columns away"
    )
