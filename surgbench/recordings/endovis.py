"""Points that people marked in EndoVis' robotic sequences: a JSON list of pictures with what is in each."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray
from surgbench.recordings.json_file import read_json

_EXPECTED = "a list of pictures, each with 'filename' and 'annotations' ('class', 'id', 'x', 'y')"


@dataclass
class MarkedPoints:
    """What a file of labels holds.

    Attributes:
        path: The file.
        names: Of the pictures, as in the file.
        labels: Class to tool to ``(pictures, 2)`` pixels, NaN where it is not marked.
        tools: Their ids, sorted.
        notes: What had to be decided, one line each; warnings begin with ``warning:``.
    """

    path: Path
    names: list[str]
    labels: dict[str, dict[str, FloatArray]]
    tools: list[str]
    notes: list[str] = field(default_factory=list)

    @property
    def marked(self) -> int:
        """How many pictures have any point."""
        points = [own for by_tool in self.labels.values() for own in by_tool.values()]
        return int((~np.isnan(np.stack(points)).any(axis=2)).any(axis=0).sum()) if points else 0


def read_points(path: Path) -> MarkedPoints:
    """Read a file of labels.

    A point without an id is that of the only tool that lacks it in that picture. One that is there twice, in two
    places, is left out.

    Raises:
        DatasetError: It is something else; one line.
    """
    content = read_json(path)
    try:
        names = [str(one["filename"]) for one in content]
        pictures = [[_point(path, one["filename"], point) for point in one["annotations"]] for one in content]
    except (KeyError, TypeError, AttributeError):
        raise DatasetError(f"{path}: must be {_EXPECTED}") from None
    if not names:
        raise DatasetError(f"{path}: holds no pictures; must be {_EXPECTED}")
    if len(set(names)) < len(names):
        raise DatasetError(f"{path}: '{Counter(names).most_common(1)[0][0]}' is there twice")
    tools = sorted({tool for picture in pictures for tool, _, _ in picture if tool})
    labels = {label: {tool: np.full((len(names), 2), np.nan) for tool in tools} for label in _labels(pictures)}
    found = MarkedPoints(path, names, labels, tools)
    given = Counter[str]()
    for place, picture in enumerate(pictures):
        _place_points(found, place, picture, given)
    for what, count in given.items():
        found.notes.append(f"{count} points {what}")
    return found


def label_name(text: str) -> str:
    """A class's name as columns have it.

    Example:
        >>> from surgbench.recordings.endovis import label_name
        >>> label_name("LeftClasperPoint")
        'left_clasper'
    """
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", text)
    plain = re.sub(r"[^a-z0-9]+", "_", words.lower()).strip("_")
    return plain.removesuffix("_point") or "point"


Point = tuple[str, str, tuple[float, float]]


def _point(path: Path, name: str, point: dict[str, Any]) -> Point:
    place = (point["x"], point["y"])
    if not all(isinstance(value, int | float) and np.isfinite(value) for value in place):
        raise DatasetError(f"{path}: '{name}': x and y must be numbers, not {place[0]!r} and {place[1]!r}")
    tool = point.get("id")
    return "" if tool is None else str(tool), label_name(str(point["class"])), place


def _labels(pictures: list[list[Point]]) -> list[str]:
    return list(dict.fromkeys(label for picture in pictures for _, label, _ in picture))


def _place_points(found: MarkedPoints, place: int, picture: list[Point], given: Counter[str]) -> None:
    """Put the points of one picture where they belong."""
    seen: dict[tuple[str, str], set[tuple[float, float]]] = {}
    for tool, label, point in picture:
        seen.setdefault((tool, label), set()).add(point)
    for (tool, label), points in list(seen.items()):
        if tool:
            continue
        lacking = [other for other in found.tools if (other, label) not in seen]
        there = [other for other in lacking if any(key[0] == other for key in seen)]
        if len(points) == 1 and len(there) == 1:
            seen[there[0], label] = points
            given["have no id, and are those of the only tool that lacks one there"] += 1
        else:
            given["have no id that could be told, and are left out"] += len(points)
    for (tool, label), points in seen.items():
        if not tool:
            continue
        if len(points) > 1:
            found.notes.append(
                f"warning: {found.path.name}: '{found.names[place]}' has {len(points)} points '{label}' of {tool}; "
                "none of them is taken"
            )
            continue
        found.labels[label][tool][place] = next(iter(points))
