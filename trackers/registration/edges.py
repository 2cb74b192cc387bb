"""Where the observed mask has the edge that a predicted contour point stands for, and how much of both is explained.

A contour point of the silhouette engine lies exactly on a pixel row (steep parts) or on a pixel column (flat parts).
So the mask is searched along that row or column for the nearest pair of pixels, inside and outside in the contour's
own sense; the edge lies midway, right to a small part of a pixel on average over many points.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.compiled import compiled
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.silhouette import ContourPoints

# What a picture says of one arm at a pixel: seen, not there, or nothing to go by, for something may hide it.
NOTHING, SEEN, HIDDEN = 0, 1, 2
Codes = NDArray[np.uint8] | Mask

_compiled = compiled(makes_arrays=True)


@_compiled
def _search(mask: Any, across: bool, line: int, at: float, outward: int, reach: int) -> float:
    """Way outward from ``at`` to the nearest edge on a row, or (``across``) on a column; NaN where none is in reach."""
    size = mask.shape[0] if across else mask.shape[1]
    first = int(np.floor(at)) if outward > 0 else int(np.ceil(at))
    best = np.inf
    for step in range(reach + 1):
        for side in range(2 if step else 1):
            inside = first + step if side == 0 else first - step
            outside = inside + outward
            if min(inside, outside) < 0 or max(inside, outside) >= size:
                continue
            if across:
                edge = mask[inside, line] == SEEN and mask[outside, line] == NOTHING
            else:
                edge = mask[line, inside] == SEEN and mask[line, outside] == NOTHING
            if edge:
                offset = outward * (inside - at) + 0.5
                if abs(offset) < abs(best):
                    best = offset
        if step > abs(best) + 1.0:
            break
    return best if best < np.inf else np.nan


@_compiled
def _find_edges(points: Any, normals: Any, mask: Any, reach: int, offsets: Any) -> None:
    for k in range(points.shape[0]):
        u, v = points[k, 0], points[k, 1]
        across = v != np.rint(v)  # then the point lies on a column
        normal = normals[k, 1] if across else normals[k, 0]
        outward = 1 if normal > 0 else -1
        line, at = (int(np.rint(u)), v) if across else (int(v), u)
        offsets[k] = _search(mask, across, line, at, outward, reach) * abs(normal)


def find_edges(contour: ContourPoints, mask: Codes, reach_px: int) -> FloatArray:
    """How far the observed edge lies from each predicted contour point.

    Args:
        contour: K points of one state.
        mask: ``(H, W)`` observed; or SEEN, NOTHING and HIDDEN, which has no edge with either.
        reach_px: How far along the row or column an edge is looked for.

    Returns:
        ``(K,)`` pixels along the outward normal; NaN where no such edge is in reach.
    """
    offsets = np.empty(len(contour.arm))
    _find_edges(contour.points_px, contour.normals, mask, reach_px, offsets)
    return offsets


@_compiled
def median_size(offsets: Any) -> float:
    """Median of the sizes of offsets ``(K,)``; those that are NaN do not count, and there must be others."""
    return float(np.median(np.abs(offsets[~np.isnan(offsets)])))


@_compiled
def deviation(offsets: Any, fewest: int) -> float:
    """Median of absolute deviations from the median of ``(K,)`` offsets but for NaN; NaN where these are too few."""
    found = offsets[~np.isnan(offsets)]
    if len(found) < fewest:
        return np.nan
    return float(np.median(np.abs(found - np.median(found))))


@_compiled
def _accumulate(offsets: Any, lengths: Any, jacobian: Any, scale: Any, width: float, A: Any, b: Any) -> None:
    size = jacobian.shape[1]
    row = np.empty(size + 1)
    row[size] = 1.0
    for k in range(offsets.shape[0]):
        r = offsets[k]
        if np.isnan(r):
            continue
        weight = lengths[k] / (1.0 + (r / width) ** 2) ** 2
        for i in range(size):
            row[i] = jacobian[k, i] * scale[i]
        for i in range(size + 1):
            b[i] += weight * row[i] * r
            for j in range(i + 1):
                A[i, j] += weight * row[i] * row[j]
    for i in range(size + 1):
        for j in range(i):
            A[j, i] = A[i, j]


def normal_equations(
    offsets_px: FloatArray, contour: ContourPoints, scale: FloatArray, width_px: float
) -> tuple[FloatArray, FloatArray]:
    """Robust least squares of ``offset = J d + o``: steps ``d`` of the state and an offset ``o`` common to all points.

    The weights are those of Geman and McClure, ``1 / (1 + (r / width)²)²``, times the length of contour that a point
    stands for. The common offset is what a dilated or eroded mask has; without it a pixel of dilation would read as
    an instrument several millimetres nearer.

    Args:
        offsets_px: ``(K,)`` of :func:`find_edges`.
        contour: Its K points.
        scale: ``(n,)`` natural step of each component, in which ``d`` is counted.
        width_px: Offsets beyond it count ever less.

    Returns:
        ``(n + 1, n + 1)`` matrix and ``(n + 1,)`` right-hand side, in pixels, the common offset last.
    """
    size = len(scale) + 1
    A, b = np.zeros((size, size)), np.zeros(size)
    _accumulate(offsets_px, contour.lengths_px, contour.jacobian, scale, width_px, A, b)
    return A, b


def explained_lengths(
    contour: ContourPoints, offsets_px: FloatArray, common_px: float, tolerance_px: float
) -> tuple[float, float]:
    """Length of the predicted contour that has an observed edge within a tolerance, and of all of it, pixels."""
    near = np.abs(offsets_px - common_px) <= tolerance_px  # false for NaN
    return float(contour.lengths_px[near].sum()), float(contour.lengths_px.sum())


def missed_lengths(
    contour: ContourPoints, offsets_px: FloatArray, common_px: float, tolerance_px: float, shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Length of each link's contour that has no observed edge within a tolerance, and all of it.

    Args:
        contour: K points.
        offsets_px: ``(K,)`` of :func:`find_edges`.
        common_px: Offset common to all edges.
        tolerance_px: How near an edge has to be.
        shape: ``(arms, links)``.

    Returns:
        Two arrays of that shape, pixels.
    """
    owner = contour.arm * shape[1] + contour.link
    count = shape[0] * shape[1]
    missed = ~(np.abs(offsets_px - common_px) <= tolerance_px)  # true for NaN
    lengths = (
        np.bincount(owner[missed], contour.lengths_px[missed], count),
        np.bincount(owner, contour.lengths_px, count),
    )
    of_missed, of_all = (np.asarray(length, dtype=np.float64).reshape(shape) for length in lengths)
    return of_missed, of_all


