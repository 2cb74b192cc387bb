"""Pictures and points as the pinhole camera without its lens would have taken them."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray


class Undistortion:
    """Removes what the lens of one camera does to pictures; its maps are made once.

    The undistorted picture has the camera's size and intrinsics: a point is where :meth:`Camera.project` puts it.
    """

    def __init__(self, camera: Camera) -> None:
        """Make the maps.

        Raises:
            ConfigError: The number of distortion coefficients is none of the model's.
        """
        self.camera = camera
        lens = camera.lens
        self._maps = lens.maps if camera.is_distorted else None

    def __call__(self, picture: NDArray[Any], interpolation: int = cv2.INTER_LINEAR) -> NDArray[Any]:
        """Undistort a picture.

        Args:
            picture: ``(height, width)`` or ``(height, width, channels)``, a type that OpenCV interpolates.
            interpolation: OpenCV's; ``cv2.INTER_NEAREST`` for masks.

        Returns:
            Same shape and type; black where the lens did not see. A camera without distortion gives the picture itself.

        Raises:
            SurgbenchError: The picture is not of the camera's size.
        """
        check_size(picture, self.camera.width, self.camera.height, "picture to undistort")
        if self._maps is None:
            return picture
        return np.asarray(cv2.remap(picture, *self._maps, interpolation))


def undistort_points(points: FloatArray, camera: Camera) -> FloatArray:
    """Where pixels of a camera's pictures lie in the undistorted ones.

    Args:
        points: ``(..., 2)``.
        camera: Lens included.

    Returns:
        ``(..., 2)``; NaN outside of the undistorted picture and where they are NaN already. A camera without distortion
        gives the points themselves.
    """
    if not camera.is_distorted:
        return points
    moved = camera.lens.undistort(points)
    return np.where(camera.contains(moved)[..., None], moved, np.nan)


def check_size(picture: NDArray[Any], width: int, height: int, what: str) -> None:
    """Refuse a picture of another size.

    Raises:
        SurgbenchError: The picture is not ``width`` by ``height`` pixels.
    """
    if picture.ndim not in (2, 3) or picture.shape[:2] != (height, width):
        shape = "x".join(str(length) for length in picture.shape[1::-1] + picture.shape[2:])
        raise SurgbenchError(f"{what}: is {shape or 'no picture'} (must be {width}x{height} pixels)")
