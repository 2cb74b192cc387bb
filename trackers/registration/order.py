"""Which of two arms is in front, place by place: two that lie along each other may change about.

Where one is expected and the other is seen, that one is in front. Where hardly anything shows that, the expected depths
decide.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from surgbench.camera import Camera
from surgbench.contract import Mask
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.instrument import Instrument
from surgbench.state import ANGLES, POSITION

CELL_PX = 8
AROUND = 5  # cells to a side, in which it is counted what shows who is in front
CLEAR = 2.0  # times as many pixels as for the contrary
CLEAR_M = 0.005  # nearer by as much, which counts as
CLEAR_PX = 60.0  # so many pixels
SHAFT_M = np.linspace(0.0, 0.08, 21)  # from the wrist backwards


class Order:
    """Says where an arm's mask does not hide the other arm, which is in front of it.

    Args:
        instruments: Of both arms.
        camera: Of the view.
    """

    def __init__(self, instruments: Sequence[Instrument], camera: Camera) -> None:
        self._instruments, self._camera = tuple(instruments), camera
        self._cells = -(-camera.width // CELL_PX), -(-camera.height // CELL_PX)

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
        expected = [np.zeros_like(one) if gone else one for one, gone in zip(silhouettes, lost, strict=True)]
        evidence = [self._count(masks[arm] & expected[1 - arm]) for arm in range(2)]
        both = evidence[0] + evidence[1]
        if not any(lost):
            both = both + self._count(silhouettes[0] & silhouettes[1])
        rows, columns = np.nonzero(both)
        if len(rows) == 0:
            return
        counts = np.stack([one[rows, columns] for one in evidence])
        if not any(lost):
            centres = (np.stack([columns, rows], axis=1) + 0.5) * CELL_PX
            nearer_m = self._depths_m(1, states[1], centres) - self._depths_m(0, states[0], centres)
            belief = CLEAR_PX * np.clip(nearer_m / CLEAR_M, -1.0, 1.0)
            counts += np.maximum(np.stack([belief, -belief]), 0.0)
        height, width = hides[0].shape
        for arm in range(2):
            front = np.zeros(self._cells[::-1], np.uint8)
            front[rows, columns] = counts[arm] > CLEAR * counts[1 - arm]
            whole = cv2.resize(front, None, fx=CELL_PX, fy=CELL_PX, interpolation=cv2.INTER_NEAREST)
            hides[1 - arm][whole[:height, :width] > 0] = False

    def _count(self, mask: Mask) -> FloatArray:
        """Pixels of a mask in and around each cell."""
        width, height = self._cells
        picture = np.zeros((height * CELL_PX, width * CELL_PX), np.uint8)
        picture[: mask.shape[0], : mask.shape[1]] = mask
        cells = cv2.resize(picture * np.uint8(255), (width, height), interpolation=cv2.INTER_AREA).astype(np.float64)
        around = cv2.boxFilter(cells, -1, (AROUND, AROUND), normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(around * (CELL_PX**2 / 255.0))

    def _depths_m(self, arm: int, state: FloatArray, places_px: FloatArray) -> FloatArray:
        """How far away an arm is, at pixels ``(k, 2)`` that it covers: as its axis is where that is nearest."""
        instrument, camera = self._instruments[arm], self._camera
        wrist, tip = state[POSITION], instrument.tips_cam(state).mean(axis=0)
        axis = look_at_rotation(state[ANGLES])[:, 2]
        points = np.concatenate([wrist - SHAFT_M[:, None] * axis, wrist + (tip - wrist) * [[0.33], [0.67], [1.0]]])
        points = points[points[:, 2] > 0]
        if len(points) == 0:
            return np.full(len(places_px), np.inf)
        pixels = points[:, :2] / points[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        nearest = ((places_px[:, None] - pixels) ** 2).sum(axis=2).argmin(axis=1)
        return np.asarray(points[nearest, 2])
