"""What the console shows: the endoscope's picture above that of the auxiliary camera, for each eye (article, II-C).

The auxiliary camera's pictures are undistorted, sharpened and moved apart. "The article" is AutoCam (arXiv 2505.10398),
"the code" its AlexandreBanks6/RCL_Autocam_Public, ``ecm_videofeed_coupled.py``, of which facts are used and no text.
Pictures are uint8, ``(height, width, 3)`` RGB or ``(height, width)`` grey.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.camera.undistortion import Undistortion, check_size
from surgbench.config import NotNegative, Section
from surgbench.errors import SurgbenchError
from surgbench.report.drawing import Picture

KERNEL_PX, SIGMA_PX = 15, 2.0


class StereoPicture(NamedTuple):
    """One picture for each eye."""

    left: Picture
    right: Picture


class ConsoleSettings(Section):
    """What the user of the console sets.

    Attributes:
        sharpening: alpha of :func:`sharpen`; 1 in the article, 3 in the code, 0 for none.
        separation_px: How far each of the auxiliary camera's pictures is moved, at its own resolution
            (:func:`move_apart`); the code's slider goes from -100 to 100 and starts at 50.
    """

    sharpening: NotNegative = 1.0
    separation_px: int = 0


def sharpen(picture: Picture, alpha: float = 1.0) -> Picture:
    """Sharpen by what a blur takes away: ``S = (alpha + 1) I - alpha G``.

    ``G`` is ``I`` blurred by a Gaussian of standard deviation ``SIGMA_PX`` in a window of ``KERNEL_PX`` (both the
    code's), mirrored at the border, and kept in floating point here; the code rounds it first, so that its result may
    be alpha / 2 + 1 / 2 grey levels off.

    Args:
        picture: ``(height, width[, 3])``.
        alpha: How much; 0 gives the picture back.

    Returns:
        Same shape, rounded and clipped to 0..255.
    """
    check_picture(picture)
    original = picture.astype(np.float32)
    blurred = cv2.GaussianBlur(original, (KERNEL_PX, KERNEL_PX), SIGMA_PX)
    sharp = cv2.addWeighted(original, alpha + 1.0, blurred, -alpha, 0.0)
    return np.asarray(np.rint(sharp).clip(0, 255), dtype=np.uint8)


def shift(picture: Picture, columns: int) -> Picture:
    """The picture moved to the right (to the left where ``columns`` is negative), black where nothing is left."""
    check_picture(picture)
    moved = np.zeros_like(picture)
    width = picture.shape[1]
    count = max(width - abs(columns), 0)
    if columns >= 0:
        moved[:, width - count :] = picture[:, :count]
    else:
        moved[:, :count] = picture[:, width - count :]
    return moved


def move_apart(pair: StereoPicture, separation_px: int) -> StereoPicture:
    """Move the left eye's picture to the left and the right eye's to the right, each by ``separation_px``.

    A point's disparity, its column in the left picture less that in the right one, gets smaller by twice as much: it
    looks farther away.
    """
    return StereoPicture(shift(pair.left, -separation_px), shift(pair.right, separation_px))


def fusing_separation_px(focal_px: float, baseline_m: float, distance_m: float) -> float:
    """The separation that leaves a point at this distance without disparity, in the plane of the screen.

    Half of ``f b / z``, the disparity of parallel cameras with principal points in the same column. This is what the
    article's users look for: they adjust until the tool does not move when they change eyes.
    """
    return 0.5 * focal_px * baseline_m / distance_m


def join(endoscope: Picture, auxiliary: Picture) -> Picture:
    """The endoscope's picture above the auxiliary camera's, at the width of the latter (article, fig. 3a).

    Args:
        endoscope: Scaled to the width of ``auxiliary``, its proportions kept.
        auxiliary: Left as it is.

    Returns:
        ``(height, width of auxiliary[, 3])``.

    Raises:
        SurgbenchError: One is grey, the other in colour.
    """
    check_picture(endoscope)
    check_picture(auxiliary)
    if endoscope.shape[2:] != auxiliary.shape[2:]:
        raise SurgbenchError("pictures of endoscope and auxiliary camera must both be grey or both be in colour")
    width = auxiliary.shape[1]
    height = max(1, round(endoscope.shape[0] * width / endoscope.shape[1]))
    if endoscope.shape[:2] != (height, width):
        how = cv2.INTER_AREA if width < endoscope.shape[1] else cv2.INTER_LINEAR
        endoscope = np.asarray(cv2.resize(endoscope, (width, height), interpolation=how), np.uint8)
    return np.concatenate([endoscope, auxiliary])


class ConsoleView:
    """The whole chain for one auxiliary stereo camera: undistorted, sharpened, moved apart, joined; in this order.

    The endoscope's pictures are only scaled. Nothing is turned: a camera that hangs upside down (as
    :func:`surgbench.viewpoint.placement.naive_pose` has it, y up) shows an upside down picture, here as in the code.
    """

    def __init__(self, left: Camera, right: Camera, settings: ConsoleSettings | None = None) -> None:
        """Make the maps of both lenses.

        Args:
            left: The auxiliary camera's left eye.
            right: Its right eye.
            settings: The article's where left out, pictures not moved.

        Raises:
            ConfigError: A camera's distortion is none of OpenCV's models.
            SurgbenchError: The cameras have different sizes.
        """
        if (left.width, left.height) != (right.width, right.height):
            raise SurgbenchError(
                f"left camera has {left.width}x{left.height} pixels, right camera {right.width}x{right.height} "
                "(both eyes need one size)"
            )
        self.settings = settings or ConsoleSettings()
        self._lenses = (Undistortion(left), Undistortion(right))

    def __call__(self, endoscope: StereoPicture, auxiliary: StereoPicture) -> StereoPicture:
        """Make the pictures of both monitors from one frame.

        Args:
            endoscope: Any size, the same for both eyes.
            auxiliary: As its cameras took them, of their size.

        Returns:
            The console's pictures, both of one size.

        Raises:
            SurgbenchError: A picture is of the wrong size, type or number of channels.
        """
        check_picture(endoscope.left)
        height, width = endoscope.left.shape[:2]
        check_size(endoscope.right, width, height, "endoscope's right picture")
        clear: list[Picture] = []
        for lens, picture, eye in zip(self._lenses, auxiliary, ("left", "right"), strict=True):
            check_picture(picture)
            check_size(picture, lens.camera.width, lens.camera.height, f"auxiliary camera's {eye} picture")
            clear.append(sharpen(lens(picture), self.settings.sharpening))
        apart = move_apart(StereoPicture(*clear), self.settings.separation_px)
        return StereoPicture(*(join(above, below) for above, below in zip(endoscope, apart, strict=True)))


def check_picture(picture: NDArray[Any]) -> None:
    """Refuse what is no picture.

    Raises:
        SurgbenchError: Not uint8, not ``(height, width)`` or ``(height, width, 3)``, or empty.
    """
    grey_or_colour = picture.ndim == 2 or (picture.ndim == 3 and picture.shape[2] == 3)
    if picture.dtype != np.uint8 or not grey_or_colour or not picture.size:
        raise SurgbenchError(
            f"not a picture: {picture.dtype} of shape {picture.shape} (must be uint8, height x width [x 3])"
        )
