"""Peaks of a heatmap to a fraction of a pixel."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray

TIPS = 2
# Rows and columns from a peak: itself, left, above, right, below.
AROUND = np.array([[0, 0, -1, 0, 1], [0, -1, 0, 1, 0]])


def find_peaks(logits: NDArray[np.float32], least_heat: float, apart_px: int) -> tuple[FloatArray, FloatArray]:
    """All peaks, the hottest first.

    A peak is the hottest pixel within ``apart_px`` in rows and columns. Its place is the top of a parabola through the
    logarithm of the heat of it and its neighbours, in rows and in columns: about a tip the heat is near a Gaussian, and
    its logarithm near a parabola.

    Args:
        logits: ``(s, s)`` float32.
        least_heat: Heat (the logistic function of the logits) below which nothing is a peak.
        apart_px: How near a hotter pixel may not be.

    Returns:
        Places ``(n, 2)`` as column and row, and their heat ``(n,)``.
    """
    # Beyond the border nothing is hotter.
    window = np.ones((2 * apart_px + 1, 2 * apart_px + 1), np.uint8)
    hottest = cv2.dilate(logits, window, borderType=cv2.BORDER_CONSTANT, borderValue=-1e9)
    least = np.log(least_heat / (1.0 - least_heat))
    rows, columns = np.nonzero((logits >= hottest) & (logits >= least))
    order = np.argsort(-logits[rows, columns], kind="stable")
    order = order[_first_of_alike(rows[order], columns[order], apart_px)]
    rows, columns = rows[order], columns[order]
    # All at once, for of a handful of numbers every call takes as long as of one.
    around = np.clip(np.stack([rows, columns])[:, None] + AROUND[:, :, None], 0, len(logits) - 1)
    log_heat = -np.logaddexp(0.0, -logits[around[0], around[1]].astype(np.float64))
    here = log_heat[0]
    across_and_down = _top(log_heat[1:3], here, log_heat[3:5])
    return np.stack([columns, rows], axis=1) + across_and_down.T, np.exp(here)


def _first_of_alike(rows: NDArray[np.int64], columns: NDArray[np.int64], apart_px: int) -> list[int]:
    """Which pixels remain where equally hot ones lie near each other: a top halfway between two pixels is one peak."""
    kept: list[int] = []
    for index, (row, column) in enumerate(zip(rows, columns, strict=True)):
        if all(max(abs(row - rows[one]), abs(column - columns[one])) > apart_px for one in kept):
            kept.append(index)
    return kept


def _top(before: FloatArray, here: FloatArray, after: FloatArray) -> FloatArray:
    """Where a parabola through three values one apart has its top, from the middle one, at most half a step away."""
    bend = before - 2.0 * here + after
    with np.errstate(divide="ignore", invalid="ignore"):
        top = 0.5 * (before - after) / bend
    return np.clip(np.where(bend < 0, top, 0.0), -0.5, 0.5)


def exactly_two(places: FloatArray) -> FloatArray | None:
    """The two peaks ``(2, 2)``; ``None`` where there are more or fewer, as in Hu et al. 2026."""
    return places if len(places) == TIPS else None
