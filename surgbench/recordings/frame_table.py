"""Tables with a row per frame as people write them: commas or semicolons, blanks, any case, further columns."""

from __future__ import annotations

import codecs
import csv
import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray
from surgbench.recordings.names import number_of

FRAME_NAMES = ("frame", "frame_id", "frame_index", "frame_number")
DELIMITERS = (",", ";", "\t")
# What a column's name may say of its unit at its end: "jaw_deg", "jaw [deg]", "jaw (degrees)".
UNITS = {
    "rad": "rad", "radian": "rad", "radians": "rad", "deg": "deg", "degree": "deg", "degrees": "deg",
    "m": "m", "mm": "mm", "px": "px", "pixel": "px", "pixels": "px",
}  # fmt: skip


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        name: Lower case, words joined by ``_``, without its unit.
        unit: As its name says; ``None`` where it says none.
        place: Which of a row's cells.
        title: As it stands in the file.
    """

    name: str
    unit: str | None
    place: int
    title: str


@dataclass(frozen=True)
class FrameTable:
    """A table that has been read, cells as text.

    Attributes:
        path: The file.
        columns: But for that of the frame.
        rows: Line number, frame and all cells of each row, in order.
        decimal_comma: Numbers may have one.
        example: What the first line may be, for messages.
    """

    path: Path
    columns: tuple[Column, ...]
    rows: tuple[tuple[int, int, list[str]], ...]
    decimal_comma: bool
    example: str

    def values(
        self, columns: Sequence[Column], numbers: Sequence[int], *, complete: bool, maskless: Collection[int] = ()
    ) -> FloatArray:
        """Some columns of the recording's frames.

        Args:
            columns: Of this table.
            numbers: The recording's frames, in order. Rows of frames between them, which have no mask, are left out.
            complete: Every frame must have a row, of numbers or without any, which become NaN; otherwise missing rows
                and empty cells become NaN.
            maskless: Further frames without a mask, whose rows are left out.

        Returns:
            ``(len(numbers), len(columns))``.

        Raises:
            DatasetError: A value is no number, or a frame is missing, there twice, or not between the first mask and
                the last.
        """
        places = {number: index for index, number in enumerate(numbers)}
        values = np.full((len(numbers), len(columns)), np.nan)
        seen: set[int] = set()
        for line, number, cells in self.rows:
            if number not in places and not numbers[0] < number < numbers[-1] and number not in maskless:
                raise DatasetError(f"{self.path}: line {line}: there is no mask of frame {number}")
            if number in seen:
                raise DatasetError(f"{self.path}: line {line}: frame {number} is there twice")
            seen.add(number)
            if complete and all(self._is_empty(cells[column.place]) for column in columns):
                continue
            for index, column in enumerate(columns):
                cell = cells[column.place].strip()
                if not cell and not complete:
                    continue
                value = self._number(cell)
                if value is None or math.isinf(value) or (math.isnan(value) and complete):
                    raise DatasetError(
                        f"{self.path}: line {line}: '{column.title}' must be a finite number, not '{cell}'"
                    )
                if number in places:
                    values[places[number], index] = value
        hole = next((number for number in numbers if number not in seen), None)
        if complete and hole is not None:
            raise DatasetError(
                f"{self.path}: frame {hole} is missing; every mask needs a row, with empty cells where nothing was read"
            )
        return values

    def _is_empty(self, cell: str) -> bool:
        value = self._number(cell)
        return not cell.strip() or (value is not None and math.isnan(value))

    def _number(self, cell: str) -> float | None:
        try:
            return float(cell.replace(",", ".") if self.decimal_comma else cell)
        except ValueError:
            return None


def read_frame_table(path: Path, example: str) -> FrameTable | None:
    """Read a table that has a column ``frame``; ``None`` if there is no such file.

    Args:
        path: Text, in UTF-8 or with a byte order mark. Cells stand between commas, semicolons or tabs, whichever the
            first line has most of; numbers may have decimal commas where those do not part cells.
        example: What the first line may be, for messages.

    Raises:
        DatasetError: It is no such table; one line.
    """
    text = _text(path)
    if text is None:
        return None
    lines = text.splitlines()
    first = next((place for place, line in enumerate(lines) if _says_something(line)), None)
    if first is None:
        raise DatasetError(f"{path}: line 1 must be '{example}'; the file is empty")
    delimiter = max(DELIMITERS, key=lines[first].count)
    titles = [cell.strip().removeprefix("#").strip() for cell in next(csv.reader([lines[first]], delimiter=delimiter))]
    columns = [name_column(title, place) for place, title in enumerate(titles)]
    frame = next((column for column in columns if column.name in FRAME_NAMES), None)
    if frame is None:
        raise DatasetError(f"{path}: line {first + 1} must be '{example}', it has no column 'frame'")
    rows = []
    for line, cells in enumerate(csv.reader(lines[first + 1 :], delimiter=delimiter), start=first + 2):
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(columns):
            raise DatasetError(
                f"{path}: line {line} has {len(cells)} values; expected {len(columns)} ({','.join(titles)})"
            )
        rows.append((line, _frame(cells[frame.place], path, line), cells))
    others = tuple(column for column in columns if column is not frame)
    return FrameTable(path, others, tuple(rows), decimal_comma=delimiter != ",", example=example)


def _text(path: Path) -> str | None:
    try:
        data = path.read_bytes()
        utf_16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        return data.decode("utf-16" if utf_16 else "utf-8-sig")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read as text ({error})") from None


def _says_something(line: str) -> bool:
    """Neither blank nor a spreadsheet's note of what parts its cells."""
    return bool(line.strip()) and not line.strip().lower().startswith("sep=")


def name_column(title: str, place: int) -> Column:
    """A column by its title: words joined by ``_``, and the unit that the last of them is."""
    words = [word for word in re.split(r"[^0-9a-z]+", re.sub("[°º]", " deg ", title.lower())) if word]
    unit = UNITS.get(words[-1]) if len(words) > 1 else None
    return Column("_".join(words[:-1] if unit else words), unit, place, title)


def _frame(cell: str, path: Path, line: int) -> int:
    try:
        return int(cell)
    except ValueError:
        pass
    stamp = number_of(cell.strip())
    if stamp is not None:
        return stamp
    try:
        number = float(cell)
    except ValueError:
        number = math.nan
    if not number.is_integer():
        raise DatasetError(f"{path}: line {line}: 'frame' must be a whole number, not '{cell}'")
    return int(number)
