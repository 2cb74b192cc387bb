"""Tables of poses as programs write them: CSV with any names, ROS's own, TUM's eight numbers without any."""

from __future__ import annotations

import codecs
import csv
import math
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Literal

from surgbench.errors import ConfigError, DatasetError, unknown_name
from surgbench.recordings.frame_table import DELIMITERS, Column, name_column
from surgbench.recordings.poses import FIELDS, LengthUnit, RawPoses, TimeUnit

HEADER = "time_s,x_m,y_m,z_m,qx,qy,qz,qw"
TABLE_SUFFIXES = (".csv", ".txt", ".tum", ".tsv")
QuaternionOrder = Literal["xyzw", "wxyz"]
# A line of eight numbers has some hundred characters, one of a robot's whole state some thousand.
LONGEST_LINE = 100_000
REPORT_EVERY = 10_000

# The time is what the message says before what the recorder does.
_TIMES = (
    r"(?:.*_)?header_(?:time_?)?stamp",
    r"time_?stamp|time|stamp|t|secs?|seconds|elapsed",
    r".*_(?:time_?stamp|time|stamp)",
)
_TIME_UNIT = re.compile(r"(.+?)_(s|secs?|seconds?|ms|msecs?|millisec\w*|us|usecs?|microsec\w*|ns|nsecs?|nanosec\w*)")
_PLACES = (
    r"(?:p|t|pos|position|trans|translation|tip|tool|ring|feature)?_?{}",
    r".*_(?:pos|position|trans|translation)_{}",
)
_TURNS = (
    r"(?:q|o|quat|quaternion|orientation|rot|rotation)_?{}",
    r".*_(?:q|quat|quaternion|orientation|rot|rotation)_{}",
)


def read_pose_table(
    path: Path,
    *,
    columns: Mapping[str, str] | None = None,
    order: QuaternionOrder = "xyzw",
    progress: Callable[[float], None] = lambda rows: None,
) -> RawPoses:
    """Read a table with a time, a position and a quaternion in every row, one row at a time.

    Args:
        path: Text, in UTF-8 or with a byte order mark. Cells stand between commas, semicolons, tabs or blanks. The
            first line has the columns' names; without, there are eight: time, position, quaternion (as TUM's).
        columns: Of ``FIELDS``, to the names of their columns; found by themselves unless told.
        order: Of the quaternion where there are no names.
        progress: Takes the number of rows just read.

    Raises:
        DatasetError: It is no such table; one line that names the line.
        ConfigError: A column that was told is not there.
    """
    raw = RawPoses(str(path), "line")
    try:
        with path.open("rb") as file:
            utf_16 = file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        with path.open(encoding="utf-16" if utf_16 else "utf-8-sig", newline="") as text:
            _read(path, text, raw, columns or {}, order, progress)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    except (UnicodeError, csv.Error) as error:
        raise DatasetError(f"{path}: cannot be read as text ({error})") from None
    return raw


def count_rows(path: Path) -> int:
    """How many rows a table has, about: lines that end, but for one of names.

    Raises:
        DatasetError: It cannot be read; one line.
    """
    try:
        with path.open("rb") as file:
            names = any(
                letter.isalpha() for letter in file.readline().decode(errors="replace").lower().replace("e", "")
            )
            return sum(block.count(b"\n") for block in iter(lambda: file.read(1 << 20), b"")) + (not names)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None


def _read(
    path: Path,
    text: IO[str],
    raw: RawPoses,
    told: Mapping[str, str],
    order: QuaternionOrder,
    progress: Callable[[float], None],
) -> None:
    lines = _numbered(path, text)
    places: dict[str, int] | None = None
    delimiter, width = ",", 0
    for line, content in lines:
        if not content.strip() or content.strip().lower().startswith("sep="):
            continue
        if places is None:
            comment = content.lstrip().startswith(("#", "%"))
            head = content.lstrip("#% \t") if comment else content
            delimiter = _delimiter(head)
            cells = _cells(head, delimiter)
            if all(_number(cell, delimiter) is not None for cell in cells):
                if comment:
                    continue
                places, width = _without_names(path, line, cells, order, told, raw), len(cells)
            else:
                titles = [name_column(cell.strip(), place) for place, cell in enumerate(cells)]
                if comment and not _is_header(titles, told):
                    continue
                places, width = _by_names(path, titles, told, raw), len(cells)
                continue
        elif content.lstrip().startswith("#"):
            continue
        cells = _cells(content, delimiter)
        if len(cells) != width:
            raise DatasetError(f"{path}: line {line} has {len(cells)} values; expected {width}")
        values = []
        for name in FIELDS:
            cell = cells[places[name]].strip()
            value = _number(cell, delimiter) if cell else math.nan
            if value is None:
                raise DatasetError(f"{path}: line {line}: '{name}' must be a number, not '{cell[:40]}'")
            values.append(value)
        raw.append(line, values)
        if len(raw.numbers) % REPORT_EVERY == 0:
            progress(REPORT_EVERY)
    progress(len(raw.numbers) % REPORT_EVERY)
    if places is None:
        raise DatasetError(f"{path}: line 1 must be '{HEADER}'; the file is empty")


