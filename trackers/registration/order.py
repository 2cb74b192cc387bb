"""Which of two arms is in front, place by place: two that lie along each other may change about.

Where one is expected and the other is seen, that one is in front. Where hardly anything shows that, the expected depths
decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from surgbench.camera import Camera
from surgbench.compiled import compiled
from surgbench.contract import Mask
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.state import ANGLES, POSITION

CELL_PX = 8
AROUND = 5  # cells to a side, in which it is counted what shows who is in front
CLEAR = 2.0  # times as many pixels as for the contrary
# Nearer by as much counts as so many pixels, by twice as much as four times as many: pixels that the other arm was
# expected to cover may be missing for being elsewhere.
CLEAR_M, CLEAR_PX = 0.002, 60.0
AXIS_M = np.linspace(-0.08, 0.024, 27)  # from the wrist along the shaft


class Order:
    """Says where an arm's mask does not hide the other arm, which is in front of it.

    Args:
        camera: Of the view.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._cells = -(-camera.height // CELL_PX), -(-camera.width // CELL_PX)

    def clear(
        self,
        hides: Sequence[Mask],
        masks: Sequence[Mask],
        silhouettes: Sequence[Mask],
        states: FloatArray,
        lost: Sequence[bool],
    ) -> None:
        """Leave out, of what each arm may hide, the places where the other one is in front.

        Args:
            hides: Of both arms ``(H, W)``; written into.
            masks: Where each is seen.
            silhouettes: Where each is expected.
            states: ``(2, 9)`` likewise, in the view's frame.
            lost: Of which arms that means nothing.
        """
        if any(lost) and all(lost):
            return
        evidence = np.zeros((3, *self._cells))
        for arm in range(2):
            if not lost[1 - arm]:
                _count(masks[arm], silhouettes[1 - arm], evidence[arm])
        if not any(lost):
            _count(silhouettes[0], silhouettes[1], evidence[2])
        if not evidence.any():
            return
        for one in evidence:
            one[:] = cv2.boxFilter(one, -1, (AROUND, AROUND), normalize=False, borderType=cv2.BORDER_CONSTANT)
        rows, columns = np.nonzero(evidence.any(axis=0))
        counts = evidence[:2, rows, columns]
        if not any(lost):
            centres = (np.stack([columns, rows], axis=1).astype(np.float64) + 0.5) * CELL_PX
            nearer_m = self._depths_m(states[1], centres) - self._depths_m(states[0], centres)
            belief = CLEAR_PX * np.sign(nearer_m) * (nearer_m / CLEAR_M) ** 2
            counts += np.maximum(np.stack([belief, -belief]), 0.0)
        for arm in range(2):
            front = counts[arm] > CLEAR * counts[1 - arm]
            _clear(hides[1 - arm], rows[front], columns[front])

    def _depths_m(self, state: FloatArray, places_px: FloatArray) -> FloatArray:
        """How far away an arm is, at pixels ``(k, 2)`` that it covers: as its axis is where that is nearest."""
        camera = self._camera
        points = state[POSITION] + AXIS_M[:, None] * look_at_rotation(state[ANGLES])[:, 2]
        points = points[points[:, 2] > 0]
        if len(points) == 0:
            return np.full(len(places_px), np.inf)
        pixels = points[:, :2] / points[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        nearest = ((places_px[:, None] - pixels) ** 2).sum(axis=2).argmin(axis=1)
        return np.asarray(points[nearest, 2])


def _count(one: Mask, other: Mask, cells: FloatArray) -> None:
    """Count the pixels of both masks in each cell."""
    both = (one & other).view(np.uint8)
    left, top, width, height = cv2.boundingRect(both)
    _add_up(both, top, top + height, left, left + width, cells)


@compiled
def _add_up(pixels: Any, top: int, bottom: int, left: int, right: int, cells: Any) -> None:
    for row in range(top, bottom):
        for column in range(left, right):
            cells[row // CELL_PX, column // CELL_PX] += pixels[row, column]


@compiled
def _clear(mask: Any, rows: Any, columns: Any) -> None:
    """Empty a mask in some cells."""
    for k in range(rows.shape[0]):
        top, left = rows[k] * CELL_PX, columns[k] * CELL_PX
        for row in range(top, min(top + CELL_PX, mask.shape[0])):
            for column in range(left, min(left + CELL_PX, mask.shape[1])):
                mask[row, column] = False
