"""Finds the two straight edges of a shaft in an image, near where they are expected.

A shaft is grey, what is around it is not: an edge is where colourfulness (the largest of a pixel's channels less the
smallest) rises outwards. Grey highlights along the shaft, its bright ring and the shadows of tissue have no such edge.
The image is sampled along rows (or columns) as a strip in which the expected edge is upright, and smoothed along it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.trackers.observations.edges import Gate, Window, find_edges
from surgbench.trackers.observations.paint import decoded

# Every other row is looked at. Blur across the edge, and how many of these rows are averaged along it.
EVERY, ACROSS_PX, ALONG = 2, 1.5, 5
# Least rise of the root of colourfulness, of 0 to 1, a pixel; and against the steepest in the same row.
LEAST_RISE, LEAST_SHARE = 0.005, 0.35
# How far the noise of a strip may turn an edge: change along the edge against that across.
ALONG_SHARE = 0.6
# So far from an edge it is all shaft, and all tissue; and so far at most its middle is from where it is steepest.
SIDE_PX, MIDDLE_PX = 3, 2
# Beyond a marker's rim its blur reaches so far.
MARKER_RIM_PX = 4.0
_DECODED = decoded(np.arange(256) / 255.0).astype(np.float32)


def detect_image_edges(
    image: NDArray[np.uint8],
    spots_px: FloatArray,
    radii_px: FloatArray,
    expected: FloatArray,
    span_px: FloatArray,
    gate: Gate,
) -> FloatArray:
    """The shaft's edges in an image.

    Args:
        image: ``(height, width, 3)`` RGB.
        spots_px: ``(n, 2)`` where markers are, or are expected; the image tells nothing there. NaN for none.
        radii_px: ``(n,)``.
        expected: As :func:`surgbench.trackers.observations.edges.detect_edges` takes them, as are the next two.
        span_px: See there.
        gate: See there.

    Returns:
        ``(found, 3)`` lines n_u, n_v, rho with n away from the shaft; 0, 1 or 2 of them.
    """
    known = np.isfinite(spots_px).all(axis=1)
    transitions = partial(_transitions, image, spots_px[known], radii_px[known] + MARKER_RIM_PX)
    fewer = replace(gate, least_points=-(-gate.least_points // EVERY))
    found: FloatArray = find_edges(image.shape[:2], expected, span_px, fewer, transitions)
    return found


def _transitions(
    image: NDArray[np.uint8], spots_px: FloatArray, radii_px: FloatArray, window: Window
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rows of all places where colourfulness rises outwards, their offsets from the edge, and how steep it is."""
    reach = int(np.ceil(window.reach_px))
    steps = np.arange(-reach, reach + 1.0)
    lines = window.lines[::EVERY].astype(np.float64)
    columns = window.expected[::EVERY, None] + steps
    rows = np.broadcast_to(lines[:, None], columns.shape)
    u, v = (columns, rows) if window.steep else (rows, columns)
    seen = (u >= 0) & (u <= image.shape[1] - 1) & (v >= 0) & (v <= image.shape[0] - 1)
    for (x, y), radius in zip(spots_px, radii_px, strict=True):
        seen &= (u - x) ** 2 + (v - y) ** 2 > radius**2
    maps = u.astype(np.float32), v.astype(np.float32)
    strip = cv2.LUT(cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), _DECODED)
    blurred = cv2.GaussianBlur(strip, (0, 0), sigmaX=ACROSS_PX, sigmaY=0.01)
    smooth: NDArray[np.float32] = np.asarray(cv2.blur(blurred, (1, ALONG)), np.float32)
    if not window.rising:  # below, columns go outwards
        smooth, seen = smooth[:, ::-1], seen[:, ::-1]
    # Roots, so that shadows beside a shaft, where tissue is dark, count as well.
    root = np.sqrt(smooth)
    colourful = _colourfulness(root)
    rise = np.gradient(colourful, axis=1)
    along = np.abs(np.gradient(colourful, axis=0)) if len(colourful) > 1 else np.zeros_like(colourful)
    rise = np.where(seen & (along <= ALONG_SHARE * rise), rise, 0.0)
    here, before, after = rise[:, 1:-1], rise[:, :-2], rise[:, 2:]
    steepest = rise.max(axis=1, keepdims=True)
    peak = (here > before) & (here >= after) & (here >= np.maximum(LEAST_RISE, LEAST_SHARE * steepest))
    row, column = np.nonzero(peak)
    offsets = steps[0] + _middles(_colourfulness(smooth), row, column + 1)
    weights = rise[row, column + 1] / steepest[row, 0]
    return lines[row], offsets if window.rising else -offsets, weights


def _colourfulness(strip: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(strip.max(axis=2) - strip.min(axis=2), np.float32)


def _middles(linear: NDArray[np.float32], row: NDArray[np.int64], column: NDArray[np.int64]) -> FloatArray:
    """Where values are half way from those on the one side of a steep place to those on the other.

    Blur mixes light, so that this is where the edge is; the steepest place of an image's own levels lies further on
    the dark side.
    """
    places = column[:, None] + np.arange(-SIDE_PX, SIDE_PX + 1)
    values = linear[row[:, None], np.clip(places, 0, linear.shape[1] - 1)]
    above = values >= (values[:, :1] + values[:, -1:]) / 2
    # The first that is above, near the middle, and the one before it.
    first = SIDE_PX - MIDDLE_PX + above[:, SIDE_PX - MIDDLE_PX : SIDE_PX + MIDDLE_PX + 1].argmax(axis=1)
    each = np.arange(len(row))
    low, high = values[each, first - 1], values[each, first]
    half = (values[:, 0] + values[:, -1]) / 2
    share = np.clip((half - low) / np.where(high > low, high - low, 1.0), 0.0, 1.0)
    return np.asarray(column + first - SIDE_PX - 1 + share, np.float64)