def _numbered(path: Path, text: IO[str]) -> Iterator[tuple[int, str]]:
    """Lines with their numbers; no longer than a table's are."""
    line = 0
    while content := text.readline(LONGEST_LINE + 1):
        line += 1
        if len(content) > LONGEST_LINE:
            raise DatasetError(f"{path}: line {line} is longer than {LONGEST_LINE:,} characters; is it a table?")
        if "\0" in content:
            raise DatasetError(f"{path}: line {line} holds zero bytes; is it a table?")
        yield line, content


def _delimiter(head: str) -> str:
    found = max(DELIMITERS, key=head.count)
    return found if head.count(found) else " "


def _cells(content: str, delimiter: str) -> list[str]:
    return content.split() if delimiter == " " else next(csv.reader([content.rstrip("\r\n")], delimiter=delimiter))


def _number(cell: str, delimiter: str) -> float | None:
    try:
        return float(cell if delimiter == "," else cell.replace(",", "."))
    except ValueError:
        return None


def _without_names(
    path: Path, line: int, cells: list[str], order: QuaternionOrder, told: Mapping[str, str], raw: RawPoses
) -> dict[str, int]:
    if len(cells) != len(FIELDS) or told:
        raise DatasetError(
            f"{path}: line {line} must be '{HEADER}', or the file has eight numbers in each line without names; "
            f"it has {len(cells)}"
        )
    names = FIELDS if order == "xyzw" else (*FIELDS[:4], "qw", "qx", "qy", "qz")
    other = "wxyz" if order == "xyzw" else "xyzw"
    raw.lines.append(f"no names of columns: taken as {' '.join(names)} (--quaternion {other} if the quaternion is so)")
    return {name: place for place, name in enumerate(names)}


def _is_header(titles: list[Column], told: Mapping[str, str]) -> bool:
    """Whether a comment's words are the names of columns."""
    by_title = {column.title for column in titles}
    return all((name in told and told[name] in by_title) or _matching(titles, name) for name in FIELDS)


def _by_names(path: Path, titles: list[Column], told: Mapping[str, str], raw: RawPoses) -> dict[str, int]:
    found: dict[str, Column] = {}
    for name in FIELDS:
        if name in told:
            named = [column for column in titles if column.title == told[name]]
            if not named:
                raise ConfigError(
                    f"--columns: {unknown_name('column', told[name], [column.title for column in titles])}"
                )
        else:
            named = _matching(titles, name)
        if len(named) != 1:
            what = " and ".join(f"'{column.title}'" for column in named[:3]) or "no column"
            others = ", ".join(column.title for column in titles[:20])
            raise DatasetError(
                f"{path}: has {what} for '{name}' ({others}); --columns {name}=NAME says which, or line 1 is '{HEADER}'"
            )
        found[name] = named[0]
    raw.unit = _unit(path, [found[name] for name in FIELDS[1:4]])
    raw.time_unit = _time_unit(found["time"].name)
    return {name: column.place for name, column in found.items()}


def _matching(titles: list[Column], name: str) -> list[Column]:
    """Columns that may be a field, by the surest of the patterns that one matches."""
    if name == "time":
        named = [(column, _TIME_UNIT.fullmatch(column.name)) for column in titles]
        words = [(column, column.name if match is None else match[1]) for column, match in named]
        patterns: tuple[str, ...] = _TIMES
    else:
        words = [(column, column.name) for column in titles]
        patterns = tuple(pattern.format(name[-1]) for pattern in (_TURNS if name.startswith("q") else _PLACES))
    for pattern in patterns:
        fitting = [column for column, word in words if re.fullmatch(pattern, word)]
        if fitting:
            return fitting
    return []


def _unit(path: Path, columns: list[Column]) -> LengthUnit | None:
    units = {column.unit for column in columns}
    if len(units) > 1 or not units <= {"m", "mm", None}:
        raise DatasetError(f"{path}: {', '.join(column.title for column in columns)} must be in one unit, m or mm")
    unit = units.pop()
    return "mm" if unit == "mm" else ("m" if unit == "m" else None)


def _time_unit(name: str) -> TimeUnit | None:
    match = _TIME_UNIT.fullmatch(name)
    if match is None:
        return None
    first = match[2][:2]
    units: dict[str, TimeUnit] = {"ms": "ms", "mi": "ms", "us": "us", "ns": "ns", "na": "ns"}
    return "us" if match[2].startswith("micro") else units.get(first, "s")