class MissedEdge(NamedTuple):
    """What of an observed mask's edge lies near no edge of a silhouette.

    Attributes:
        explained: Share of the edge's pixels that do; 1 for an empty mask.
        places_px: ``(K, 2)`` column and row of those that lie farther off than the wider tolerance.
    """

    explained: float
    places_px: FloatArray


def missed_edge(
    mask: Mask, silhouette: Mask, tolerance_px: int, wider_px: int, hidden: Mask | None = None
) -> MissedEdge:
    """Hold the edge of an observed mask against that of a silhouette. The image's border is no edge.

    Args:
        mask: ``(H, W)`` observed.
        silhouette: ``(H, W)`` predicted.
        tolerance_px: How near, in rows and columns.
        wider_px: How near for an edge not to be told with its place.
        hidden: ``(H, W)`` where the mask says nothing: its edges with that are none.
    """
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    if not width:
        return MissedEdge(1.0, np.zeros((0, 2)))
    margin = max(tolerance_px, wider_px) + 1
    around = (
        slice(max(top - margin, 0), top + height + margin),
        slice(max(left - margin, 0), left + width + margin),
    )
    seen = np.ascontiguousarray(mask[around]).view(np.uint8)
    filled = seen if hidden is None else seen | hidden[around].view(np.uint8)
    edge = seen > cv2.erode(filled, np.ones((3, 3), np.uint8))
    ours = np.ascontiguousarray(silhouette[around]).view(np.uint8)
    count = int(np.count_nonzero(edge))
    if not count:
        return MissedEdge(1.0, np.zeros((0, 2)))
    missed = edge & ~_near_an_edge(ours, tolerance_px)
    explained = 1.0 - np.count_nonzero(missed) / count
    far = missed if wider_px == tolerance_px else missed & ~_near_an_edge(ours, wider_px)
    found = cv2.findNonZero(far.view(np.uint8))
    origin = np.array([around[1].start, around[0].start], dtype=np.float64)
    places = np.zeros((0, 2)) if found is None else np.asarray(found, dtype=np.float64).reshape(-1, 2) + origin
    return MissedEdge(explained, places)


def _near_an_edge(silhouette: NDArray[np.uint8], tolerance_px: int) -> Mask:
    square = np.ones((2 * tolerance_px + 1, 2 * tolerance_px + 1), np.uint8)
    return np.asarray(cv2.dilate(silhouette, square) > cv2.erode(silhouette, square))
