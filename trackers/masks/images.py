"""The image that a mask is made of, checked."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surgbench.contract import Observation, View
from surgbench.errors import DatasetError


def image_of(observation: Observation, view: View) -> NDArray[np.uint8]:
    """A view's image, ``(height, width, 3)`` uint8 RGB.

    Raises:
        DatasetError: There is none, or it has another size than the camera; one line.
    """
    image, camera = view.image(), view.camera
    if image is None:
        raise DatasetError(f"frame {observation.index} has no image, which masks are to be made from")
    if image.ndim != 3 or image.shape[2] != 3:
        raise DatasetError(f"frame {observation.index}: the image has no three colours")
    if image.shape != (camera.height, camera.width, 3):
        raise DatasetError(
            f"frame {observation.index}: the image is {image.shape[1]} x {image.shape[0]} pixels, not {camera.width} x "
            f"{camera.height} as its camera's are"
        )
    return np.ascontiguousarray(image)
