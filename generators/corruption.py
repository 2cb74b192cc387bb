"""Segmentation errors: random dilation, erosion, and blobs on the edge of a mask.

The published settings and their order are those of the paper's released generator. There, discs are only added;
``blob_remove`` also cuts them out, because real segmentations miss parts of an edge as often as they spill over it.
"""

from __future__ import annotations

import cv2
import numpy as np

from surgbench.dataset.masks import Mask
from surgbench.generators.presets import Corruption


def corrupt(mask: Mask, settings: Corruption, rng: np.random.Generator) -> Mask:
    """Corrupt a mask.

    Args:
        mask: ``(height, width)`` bool; not changed.
        settings: What happens, and how often.
        rng: The only source of randomness.

    Returns:
        ``(height, width)`` bool.
    """
    image = mask.astype(np.uint8)
    for morphology in settings.morphology:
        if rng.random() < morphology.probability:
            kernel = np.ones((morphology.kernel_px, morphology.kernel_px), np.uint8)
            change = cv2.dilate if rng.random() < settings.dilation_share else cv2.erode
            image = np.asarray(change(image, kernel), np.uint8)
            break
    for blobs in settings.blobs:
        if rng.random() < blobs.probability:
            _add_blobs(image, blobs.radius_px, int(rng.poisson(blobs.mean_count)), settings, rng)
    result: Mask = image > 0
    return result


def _add_blobs(image: np.ndarray, radius: int, count: int, settings: Corruption, rng: np.random.Generator) -> None:
    """Add or cut out up to ``count`` discs, in place; all centres are drawn from the edge as it is now."""
    kernel = np.ones((3, 3), np.uint8)
    rows, columns = np.nonzero(cv2.dilate(image, kernel) != cv2.erode(image, kernel))
    if not len(rows):
        return
    height, width = image.shape
    offset = np.arange(-radius, radius + 1)
    disc = offset[:, None] ** 2 + offset[None, :] ** 2 <= radius**2
    for index, draw in zip(rng.integers(len(rows), size=count), rng.random(count), strict=True):
        if draw >= settings.blob_add + settings.blob_remove:
            continue
        top, left = int(rows[index]) - radius, int(columns[index]) - radius
        down = slice(max(top, 0), min(top + len(disc), height))
        across = slice(max(left, 0), min(left + len(disc), width))
        covered = disc[down.start - top : down.stop - top, across.start - left : across.stop - left]
        image[down, across][covered] = draw < settings.blob_add
