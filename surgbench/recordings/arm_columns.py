"""Tables of two arms: whose a column is (``left_q1``, ``PSM1_yaw``, ``q1_right``), or a row (by a column ``arm``)."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

from surgbench.errors import ConfigError, DatasetError
from surgbench.recordings.frame_table import Column, FrameTable

OPTION = "--arm-names"
ARMS = ("left", "right")
# A column of these says whose a row is.
_OF_ROWS = ("arm", "psm", "side")
_ARM = r"left|right|(?:psm|arm)_?\d+"
_PREFIX, _SUFFIX = re.compile(rf"(?P<arm>{_ARM})_(?P<rest>.+)"), re.compile(rf"(?P<rest>.+)_(?P<arm>{_ARM})")


@dataclass(frozen=True)
class Whose:
    """Whose columns or rows are meant.

    Attributes:
        arm: ``left`` or ``right``; empty where nobody knows.
        several: The recording shows two arms, and so must the table.
        names: What the table calls the arms beside ``left`` and ``right``, from :func:`parse_arm_names`.
    """

    arm: str = ""
    several: bool = False
    names: Mapping[str, str] = field(default_factory=dict)

    def title(self, name: str) -> str:
        """What a table of that name is called in messages."""
        return f"{name}, {self.arm} arm" if self.several else name


THE_ONLY_ONE = Whose()


def parse_arm_names(text: str | None) -> dict[str, str]:
    """What tables call the arms, as in ``PSM1=right,PSM3=left``: lower case to ``left`` or ``right``.

    Raises:
        ConfigError: It is something else, or two names are of one arm; one line with an example.

    Example:
        >>> from surgbench.recordings.arm_columns import parse_arm_names
        >>> parse_arm_names("PSM1=right,PSM3=left")
        {'psm1': 'right', 'psm3': 'left'}
    """
    names: dict[str, str] = {}
    for part in () if text is None else text.split(","):
        name, equals, arm = (word.strip() for word in part.partition("="))
        if not equals or not name or arm not in ARMS or arm in names.values() or name.lower() in names:
            raise ConfigError(f"{OPTION}: must be like PSM1=right,PSM3=left, not '{text}'")
        names[name.lower()] = arm
    return names


def of_arm(table: FrameTable, whose: Whose) -> FrameTable:
    """The columns and rows of one arm, whose names are without it.

    Raises:
        DatasetError: They are of other arms, or it is not clear of which; one line that names the option.
    """
    by_row = next((column for column in table.columns if column.name in _OF_ROWS), None)
    parts = _arms_of_rows(table, by_row) if by_row is not None else _arms_of_columns(table)
    if not whose.several and len(parts) < 2 and not (whose.names and parts):
        if not whose.arm or by_row is not None or not _are_all_of(table, ARMS):
            return table
        (only,) = parts
        if only != whose.arm:
            raise DatasetError(
                f"{table.path}: has columns of the {only} arm, and the masks are of the {whose.arm} one; if they are "
                f"not: --arms {only}"
            )
    _, first, *_, last = table.example.split(",")
    wanted = f"those of two are left_{first}, ..., right_{last}, or have a column 'arm'"
    if not parts:
        raise DatasetError(f"{table.path}: has columns of one arm; {wanted}")
    known = {arm: arm for arm in ARMS} | dict(whose.names)
    said = " and ".join(parts.values())
    if not whose.several and not whose.names and set(parts) == set(ARMS):
        raise DatasetError(
            f"{table.path}: has columns of two arms; say --instances 1=left,2=right or --arms both, as the masks are; "
            f"of masks of one arm {OPTION} left=left"
        )
    unknown = [title for part, title in parts.items() if part not in known]
    own = [part for part in parts if known.get(part) == whose.arm]
    if not own and unknown:
        example = ",".join(f"{title}={arm}" for title, arm in zip(unknown, ARMS, strict=False))
        raise DatasetError(f"{table.path}: is of {said}; which arm is which? for example {OPTION} {example}")
    if not own:
        raise DatasetError(f"{table.path}: is of {said}, not of the {whose.arm} arm; {wanted}")
    if len(own) > 1:
        raise DatasetError(f"{table.path}: '{parts[own[0]]}' and '{parts[own[1]]}' are both the {whose.arm} arm")
    if by_row is not None:
        rows = tuple(row for row in table.rows if row[2][by_row.place].strip().lower() == own[0])
        return replace(table, rows=rows, columns=tuple(column for column in table.columns if column is not by_row))
    named = [(column, _split(column)) for column in table.columns]
    return replace(
        table, columns=tuple(replace(column, name=found[1]) for column, found in named if found and found[0] == own[0])
    )


def _are_all_of(table: FrameTable, arms: Collection[str]) -> bool:
    """Whether every column names one of these arms."""
    split = [_split(column) for column in table.columns]
    return bool(split) and all(found is not None and found[0] in arms for found in split)


def _split(column: Column) -> tuple[str, str] | None:
    """Whose a column is by its name, and its name without that."""
    match = _PREFIX.fullmatch(column.name) or _SUFFIX.fullmatch(column.name)
    return None if match is None else (match["arm"], match["rest"])


def _arms_of_columns(table: FrameTable) -> dict[str, str]:
    """Names of arms, as they are compared and as they are shown, of columns that two arms have; or of the only one."""
    found: dict[str, set[str]] = {}
    for column in table.columns:
        split = _split(column)
        if split is not None:
            found.setdefault(split[0], set()).add(split[1])
    shared = [arm for arm, rest in found.items() if any(rest & own for other, own in found.items() if other != arm)]
    titles = {arm: arm if arm in ARMS else arm.upper() for arm in found}
    return {arm: titles[arm] for arm in (shared or list(found)[:1])}


def _arms_of_rows(table: FrameTable, column: Column) -> dict[str, str]:
    """Likewise, of what stands in a column."""
    titles = [cells[column.place].strip() for _, _, cells in table.rows]
    return {title.lower(): title for title in titles}
