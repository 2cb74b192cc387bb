"""Finds the straight edges of a shaft near where they are expected: what all pictures have in common, and masks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import NEAR_M, Camera
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.trackers.observations.shaft import Shaft, cylinder_edges

BIN_PX = 1.5
REFINEMENTS = 6
# Tukey's biweight: points farther from the line than this do not count.
OUTLIER_PX = 4.0


@dataclass(frozen=True)
class Gate:
    """How far from the expected edges the detector looks, and what it takes for an edge.

    Attributes:
        offset_px: On either side, measured along rows or columns.
        slope: Change of the expected line's slope against rows or columns.
        least_points: Rows or columns in which an edge must be seen.
    """

    offset_px: float
    slope: float
    least_points: int


@dataclass(frozen=True)
class Window:
    """Rows (or columns, of the transposed picture) in which the shaft is expected.

    Attributes:
        steep: Rows; else the picture is transposed.
        lines: ``(n,)`` their numbers.
        expected: ``(n,)`` where the edge is expected in each.
        rising: The instrument is expected where columns (or rows) are less.
        reach_px: How far to look on either side.
    """

    steep: bool
    lines: NDArray[np.int64]
    expected: FloatArray
    rising: bool
    reach_px: float


# The rows (or columns) of all places that may be of an edge, their offsets from where it is expected, and how much each
# counts, if not the same. A row may have any number of them.
Transitions = Callable[[Window], tuple[FloatArray, FloatArray, FloatArray | None]]


def detect_edges(mask: Mask, expected: FloatArray, span_px: FloatArray, gate: Gate) -> FloatArray:
    """The shaft's edges in a mask.

    A steep edge is sought where rows of the mask leave the instrument on the expected side, a flat one where columns
    do: a Hough vote over offset and slope, in which points near the expected line count for more, and then a robust
    line fit (Tukey's biweight).

    Args:
        mask: ``(height, width)`` bool.
        expected: ``(2, 3)`` n_u, n_v, rho of the expected edges, n away from the shaft; NaN if not seen.
        span_px: ``(2, 2)`` pixels between which the shaft's axis is expected; the second may be far outside.
        gate: Where to look.

    Returns:
        ``(found, 3)`` lines n_u, n_v, rho with n away from the shaft; 0, 1 or 2 of them.
    """
    return find_edges(mask.shape, expected, span_px, gate, partial(_transitions, mask))


def find_edges(
    shape: tuple[int, ...], expected: FloatArray, span_px: FloatArray, gate: Gate, transitions: Transitions
) -> FloatArray:
    """The shaft's edges in a picture: the lines that most places in a row support.

    Args:
        shape: Height and width.
        expected: As of :func:`detect_edges`, as are the next two, and the answer.
        span_px: See there.
        gate: Where to look.
        transitions: Finds places that may be of an edge.
    """
    if not np.isfinite(expected).all() or not np.isfinite(span_px).all():
        return np.empty((0, 3))
    lines = (_detect(shape, edge, span_px, gate, transitions) for edge in expected)
    return np.array([line for line in lines if line is not None]).reshape(-1, 3)


def expected_edges(
    rotation: FloatArray, translation_m: FloatArray, shaft: Shaft, camera: Camera
) -> tuple[FloatArray, FloatArray]:
    """Where a camera should see the shaft of a tool whose wrist-pitch frame is at this place in the camera's frame.

    Args:
        rotation: ``(3, 3)``.
        translation_m: ``(3,)``.
        shaft: The cylinder.
        camera: Intrinsics.

    Returns:
        ``(2, 3)`` edges and ``(2, 2)`` end points of the axis as :func:`detect_edges` takes them; NaN if not seen.
    """
    direction = rotation[:, 2]
    point = rotation[:, :2] @ shaft.axis_m + translation_m
    front, rear = point + shaft.front_m * direction, point + shaft.rear_m * direction
    if min(front[2], rear[2]) < NEAR_M <= max(front[2], rear[2]):
        # Only the part before the camera is seen.
        share = (NEAR_M - rear[2]) / (front[2] - rear[2])
        cut = rear + share * (front - rear)
        front, rear = (front, cut) if rear[2] < NEAR_M else (cut, rear)
    return cylinder_edges(point, direction, shaft.radius_m, camera), camera.project(np.stack([front, rear]))


def _detect(
    shape: tuple[int, ...], edge: FloatArray, span_px: FloatArray, gate: Gate, transitions: Transitions
) -> FloatArray | None:
    steep = bool(abs(edge[0]) >= abs(edge[1]))
    # Columns of the picture are rows of the transposed one: below, an edge crosses every row once.
    count, across, along = (shape[0], 0, 1) if steep else (shape[1], 1, 0)
    low, high = np.sort(np.clip(span_px[:, along], -1.0, count))
    lines = np.arange(int(np.ceil(max(low, 0.0))), int(np.floor(min(high, count - 1.0))) + 1)
    if len(lines) < gate.least_points:
        return None
    expected = (edge[2] - edge[along] * lines) / edge[across]
    rows, offsets, weights = transitions(Window(steep, lines, expected, bool(edge[across] > 0), gate.offset_px))
    fit = _fit(rows - lines.mean(), offsets, weights, gate, len(lines))
    if fit is None:
        return None
    # expected + offset + slope * (row - mean row), as a line of the image
    slope = fit[1] - edge[along] / edge[across]
    start = edge[2] / edge[across] + fit[0] - fit[1] * lines.mean()
    normal = np.empty(3)
    normal[across], normal[along], normal[2] = 1.0, -slope, start
    return np.asarray(normal * (np.sign(edge[across]) / np.hypot(1.0, slope)))


def _transitions(mask: Mask, window: Window) -> tuple[FloatArray, FloatArray, None]:
    """Rows of all places where the instrument ends towards the edge's outer side, and their offsets from it."""
    image = mask if window.steep else mask.T
    reach = int(np.ceil(window.reach_px))
    centre = np.floor(np.clip(window.expected, -reach - 2.0, image.shape[1] + reach + 2.0)).astype(np.int64)
    columns = centre[:, None] + np.arange(-reach, reach + 2)
    seen = (columns >= 0) & (columns < image.shape[1])
    inside = image[window.lines[:, None], np.clip(columns, 0, image.shape[1] - 1)]
    # The image's border is no edge: both pixels must be seen.
    here, there = (inside[:, :-1], inside[:, 1:]) if window.rising else (inside[:, 1:], inside[:, :-1])
    row, column = np.nonzero(here & ~there & seen[:, :-1] & seen[:, 1:])
    return window.lines[row].astype(np.float64), columns[row, column] + 0.5 - window.expected[row], None


def _fit(
    rows: FloatArray, offsets: FloatArray, counts: FloatArray | None, gate: Gate, length: int
) -> tuple[float, float] | None:
    """Offset and slope of the line with the best support, or ``None``; places may count differently."""
    if len(rows) < gate.least_points:
        return None
    # Neighbouring slopes differ by one bin at the ends.
    steps = max(1, int(np.ceil(gate.slope * length / (2 * BIN_PX))))
    slopes = np.linspace(-gate.slope, gate.slope, 2 * steps + 1)
    half = int(np.ceil(gate.offset_px / BIN_PX)) + 1
    bins = np.rint((offsets - slopes[:, None] * rows) / BIN_PX).astype(np.int64) + half
    width = 2 * half + 1
    kept = (bins >= 0) & (bins < width)
    flat = (bins + width * np.arange(len(slopes))[:, None])[kept]
    each = None if counts is None else np.broadcast_to(counts, bins.shape)[kept]
    votes = np.bincount(flat, each, minlength=width * len(slopes)).reshape(len(slopes), width).astype(np.float64)
    votes[:, 1:-1] = 0.5 * votes[:, :-2] + votes[:, 1:-1] + 0.5 * votes[:, 2:]
    places = (np.arange(width) - half) * BIN_PX
    near = np.exp(-0.5 * ((places / gate.offset_px) ** 2 + (slopes[:, None] / gate.slope) ** 2))
    best = int(np.argmax(votes * near))
    slope, offset = float(slopes[best // width]), float(places[best % width])
    # The first fit looks a little farther: the vote is only as fine as its bins.
    for reach in (2 * OUTLIER_PX, *([OUTLIER_PX] * REFINEMENTS)):
        residual = (offsets - offset - slope * rows) / reach
        weight = np.where(np.abs(residual) < 1, (1 - residual**2) ** 2, 0.0)
        if counts is not None:
            weight = weight * counts
        total = weight.sum()
        if np.count_nonzero(weight) < gate.least_points:
            return None
        mean_row, mean_offset = weight @ rows / total, weight @ offsets / total
        spread = weight @ (rows - mean_row) ** 2
        if spread <= 0:
            return None
        slope = float(weight @ ((rows - mean_row) * (offsets - mean_offset)) / spread)
        offset = float(mean_offset - slope * mean_row)
    return offset, slope
