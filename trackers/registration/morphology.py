"""Masks grown, and rid of what is narrow."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.contract import Mask


def grown(mask: Mask, by_px: int) -> Mask:
    """A mask and all within so many pixels of it, along rows and columns; only the box around it is looked at."""
    found: NDArray[np.bool_] = np.zeros_like(mask)
    left, top, width, height = cv2.boundingRect(mask.view(np.uint8))
    if width:
        box = (
            slice(max(top - by_px, 0), top + height + by_px),
            slice(max(left - by_px, 0), left + width + by_px),
        )
        found[box] = cv2.dilate(np.ascontiguousarray(mask[box]).view(np.uint8), _square(2 * by_px + 1)).view(np.bool_)
    return found


def opened(mask: Mask, side_px: int) -> Mask:
    """What of a mask squares of this side, within it, cover."""
    return np.asarray(cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_OPEN, _square(side_px))).view(np.bool_)


def _square(side_px: int) -> NDArray[np.uint8]:
    return np.ones((side_px, side_px), np.uint8)
