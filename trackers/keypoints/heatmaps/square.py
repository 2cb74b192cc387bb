"""The square around the jaws that the network looks at, turned so that the shaft comes from below.

An instrument enters the image at its border. What lies farthest from there are its jaws, or a bent wrist; how thick it
is there says how large it appears. With place, direction and size taken from the mask, the network has less to learn
and needs no more than a small image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.contract import Mask
from surgbench.geometry import FloatArray

# The geometry is worked out on a mask of about this many pixels across.
COARSE_PX = 176
# Side of the square in radii of the instrument near its far end, and how far its middle lies ahead of the mask's: then
# 99 % of tips are in it, however the wrist is bent.
SIDE_RADII = 6.4
AHEAD_RADII = 1.1
# The picture is cut at this many times its size and then reduced, against aliasing.
OVERSAMPLING = 2
# What the picture shows beyond the image's border: neither instrument nor background, for a jaw that the border cuts
# has no tip there.
OUTSIDE = 128
# How far from the far end thickness and middle are taken, in radii.
REACH_RADII = 5.0
LEAST_AREA_PX = 12


@dataclass(frozen=True)
class Square:
    """A square part of an image.

    Attributes:
        centre_px: ``(2,)`` (u, v).
        side_px: Length of its sides, pixels of the image.
        up_rad: Direction in the image that is up in the square, 0 along u, pi/2 along v.
    """

    centre_px: FloatArray
    side_px: float
    up_rad: float

    def to_square(self, size: int) -> FloatArray:
        """``(2, 3)`` affine map from pixels of the image to those of a ``size x size`` picture of the square."""
        scale = size / self.side_px
        # The image's direction `up` becomes (0, -1).
        turn = -np.pi / 2 - self.up_rad
        cos, sin = scale * np.cos(turn), scale * np.sin(turn)
        linear = np.array([[cos, -sin], [sin, cos]])
        middle = np.array([(size - 1) / 2, (size - 1) / 2])
        return np.column_stack([linear, middle - linear @ self.centre_px])

    def cut(self, mask: Mask, size: int) -> NDArray[np.uint8]:
        """The square as a ``(size, size)`` uint8 picture: 255 the mask, 0 the background, 128 beyond the image."""
        picture = np.ascontiguousarray(mask).view(np.uint8) * np.uint8(255)
        large = OVERSAMPLING * size
        turned = cv2.warpAffine(
            picture, self.to_square(large), (large, large), flags=cv2.INTER_LINEAR, borderValue=OUTSIDE
        )
        return np.asarray(cv2.resize(turned, (size, size), interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def grown(self, factor: float) -> Square:
        """A larger square about the same centre."""
        return replace(self, side_px=factor * self.side_px)

    def to_image(self, points: FloatArray, size: int) -> FloatArray:
        """Pixels ``(..., 2)`` of the ``size x size`` picture as pixels of the image."""
        affine = self.to_square(size)
        return np.asarray((points - affine[:, 2]) @ np.linalg.inv(affine[:, :2]).T)


def find_square(mask: Mask) -> Square | None:
    """The square around the far end of the largest part of a mask.

    Args:
        mask: ``(H, W)`` bool.

    Returns:
        ``None`` where there is no instrument: the mask is empty, full, a mere strip, or has nothing but
        specks.
    """
    height, width = mask.shape
    step = max(1, round(max(height, width) / COARSE_PX))
    if min(height, width) < step:
        return None
    coarse = _reduce(mask, step)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(coarse)
    if count < 2:
        return None
    largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    area = stats[largest, cv2.CC_STAT_AREA]
    if area < LEAST_AREA_PX or area == coarse.size:
        return None
    part = (labels == largest).astype(np.uint8)
    rows, columns = np.nonzero(part)
    places = np.stack([columns, rows], axis=1).astype(np.float64)
    thickness = _thickness(part)[rows, columns]
    on_border = _on_border(places, part.shape)
    entry = _entry(places, thickness, on_border)
    far = _farthest(places, entry)
    other = _farthest(places, places[far])
    if on_border[far] and not on_border[other]:
        # A wrist or a shaft that the border cuts lengthwise was taken for where the instrument enters.
        entry, far = places[far], other
    # Perspective makes the near end of the shaft thicker: the thickness that counts is that near the far end.
    radius = float(thickness.max())
    for _ in range(2):
        near = _distances(places, places[far]) <= max(REACH_RADII * radius, 1.0)
        radius = float(thickness[near].max())
    middle = places[near].mean(axis=0)
    way = middle - entry
    up_rad = float(np.arctan2(way[1], way[0]))
    radius = max(radius, 1.0)
    centre = middle + AHEAD_RADII * radius * np.array([np.cos(up_rad), np.sin(up_rad)])
    return Square(centre_px=step * centre + (step - 1) / 2, side_px=step * SIDE_RADII * radius, up_rad=up_rad)


def _reduce(mask: Mask, step: int) -> NDArray[np.uint8]:
    """The mask at a ``step``-th of its size: pixels of which at least half are covered."""
    height, width = mask.shape
    if step == 1:
        return mask.astype(np.uint8)
    whole = mask[: height // step * step, : width // step * step].view(np.uint8) * np.uint8(255)
    small = cv2.resize(whole, (width // step, height // step), interpolation=cv2.INTER_AREA)
    return np.asarray(small >= 128, dtype=np.uint8)


def _thickness(part: NDArray[np.uint8]) -> FloatArray:
    """Distance of each pixel to the nearest pixel outside; the image's border is no edge."""
    padded = cv2.copyMakeBorder(part, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    return np.asarray(cv2.distanceTransform(padded, cv2.DIST_L2, 3)[1:-1, 1:-1], dtype=np.float64)


def _on_border(places: FloatArray, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    height, width = shape
    return np.asarray((places == 0).any(axis=1) | (places[:, 0] == width - 1) | (places[:, 1] == height - 1))


def _entry(places: FloatArray, thickness: FloatArray, on_border: NDArray[np.bool_]) -> FloatArray:
    """Where the instrument enters the image: the thickest place on its border, or anywhere where it touches none."""
    eligible = on_border if on_border.any() else np.ones_like(on_border)
    # Not one pixel of a plateau, but its middle.
    alike = eligible & (thickness >= thickness[eligible].max() - 1.0)
    return np.asarray(places[alike].mean(axis=0))


def _farthest(places: FloatArray, place: FloatArray) -> int:
    return int(np.argmax(_distances(places, place)))


def _distances(places: FloatArray, place: FloatArray) -> FloatArray:
    """As ``np.linalg.norm`` along the short axis, to the last bit, but faster."""
    across, down = places[:, 0] - place[0], places[:, 1] - place[1]
    return np.asarray(np.sqrt(across * across + down * down))
