"""Cameras whose lens distorts: what they see of a pinhole camera's masks and images."""

from __future__ import annotations

from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera

Level = TypeVar("Level", bound=np.generic)


class Lens:
    """Turns masks of a pinhole camera into those of a camera with distortion (OpenCV's models).

    Args:
        camera: With or without distortion.

    Attributes:
        camera: As given.
        pinhole: Without distortion, and wide enough to hold all that the lens shows.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.pinhole = camera.pinhole
        self._columns = self._rows = None
        if not camera.is_distorted:
            return
        rows, columns = np.mgrid[: camera.height, : camera.width]
        straight = camera.lens.undistort(np.stack([columns, rows], axis=-1))
        self._sees = np.isfinite(straight[..., 0])
        # Where the lens sees nothing, any pixel does.
        nearest = np.rint(np.nan_to_num(straight)).astype(np.intp)
        low = np.minimum(nearest.min(axis=(0, 1)), 0)
        high = np.maximum(nearest.max(axis=(0, 1)), [camera.width - 1, camera.height - 1])
        width, height = (int(size) for size in high - low + 1)
        moved = {"cx": camera.cx - int(low[0]), "cy": camera.cy - int(low[1])}
        self.pinhole = self.pinhole.model_copy(update={"width": width, "height": height, **moved})
        self._columns, self._rows = np.moveaxis(nearest - low, -1, 0)
        self._exact = np.ascontiguousarray(np.nan_to_num(straight) - low, np.float32)

    def show(self, image: Any) -> Any:
        """The image of the camera, float32 with or without channels; black where the lens sees nothing."""
        if self._columns is None:
            return image
        seen = cv2.remap(image, self._exact[..., 0], self._exact[..., 1], cv2.INTER_LINEAR)
        seen[~self._sees] = 0.0
        return seen

    def see(self, mask: NDArray[Level]) -> NDArray[Level]:
        """The camera's mask, or picture of numbers: each pixel's centre takes the nearest of the pinhole's mask."""
        if self._columns is None:
            return mask
        seen = mask[self._rows, self._columns]
        seen[~self._sees] = 0
        return seen
