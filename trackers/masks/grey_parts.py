"""Finds what is grey before what is coloured: instruments of steel and black plastic before tissue or drapes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from surgbench.contract import Mask

FloatImage = NDArray[np.float32]

DARK = 16.0  # levels of 255 below which colours are noise
# A threshold between grey and coloured, as a share of the coloured class's saturation, is no lower and no higher.
THRESHOLD_RANGE = 0.4, 0.72
BINS = 24  # of each of the three axes of the colours' histograms
FLOOR = 1e-3  # of the histograms, so that colours not seen before are no evidence
# Pixels of the reduced picture.
OPENING_PX = 3
SNAP_PX = 2
RING_PX = 2, 7  # inside and outside of a part's outline, where its contrast is measured
APART_PX = 5  # the grey parts that a joint or a marker cuts off
AROUND_PX = 3  # of a mask that says where an instrument was
# Shares of the picture.
CONTACT = 0.02  # of its width, at the border
LARGE = 0.004
PIECE = 0.0008
HOLE = 0.004
WITHIN = 0.6  # of a part, where an instrument was
LEAST_MASK_PX = 50


@dataclass(frozen=True)
class Thresholds:
    """What may be set.

    Attributes:
        contrast: How much greyer than its surroundings a part must be, as a share of their saturation.
        probability: Of a pixel's colour to be an instrument's.
    """

    contrast: float
    probability: float


@dataclass(frozen=True)
class Found:
    """Instruments in a picture.

    Attributes:
        mask: ``(height, width)`` bool.
        probability: Mean of the mask's pixels to be an instrument's by their colours, 0 to 1; 0 where it is empty.
    """

    mask: Mask
    probability: float


def find_grey(picture: NDArray[np.uint8], before: Mask | None, thresholds: Thresholds) -> Found:
    """The instruments in a picture.

    Otsu's threshold of the saturation gives a first mask: parts that come from the picture's border, large and greyer
    than what is around them; highlights are neither. The colours in it and away from it make two histograms, by which
    each pixel has a probability, and parts of what is probable are chosen likewise. Holes are filled, which painted
    markers leave, and the outline goes to the nearest edge by a watershed.

    Args:
        picture: ``(height, width, 3)`` uint8 RGB, already reduced in size.
        before: ``(height, width)`` where instruments were in the last frame, or are predicted; parts that lie there
            need not come from the border.
        thresholds: What may be set.
    """
    smooth = np.asarray(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 1.0), np.float32)
    grey, saturation = grey_pixels(smooth)
    around = None if before is None else _grown(before, AROUND_PX)
    first = choose(grey, saturation, thresholds.contrast, around)
    if np.count_nonzero(first) < LEAST_MASK_PX:
        return Found(np.zeros(grey.shape, bool), 0.0)
    probability = by_colours(smooth, first)
    mask = choose(probability > thresholds.probability, 1.0 - probability, thresholds.contrast, around, first)
    mask = snap(picture, filled(mask))
    return Found(mask, float(probability[mask].mean()) if mask.any() else 0.0)


def grey_pixels(smooth: FloatImage) -> tuple[Mask, FloatImage]:
    """Which pixels are grey, and each one's saturation as a share of the coloured ones'.

    Args:
        smooth: ``(height, width, 3)`` float32, 0 to 255.
    """
    highest = smooth.max(axis=2)
    saturation = (highest - smooth.min(axis=2)) / (highest + DARK)
    levels = np.clip(saturation * 255.0, 0, 255).astype(np.uint8)
    threshold = cv2.threshold(levels, 0, 255, cv2.THRESH_OTSU)[0] / 255.0
    coloured = saturation[saturation > threshold]
    usual = float(coloured.mean()) if len(coloured) else 1.0
    relative = np.asarray(saturation / max(usual, 1e-6), np.float32)
    return relative < np.clip(threshold / max(usual, 1e-6), *THRESHOLD_RANGE), relative


def choose(
    candidates: Mask, badness: FloatImage, contrast: float, around: Mask | None, core: Mask | None = None
) -> Mask:
    """Connected parts that are instruments, and the pieces next to them.

    Args:
        candidates: ``(height, width)``.
        badness: ``(height, width)`` which is lower in instruments, 0, than around them, 1.
        contrast: How much at least.
        around: Where parts need not reach the picture's border.
        core: What parts have to overlap.
    """
    opened = cv2.morphologyEx(candidates.astype(np.uint8), cv2.MORPH_OPEN, _disc(OPENING_PX))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    areas = stats[:, cv2.CC_STAT_AREA]
    border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    chosen = (np.bincount(border, minlength=count) >= CONTACT * candidates.shape[1]) & (
        areas >= LARGE * candidates.size
    )
    pieces = areas >= PIECE * candidates.size
    if around is not None:
        chosen |= pieces & (np.bincount(labels[around], minlength=count) >= WITHIN * areas)
    if core is not None:
        chosen &= np.bincount(labels[core], minlength=count) > 0
    chosen[0] = False
    for label in map(int, np.flatnonzero(chosen)):
        chosen[label] = _contrast(np.asarray(labels, np.int32), stats[label], label, badness) >= contrast
    if not chosen.any():
        return np.zeros(candidates.shape, bool)
    near = np.bincount(labels[_grown(chosen[labels], APART_PX)], minlength=count) > 0
    near[0] = False
    mask = (chosen | (near & pieces))[labels]
    return np.asarray(mask | (candidates & _grown(mask, OPENING_PX)))  # what opening took from it


def _contrast(labels: NDArray[np.int32], stats: NDArray[np.int32], label: int, badness: FloatImage) -> float:
    """How much better a part is inside its outline than outside."""
    left, top, wide, high = stats[: cv2.CC_STAT_AREA]
    margin = RING_PX[1] + 2
    window = (
        slice(max(0, top - margin), top + high + margin),
        slice(max(0, left - margin), left + wide + margin),
    )
    part, values = (labels[window] == label).astype(np.uint8), badness[window]
    means = []
    for one in (1 - part, part):
        distance = cv2.distanceTransform(one, cv2.DIST_L2, 3)
        ring = (distance > RING_PX[0]) & (distance <= RING_PX[1])
        if not ring.any():
            return 0.0
        means.append(float(values[ring].mean()))
    return means[0] - means[1]


def by_colours(smooth: FloatImage, mask: Mask) -> FloatImage:
    """``(height, width)`` probability of each pixel's colour to be one of a mask's rather than of what is away from it.

    Colours are the two log chromaticities, which do not change with brightness, and log brightness.
    """
    logs = np.log(smooth + 0.75 * DARK)
    axes = np.stack([logs[..., 0] - logs[..., 1], logs[..., 2] - logs[..., 1], logs.mean(axis=2)], axis=2)
    low, high = np.percentile(axes[::3, ::3].reshape(-1, 3), (1, 99), axis=0).astype(np.float32)
    cells = np.clip((axes - low) / np.maximum(high - low, 1e-3) * (BINS - 1), 0, BINS - 1).astype(np.int32)
    flat = (cells[..., 0] * BINS + cells[..., 1]) * BINS + cells[..., 2]
    inside = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    shares = []
    for one in (inside, ~_grown(mask, 4)):
        counts = np.bincount(flat[one], minlength=BINS**3).reshape(BINS, BINS, BINS).astype(np.float32)
        shares.append(gaussian_filter(counts, 1.0).ravel() / max(counts.sum(), 1.0) + FLOOR / BINS**3)
    probability = (shares[0] / (shares[0] + shares[1]))[flat]
    return np.asarray(cv2.GaussianBlur(probability.astype(np.float32), (0, 0), 1.0))


def filled(mask: Mask) -> Mask:
    """A mask without its small holes."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    holes = stats[:, cv2.CC_STAT_AREA] < HOLE * mask.size
    holes[0] = False
    return np.asarray(mask | holes[labels]) if count > 1 else mask


def snap(picture: NDArray[np.uint8], mask: Mask) -> Mask:
    """A mask whose outline lies on the strongest edge within ``SNAP_PX``; thin parts stay as they are."""
    size = 2 * SNAP_PX + 1
    inner = cv2.erode(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    thin = mask & ~_grown(inner, SNAP_PX + 1)
    markers = np.zeros(mask.shape, np.int32)
    markers[inner | thin] = 2
    markers[~_grown(mask, SNAP_PX)] = 1
    cv2.watershed(cv2.GaussianBlur(picture, (3, 3), 0), markers)
    return np.asarray((markers == 2) | ((markers == -1) & mask))


def _grown(mask: Mask, radius_px: int) -> Mask:
    size = 2 * radius_px + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)


def _disc(size_px: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size_px, size_px)), np.uint8)
