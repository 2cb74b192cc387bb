"""Tables of numbers per frame beside a recording: joint readings and marked tips."""

from __future__ import annotations

import csv
import math
from collections.abc import Collection
from pathlib import Path

import numpy as np

from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray


def read_table(
    path: Path, columns: tuple[str, ...], numbers: list[int], *, complete: bool, maskless: Collection[int] = ()
) -> FloatArray | None:
    """Read a table of numbers per frame; ``None`` if there is no such file.

    Args:
        path: The file; its header must be ``frame`` and the columns.
        columns: Besides ``frame``.
        numbers: The recording's frames.
        complete: Every frame must have a row of numbers; otherwise missing rows and empty cells become NaN.
        maskless: Frames that have an image and no mask: their rows are left out, as are those of numbers between the
            recording's first and last.

    Returns:
        ``(len(numbers), len(columns))``.

    Raises:
        DatasetError: The header is wrong, a value is no number, or a frame is missing, unknown or there twice.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read as text ({error})") from None
    rows = list(csv.reader(text.splitlines()))
    header = ["frame", *columns]
    if not rows or [cell.strip() for cell in rows[0]] != header:
        raise DatasetError(f"{path}: line 1 must be '{','.join(header)}'")
    places = {number: index for index, number in enumerate(numbers)}
    values = np.full((len(numbers), len(columns)), np.nan)
    seen: set[int] = set()
    for line, cells in enumerate(rows[1:], start=2):
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            raise DatasetError(
                f"{path}: line {line} has {len(cells)} values; expected {len(header)} ({','.join(header)})"
            )
        try:
            number = int(cells[0])
        except ValueError:
            raise DatasetError(f"{path}: line {line}: 'frame' must be a whole number, not '{cells[0]}'") from None
        if number not in places:
            if numbers[0] < number < numbers[-1] or number in maskless:
                continue
            raise DatasetError(f"{path}: line {line}: there is no mask of frame {number}")
        if number in seen:
            raise DatasetError(f"{path}: line {line}: frame {number} is there twice")
        seen.add(number)
        for column, cell in enumerate(cells[1:]):
            if not cell.strip() and not complete:
                continue
            value = _number(cell)
            if value is None or math.isinf(value) or (math.isnan(value) and complete):
                raise DatasetError(f"{path}: line {line}: '{columns[column]}' must be a finite number, not '{cell}'")
            values[places[number], column] = value
    if complete and len(seen) < len(numbers):
        hole = next(number for number in numbers if number not in seen)
        raise DatasetError(f"{path}: frame {hole} is missing; every mask needs a row")
    return values


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
