"""How much of each picture is instrument, and whether tips lie on it: the line that says so, what is to be doubted."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.recordings.coding import MOST_INSTRUMENT

# A part of a mask is as large as an instrument if it is at least this share of all that is in the mask.
LARGE_PART = 0.2
# In this share of the masks, at least, for it to be no accident.
OFTEN = 0.5
# Masks end short of tips, by no more than this share of the picture's diagonal.
NEAR = 0.05


class Shares:
    """Looks at one mask after the other, and keeps four numbers."""

    def __init__(self) -> None:
        self._masks = self._empty = self._split = 0
        self._least, self._most, self._fullest = np.inf, 0.0, 0

    def add(self, mask: NDArray[np.bool_], number: int) -> None:
        """Take in all that is instrument in one frame, ``(height, width)``."""
        self._masks += 1
        share = float(mask.mean())
        if not share:
            self._empty += 1
            return
        self._least = min(self._least, share)
        if share > self._most:
            self._most, self._fullest = share, number
        self._split += _parts_at_border(mask) > 1

    @property
    def said(self) -> str:
        """How much is instrument, a few words."""
        least, most = (
            f"{100 * share:.2g}" if share < 0.1 else f"{100 * share:.3g}" for share in (self._least, self._most)
        )
        words = f"{most} % instrument" if least == most else f"{least} to {most} % instrument"
        return f"{words}, {self._empty} empty" if self._empty else words

    def warnings(self, *, one_arm: bool) -> Iterable[str]:
        """What is to be doubted, one line each.

        Args:
            one_arm: All that was taken in is one instrument.
        """
        if self._most > MOST_INSTRUMENT:
            yield f"the mask of frame {self._fullest} is {100 * self._most:.0f} % instrument"
        seen = self._masks - self._empty
        if one_arm and self._split > max(1, OFTEN * seen):
            yield (
                f"{self._split} of {seen} masks have two large parts at the border: if they are two instruments, "
                "say --arms both, or --instances where their values differ"
            )


class Nearness:
    """Looks at marked tips, which lie on the instrument or close by it.

    Args:
        width: Of the pictures, pixels.
        height: Likewise.
    """

    def __init__(self, width: int, height: int) -> None:
        self._reach = max(2, round(NEAR * float(np.hypot(width, height))))
        self._tips = self._far = 0

    def add(self, mask: NDArray[np.bool_], tips: FloatArray) -> None:
        """Take in a mask, ``(height, width)``, and tips in it, ``(n, 2)`` pixels, NaN where they were not seen."""
        if not mask.any():
            return
        for u, v in np.rint(tips[np.isfinite(tips).all(axis=1)]).astype(int):
            around = mask[max(0, v - self._reach) : v + self._reach + 1, max(0, u - self._reach) : u + self._reach + 1]
            self._tips += 1
            self._far += not around.any()

    def warnings(self) -> Iterable[str]:
        """What is to be doubted, one line each."""
        if self._far > OFTEN * self._tips:
            yield (
                f"tips.csv: {self._far} of {self._tips} tips lie more than {self._reach} pixels from the mask: of "
                "pictures of another size, u and v exchanged, or another arm's?"
            )


def _parts_at_border(mask: NDArray[np.bool_]) -> int:
    """How many large parts of a mask reach the border."""
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    area = statistics[1:, cv2.CC_STAT_AREA]
    large = 1 + np.flatnonzero(area >= LARGE_PART * area.sum())
    if count < 3 or len(large) < 2:
        return min(len(large), 1)
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    return int(np.isin(large, border).sum())
