"""Masks as COCO has them: runs of zeros and ones down the columns, as numbers or as text, and polygons.

The text is pycocotools' own: numbers in groups of five bits, least first, each after the second as the difference to
the one before the last (``rleFrString`` in its ``maskApi.c``). Its polygons too are followed, for borders count.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_FIRST, _BITS, _MORE, _SIGN = 48, 5, 0x20, 0x10
# Into how many parts pycocotools divides a pixel's side.
_FINER = 5
# Polygons may leave the picture, but not by so many of its sides, or by more than this: then they are another's.
_FARTHEST_SIDES, _FARTHEST_PX = 10, 1000


def decode_counts(text: str) -> list[int]:
    """Lengths of runs from their text.

    Raises:
        ValueError: It is cut off, or holds a character that it cannot.
    """
    counts: list[int] = []
    value = shift = 0
    for character in text:
        group = ord(character) - _FIRST
        if not 0 <= group < 2 * _MORE:
            raise ValueError(f"'{character}' cannot be in an RLE")
        value |= (group & (_MORE - 1)) << shift
        shift += _BITS
        if group & _MORE:
            continue
        if group & _SIGN:
            value -= 1 << shift
        counts.append(value + counts[-2] if len(counts) > 2 else value)
        value = shift = 0
    if shift:
        raise ValueError("an RLE is cut off")
    return counts


def decode_rle(counts: str | Sequence[int], height: int, width: int) -> NDArray[np.bool_]:
    """A mask from its runs.

    Args:
        counts: Lengths of runs, the first of zeros, down the columns; or their text.
        height: Of the mask, pixels.
        width: Likewise.

    Returns:
        ``(height, width)`` bool.

    Raises:
        ValueError: The runs do not make as many pixels.

    Example:
        >>> from surgbench.recordings.rle import decode_rle
        >>> decode_rle([1, 2, 1], 2, 2).astype(int)
        array([[0, 1],
               [1, 0]])
    """
    try:
        lengths = np.array(decode_counts(counts) if isinstance(counts, str) else counts, dtype=np.int64).reshape(-1)
    except (TypeError, OverflowError):
        raise ValueError("an RLE's 'counts' must be whole numbers") from None
    # Each by itself, too: the sum of a few could wrap round.
    if (lengths < 0).any() or (lengths > height * width).any() or lengths.sum() != height * width:
        raise ValueError(f"an RLE has {int(lengths.sum())} pixels, not {width}x{height}")
    flat = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
    return np.ascontiguousarray(flat.reshape(width, height).T)


def draw_polygons(polygons: Sequence[Sequence[float]], height: int, width: int) -> NDArray[np.bool_]:
    """A mask from polygons ``[x1, y1, x2, y2, ...]``, in which a pixel's corner is at its coordinates.

    Pixels at the border are in or out as pycocotools has it (``rleFrPoly``), so that masks are those that others count.

    Returns:
        ``(height, width)`` bool, the union of all.

    Raises:
        ValueError: One has not at least three points, or is of another picture.
    """
    mask = np.zeros((height, width), dtype=bool)
    for polygon in polygons:
        try:
            points = np.array(polygon, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError("a polygon must be numbers") from None
        if points.ndim != 1 or len(points) < 6 or len(points) % 2 or not np.isfinite(points).all():
            raise ValueError("a polygon has less than three points")
        if np.abs(points).max() > max(_FARTHEST_SIDES * max(height, width), _FARTHEST_PX):
            raise ValueError(f"a polygon reaches {np.abs(points).max():g}, far outside of {width}x{height} pixels")
        mask |= _inside(points.reshape(-1, 2), height, width)
    return mask


def _inside(points: NDArray[np.float64], height: int, width: int) -> NDArray[np.bool_]:
    """Pixels in a polygon: its outline is followed in fifths of pixels, and turns a column over where it crosses it.

    OpenCV's would add all that the outline touches, half a pixel all round; those whose centres lie inside are others
    again.
    """
    start = np.trunc(_FINER * points + 0.5).astype(np.int64)  # towards 0, as C does
    end = np.roll(start, -1, axis=0)
    step = np.abs(end - start)
    length, flat = step.max(axis=1), step[:, 0] >= step[:, 1]
    edge = np.repeat(np.arange(len(start)), length + 1)
    along = np.arange(len(edge)) - np.repeat(np.cumsum(length + 1) - (length + 1), length + 1)
    # Each edge is walked to the right, or down where it is steep, whichever way the outline goes.
    turned = np.where(flat, start[:, 0] > end[:, 0], start[:, 1] > end[:, 1])
    first = np.where(turned[:, None], end, start)
    change = np.where(turned[:, None], start, end) - first
    slope = np.where(flat, change[:, 1], change[:, 0]) / np.maximum(length, 1)
    along = np.where(turned[edge], length[edge] - along, along)
    across = np.trunc(np.where(flat, first[:, 1], first[:, 0])[edge] + slope[edge] * along + 0.5).astype(np.int64)
    u = np.where(flat[edge], along + first[edge, 0], across)
    v = np.where(flat[edge], across, along + first[edge, 1])
    # A column's centre lies between the third and the fourth fifth that it has.
    crossed = np.minimum(u[1:], u[:-1]) - _FINER // 2
    column, row = crossed // _FINER, (np.minimum(v[1:], v[:-1]) + _FINER // 2) // _FINER
    taken = (u[1:] != u[:-1]) & (crossed % _FINER == 0) & (column >= 0) & (column < width)
    turns = np.bincount(column[taken] * height + np.clip(row[taken], 0, height), minlength=height * width + 1)
    return np.asarray((np.cumsum(turns[:-1]) % 2 == 1).reshape(width, height).T)


def decode_segmentation(segmentation: Any, height: int, width: int) -> NDArray[np.bool_]:
    """A mask from what COCO calls a segmentation: polygons, or a mapping with ``counts`` and perhaps ``size``.

    Raises:
        ValueError: It is something else, or of another size; one line.
    """
    if isinstance(segmentation, list):
        return draw_polygons(segmentation, height, width)
    if not isinstance(segmentation, dict) or not isinstance(segmentation.get("counts"), str | list):
        raise ValueError("'segmentation' must be polygons, or a mapping with 'counts' and 'size'")
    size = segmentation.get("size", [height, width])
    if not isinstance(size, list | tuple) or list(size) != [height, width]:
        raise ValueError(f"an RLE has the size {size} ([height, width]), not [{height}, {width}]")
    return decode_rle(segmentation["counts"], height, width)
