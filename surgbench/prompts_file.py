"""Prompts files: points on sequences' first pictures, given by hand.

A table ``sequence,view,arm,u,v,inside``, or a JSON list of objects with the same names.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from surgbench.camera import Camera
from surgbench.errors import ConfigError, unknown_name
from surgbench.mask_sources import Prompts
from surgbench.recordings.frame_table import DELIMITERS
from surgbench.syntax import parse_json

HEADER = "sequence,arm,u,v,inside"
_KEYS = ("sequence", "view", "arm", "u", "v", "inside")
_YES_OR_NO = {"1": True, "0": False, "true": True, "false": False, "": True}
# The name of a sequence's own view, beside those of its auxiliary ones.
OWN_VIEW = ""


@dataclass(frozen=True)
class Pictures:
    """What a prompts file may speak of in one sequence.

    Attributes:
        cameras: Of each view, by its name; that of the sequence's own camera is ``OWN_VIEW``.
        arms: The names of the arms, left before right.
    """

    cameras: Mapping[str, Camera]
    arms: tuple[str, ...]


@dataclass(frozen=True)
class _Row:
    """A point of a file.

    Attributes:
        title: The file and the place in it, for messages.
        values: As they stand there, by the names of the columns; ``None`` or missing where nothing does.
    """

    title: str
    values: dict[str, Any]

    def text(self, key: str) -> str:
        value = self.values.get(key)
        return "" if value is None else str(value).strip()

    def refuse(self, why: str) -> NoReturn:
        raise ConfigError(f"{self.title}: {why}")


def read_prompts(path: Path, sequences: Mapping[str, Pictures]) -> dict[str, dict[str, Prompts]]:
    r"""Read a prompts file.

    Its columns, in any order: ``sequence``, which may be left out where there is but one; ``view``, an auxiliary view's
    name, empty or left out for the sequence's own camera; ``arm``, likewise; ``u`` and
    ``v`` in pixels, both left empty where the arm is not in the picture; ``inside``, 1 on the arm (as where nothing is
    said) and 0 beside it.

    Args:
        path: ``.json``: a list of objects; any other: a table with commas, semicolons or tabs, and its header.
        sequences: What is known of each sequence, by its name.

    Returns:
        By sequence and view what was said; sequences and views of which the file says nothing are left out.

    Raises:
        ConfigError: It cannot be read, or a row is wrong; one line with the file and the row.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from surgbench.camera import Camera
        >>> from surgbench.prompts import Pictures, read_prompts
        >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "prompts.csv"
        ...     _ = path.write_text("arm,u,v,inside\nleft,40,50,1\nright,110,50,1\nright,80,20,0\n")
        ...     found = read_prompts(path, {"first": Pictures({"": camera}, ("left", "right"))})
        >>> found["first"][""].inside
        (array([ True]), array([ True, False]))
    """
    if not sequences:
        raise ValueError("a prompts file is of one sequence at least")
    points: dict[tuple[str, str], dict[str, list[tuple[float, float, bool]]]] = {}
    for row in _json_rows(path) if path.suffix.lower() == ".json" else _table_rows(path):
        sequence = _name(row, "sequence", sequences)
        pictures = sequences[sequence]
        view = _view(row, pictures)
        arm = _name(row, "arm", pictures.arms)
        of_arm = points.setdefault((sequence, view), {}).setdefault(arm, [])
        point = _point(row, pictures.cameras[view])
        if point is not None:
            of_arm.append(point)
    if not points:
        raise ConfigError(f"{path}: holds no point; expected '{HEADER}' and a row for each")
    found: dict[str, dict[str, Prompts]] = {}
    for (sequence, view), of_arms in points.items():
        title = f"{path}: sequence '{sequence}'" + (f", view '{view}'" if view else "")
        found.setdefault(sequence, {})[view] = _prompts(of_arms, sequences[sequence].arms, title)
    return found


def _prompts(of_arms: Mapping[str, list[tuple[float, float, bool]]], arms: tuple[str, ...], title: str) -> Prompts:
    """The points of one picture.

    Raises:
        ConfigError: An arm has none inside, and it is not said that it is not in the picture.
    """
    for arm in arms:
        rows = of_arms.get(arm)
        if rows is None or (rows and not any(inside for *_, inside in rows)):
            raise ConfigError(
                f"{title}: the {arm} arm has no point inside; if it is out of the picture: a row with empty u and v"
            )
    if not any(of_arms[arm] for arm in arms):
        raise ConfigError(f"{title}: has no point on any arm")
    points = tuple(np.array([row[:2] for row in of_arms[arm]], dtype=np.float64).reshape(-1, 2) for arm in arms)
    return Prompts(points, tuple(np.array([row[2] for row in of_arms[arm]], dtype=bool) for arm in arms))


def _name(row: _Row, key: str, valid: Mapping[str, Any] | tuple[str, ...]) -> str:
    """What a row says under a key; where there is one valid name, it may be left out."""
    name = row.text(key)
    if not name and len(valid) == 1:
        return next(iter(valid))
    if not name:
        row.refuse(f"'{key}' is missing (valid: {', '.join(sorted(valid))})")
    if name not in valid:
        row.refuse(unknown_name(key, name, valid))
    return name


def _view(row: _Row, pictures: Pictures) -> str:
    view = row.text("view")
    if view not in pictures.cameras:
        names = [name for name in pictures.cameras if name != OWN_VIEW]
        row.refuse(unknown_name("view", view, names) + "; leave it empty for the sequence's own camera")
    return view


def _point(row: _Row, camera: Camera) -> tuple[float, float, bool] | None:
    """Pixels, and whether they are on the arm; ``None`` where both coordinates are left empty."""
    if not row.text("u") and not row.text("v"):
        return None
    u, v = (_number(row, key) for key in ("u", "v"))
    if not camera.contains(np.array([u, v])):
        row.refuse(f"({u:g}, {v:g}) lies outside the picture of {camera.width}x{camera.height} pixels")
    inside = _YES_OR_NO.get(row.text("inside").lower())
    if inside is None:
        row.refuse(f"'inside' must be 1 or 0, not '{row.text('inside')}'")
    return u, v, inside


def _number(row: _Row, key: str) -> float:
    value, text = row.values.get(key), row.text(key)
    try:
        number = math.nan if isinstance(value, bool | list | dict) else float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        row.refuse(f"'{key}' must be a finite number, not '{text}'")
    return number


def _json_rows(path: Path) -> Iterator[_Row]:
    try:
        content = parse_json(_text(path))
    except ValueError as error:
        raise ConfigError(f"{path}: not valid JSON ({error})") from None
    if not isinstance(content, list):
        raise ConfigError(f"{path}: must be a list of objects like {{'arm': 'left', 'u': 320, 'v': 240, 'inside': 1}}")
    for number, values in enumerate(content, start=1):
        title = f"{path}: entry {number}"
        if not isinstance(values, dict):
            raise ConfigError(f"{title}: must be an object, not {values!r}")
        yield _Row(title, _checked(values, title))


def _table_rows(path: Path) -> Iterator[_Row]:
    lines = _text(path).splitlines()
    first = next((place for place, line in enumerate(lines) if line.strip()), None)
    if first is None:
        raise ConfigError(f"{path}: line 1 must be '{HEADER}'; the file is empty")
    delimiter = max(DELIMITERS, key=lines[first].count)
    header = [cell.strip().lower() for cell in next(csv.reader([lines[first]], delimiter=delimiter))]
    title = f"{path}: line {first + 1}"
    _checked(dict.fromkeys(header), title)
    if len(set(header)) < len(header) or not {"u", "v"} <= set(header):
        raise ConfigError(f"{title} must be '{HEADER}', each once, u and v at least")
    for line, text in enumerate(lines[first + 1 :], start=first + 2):
        cells = next(csv.reader([text], delimiter=delimiter), [])
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            raise ConfigError(
                f"{path}: line {line} has {len(cells)} values; expected {len(header)} ({','.join(header)})"
            )
        yield _Row(f"{path}: line {line}", dict(zip(header, cells, strict=True)))


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ConfigError(f"{path}: prompts cannot be read ({(error.strerror or str(error)).lower()})") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: prompts cannot be read as text ({error})") from None


def _checked(values: dict[str, Any], title: str) -> dict[str, Any]:
    """The same, if every name in it is a column's."""
    for key in values:
        if key not in _KEYS:
            raise ConfigError(f"{title}: {unknown_name('column', key, _KEYS)}")
    return values
