"""Cameras that cannot be: values in millimetres, of another picture, or from a calibration that went astray."""

from __future__ import annotations

import math

import numpy as np

from surgbench.camera.pinhole import Camera

# Of the picture's width: fields of view of 3 to 157 degrees, and fisheyes.
FOCAL = (0.1, 20.0)
# Pixels that are more than twice as long as they are wide are no camera's; fields of interlaced pictures are.
PIXEL_RATIO = 2.0
# The principal point may lie so far outside of the picture, of its width or height: cropped pictures.
OUTSIDE = 0.5
# Where only the middle of a picture can be seen through a lens, its model is not one of this picture.
SEEN = 0.25
_COEFFICIENT = 1e6


def implausible(camera: Camera) -> str | None:
    """What of a camera cannot be, and what is plausible, in words; ``None`` if it can.

    Example:
        A focal length in millimetres:

        >>> from surgbench.camera import Camera
        >>> from surgbench.camera.plausible import implausible
        >>> implausible(Camera(width=700, height=493, fx=4.5, fy=4.5, cx=350, cy=246))
        'fx is 4.5 where pictures are 700 wide; plausible is 70 to 14000 (pixels, not millimetres)'
    """
    low, high = (share * camera.width for share in FOCAL)
    if not low <= camera.fx <= high:
        return f"fx is {camera.fx:g} where pictures are {camera.width} wide; plausible is {low:g} to {high:g}" + (
            " (pixels, not millimetres)" if camera.fx < low else " (pixels)"
        )
    if not camera.fx / PIXEL_RATIO <= camera.fy <= camera.fx * PIXEL_RATIO:
        return (
            f"fy is {camera.fy:g} where fx is {camera.fx:g}; plausible is "
            f"{camera.fx / PIXEL_RATIO:g} to {camera.fx * PIXEL_RATIO:g} (pixels are nearly square)"
        )
    for key, value, length, side in (
        ("cx", camera.cx, camera.width, "wide"),
        ("cy", camera.cy, camera.height, "high"),
    ):
        if not -OUTSIDE * length <= value <= (1 + OUTSIDE) * length:
            return (
                f"{key} is {value:g} where pictures are {length} {side}; plausible is about {length / 2:g}, and no "
                f"further than {-OUTSIDE * length:g} to {(1 + OUTSIDE) * length:g} (a calibration of another size?)"
            )
    largest = max(map(abs, camera.distortion), default=0.0)
    if largest > _COEFFICIENT:
        return f"a distortion coefficient is {largest:g}; plausible is less than 10"
    if camera.is_distorted and (share := camera.lens.shares()[0]) < SEEN:
        return (
            f"distortion is such that the lens sees {100 * share:.0f} % of the picture{beyond(camera)}; plausible is "
            "all of it (coefficients in another order, or of another distortion_model?)"
        )
    return None


def beyond(camera: Camera) -> str:
    """Where its lens's model ends, as the rest of a sentence."""
    degrees = float(np.degrees(math.atan(camera.widest)))
    return f" (its model folds the picture over beyond {degrees:.0f} degrees from the axis)" if degrees < 87 else ""
