"""Masks as COCO has them: runs of zeros and ones down the columns, as numbers or as text, and polygons.

The text is pycocotools' own: numbers in groups of five bits, least first, each after the second as the difference to
the one before the last (``rleFrString`` in its ``maskApi.c``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Polygons may leave the picture, but not by so many of its sides.
_FARTHEST = 10
_FIRST, _BITS, _MORE, _SIGN = 48, 5, 0x20, 0x10


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

    Returns:
        ``(height, width)`` bool.

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
        if np.abs(points).max() > _FARTHEST * max(height, width):
            raise ValueError(f"a polygon reaches {np.abs(points).max():g} pixels, in a picture of {width}x{height}")
        mask |= _inside(points.reshape(-1, 2), height, width)
    return mask


def _inside(points: NDArray[np.float64], height: int, width: int) -> NDArray[np.bool_]:
    """Pixels whose centre lies in a polygon, by the even-odd rule.

    OpenCV's would add all that its outline touches, half a pixel all round.
    """
    start, end = points, np.roll(points, -1, axis=0)
    centres = np.arange(height) + 0.5
    edge, row = np.nonzero((start[:, 1, None] <= centres) != (end[:, 1, None] <= centres))
    share = (centres[row] - start[edge, 1]) / (end[edge, 1] - start[edge, 1])
    across = start[edge, 0] + share * (end[edge, 0] - start[edge, 0])
    crossings = np.zeros((height, width + 1), dtype=np.int64)
    np.add.at(crossings, (row, np.clip(np.ceil(across - 0.5), 0, width).astype(np.int64)), 1)
    return np.asarray(np.cumsum(crossings, axis=1)[:, :-1] % 2 == 1)


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
