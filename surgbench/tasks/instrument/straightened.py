"""Pictures and points of a recording's camera as a dataset has them: without the lens, perhaps of half the size."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.camera.undistortion import Undistortion, undistort_points
from surgbench.contract import Mask
from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray
from surgbench.tasks.instrument.footage import BOTH, half, written


class Straightened:
    """What a camera saw, as it is written.

    Args:
        camera: Lens included.
        halved: What is written is of half the size.
        who: The sequence, for messages.
    """

    def __init__(self, camera: Camera, *, halved: bool, who: str) -> None:
        self._camera, self._halved, self._who = camera, halved, who
        self._target = written(camera, halved=halved)
        sizes = (camera, half(camera)) if halved else (camera,)
        self._lenses = {(one.width, one.height): Undistortion(one) for one in sizes}

    def picture(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A picture of the camera's size or the one that is written; a mask's pixel is its nearest, of four the most.

        Raises:
            DatasetError: It is of another size.
        """
        size = (picture.shape[1], picture.shape[0])
        if size not in self._lenses:
            sizes = " or ".join(f"{width}x{height}" for width, height in self._lenses)
            raise DatasetError(f"sequence '{self._who}': a picture is {size[0]}x{size[1]} pixels; not {sizes}")
        how = cv2.INTER_NEAREST if picture.ndim == 2 else cv2.INTER_LINEAR
        straight = self._lenses[size](picture, how)
        if size != (self._target.width, self._target.height):
            straight = cv2.resize(straight, (self._target.width, self._target.height), interpolation=cv2.INTER_AREA)
        return np.asarray(straight, dtype=np.uint8)

    def masks(self, masks: Mapping[str, Mask]) -> dict[str, Mask]:
        """Masks of each kind; with those of two arms their union too."""
        found = {kind: self.picture(np.where(masks[kind], 255, 0).astype(np.uint8)) > 127 for kind in masks}
        if len(found) == 2:
            found[BOTH] = np.logical_or.reduce(list(found.values()))
        return found

    def points(self, points: FloatArray) -> FloatArray:
        """``(..., 2)`` pixels of the recording where they lie in what is written; NaN outside of it."""
        known = ~np.isnan(points).any(axis=-1)
        moved = np.where((known & self._camera.contains(points))[..., None], points, np.nan)
        moved = undistort_points(moved, self._camera)
        return moved / 2 - 0.25 if self._halved else moved
