"""``tips.csv``: hand-marked tips of a recording, pixels or fractions of the picture."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from surgbench.camera import Camera
from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray
from surgbench.recordings.arm_columns import THE_ONLY_ONE, Whose, of_arm
from surgbench.recordings.frame_table import Column, FrameTable, read_frame_table

TipsUnit = Literal["px", "fraction"]

HEADER = "frame,u1,v1,u2,v2"
# "u1", "x1", "tip1_x", "tip_1_u", "x_1": which tip, and which coordinate.
_NAME = re.compile(r"(?:tip_?)?(?:(?P<axis>[uvxy])_?(?P<tip>[12])|(?P<tip_>[12])_?(?P<axis_>[uvxy]))")
_AXES = {"u": 0, "x": 0, "v": 1, "y": 1}
# What annotation programs write for a point that is not visible.
NOT_SEEN = (0.0, -1.0)


@dataclass(frozen=True)
class Tips:
    """Marked tips.

    Attributes:
        points: ``(frames, 2, 2)`` pixels (u, v) of the recording's pictures; NaN where a tip was not marked. ``None``
            where none was in any frame.
        note: One line that says how the file was read.
    """

    points: FloatArray | None
    note: str


def read_tips(
    path: Path,
    numbers: Sequence[int],
    camera: Camera,
    unit: TipsUnit | None = None,
    *,
    whose: Whose = THE_ONLY_ONE,
    maskless: Collection[int] = (),
) -> Tips | None:
    """Read and doubt a recording's tips.

    A tip at (0, 0) or (-1, -1) is one that was not seen. A file in which every tip lies within (1, 1) is in fractions
    of the picture, which has to be told.

    Args:
        path: Columns ``frame,u1,v1,u2,v2`` (or x1, y1, x2, y2), in any order.
        numbers: The recording's frames.
        camera: Gives the picture's size.
        unit: What the numbers are; pixels unless told, if they can be. A fraction counts from the picture's edge, so
            that 0 is half a pixel before the first one's centre.
        whose: Arm whose columns or rows are meant, where the file has those of two
            (:mod:`surgbench.recordings.arm_columns`).
        maskless: Frames without a mask, whose rows are left out.

    Returns:
        ``None`` if there is no such file.

    Raises:
        DatasetError: Something in the file is wrong or cannot be pixels; one line.
    """
    table = read_frame_table(path, HEADER)
    if table is None:
        return None
    table = of_arm(table, whose)
    points = table.values(_columns(table), numbers, complete=False, maskless=maskless).reshape(-1, 2, 2)
    points[np.isnan(points).any(axis=2)] = np.nan
    unseen = np.any([(points == value).all(axis=2) for value in NOT_SEEN], axis=0)
    points[unseen] = np.nan
    title = whose.title(path.name)
    marked = points[~np.isnan(points[..., 0])]
    if not len(marked):
        return Tips(None, f"{title}: left out, no tip was seen in any frame")
    within_one = bool(((marked >= 0) & (marked <= 1)).all())
    if unit is None and within_one:
        raise DatasetError(
            f"{path}: all {len(marked)} tips lie within one pixel of the picture's corner; if they are fractions of "
            "its width and height: --tips-unit fraction, else --tips-unit px"
        )
    if unit == "fraction":
        if not within_one:
            frame, value = _first(points, numbers, (points < 0) | (points > 1))
            raise DatasetError(
                f"{path}: frame {frame}: {value:g} is no fraction of the picture; leave --tips-unit fraction away if "
                "the tips are in pixels"
            )
        points = points * [camera.width, camera.height] - 0.5
    outside = ~camera.contains(points) & ~np.isnan(points[..., 0])
    if outside.any():
        frame = numbers[int(np.argmax(outside.any(axis=1)))]
        size = f"{camera.width}x{camera.height}"
        raise DatasetError(f"{path}: frame {frame}: a tip lies outside the image of {size} pixels")
    how = "fractions of the picture" if unit == "fraction" else "pixels"
    left_out = f", {int(unseen.sum())} at (0, 0) or (-1, -1) not seen" if unseen.any() else ""
    frames = int((~np.isnan(points[..., 0])).any(axis=1).sum())
    return Tips(points, f"{title}: {len(marked)} tips in {frames} frames, {how}{left_out}")


def _columns(table: FrameTable) -> list[Column]:
    """u1, v1, u2, v2."""
    found: dict[int, Column] = {}
    for column in table.columns:
        named = _NAME.fullmatch(column.name)
        if named is None:
            continue
        tip, axis = named["tip"] or named["tip_"], named["axis"] or named["axis_"]
        place = 2 * (int(tip) - 1) + _AXES[axis]
        if place in found:
            raise DatasetError(f"{table.path}: '{found[place].title}' and '{column.title}' are the same column")
        found[place] = column
    if len(found) < 4:
        raise DatasetError(f"{table.path}: line 1 must be '{HEADER}': two columns for each of two tips")
    return [found[place] for place in range(4)]


def _first(points: FloatArray, numbers: Sequence[int], bad: np.ndarray) -> tuple[int, float]:
    """Frame and value of the first bad coordinate."""
    index = tuple(np.argwhere(bad)[0])
    return numbers[int(index[0])], float(points[index])
