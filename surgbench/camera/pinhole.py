"""Pinhole cameras with OpenCV's axes and pixel centres at integer coordinates."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from pydantic import Field

from surgbench.config import Finite, Positive, Section, parse_model
from surgbench.errors import ConfigError, DatasetError
from surgbench.geometry import FloatArray

# Surfaces nearer to the camera plane than this are not seen.
NEAR_M = 1e-3
# A lens is looked at to this far from its axis, as a tangent, in this many steps.
_WIDEST, _STEPS = 20.0, 20000


class Camera(Section):
    """Intrinsics of one pinhole camera, pixels.

    A point ``(x, y, z)`` of the camera frame (metres; x right, y down, z forward) is seen at
    ``u = fx x / z + cx``, ``v = fy y / z + cy``; pixel ``(column 0, row 0)`` has its centre at (0, 0).

    Example:
        >>> from surgbench.camera import Camera
        >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)  # pixels
        >>> camera.matrix
        array([[200.,   0.,  80.],
               [  0., 200.,  60.],
               [  0.,   0.,   1.]])
    """

    width: Annotated[int, Field(gt=0, le=16384)]
    height: Annotated[int, Field(gt=0, le=16384)]
    fx: Positive
    fy: Positive
    cx: Finite
    cy: Finite
    distortion: tuple[Finite, ...] = ()

    @property
    def matrix(self) -> FloatArray:
        """``(3, 3)`` intrinsic matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def project(self, points_cam: FloatArray) -> FloatArray:
        """Project points of the camera frame.

        Args:
            points_cam: ``(..., 3)`` metres.

        Returns:
            ``(..., 2)`` pixels (u, v); NaN for points at or behind the camera plane.

        Example:
            On the axis, 2 cm to the right and 1 cm further down, and behind the camera:

            >>> from surgbench.camera import Camera
            >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
            >>> camera.project([[0, 0, 0.1], [0.02, 0.01, 0.1], [0, 0, -0.1]])
            array([[ 80.,  60.],
                   [120.,  80.],
                   [ nan,  nan]])
        """
        points = np.asarray(points_cam, dtype=np.float64)
        z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
        u = self.fx * points[..., 0] / z + self.cx
        v = self.fy * points[..., 1] / z + self.cy
        return np.stack([u, v], axis=-1)

    @property
    def widest(self) -> float:
        """Tangent of the angle to the axis up to which the lens sees; beyond, its model folds the picture over.

        Where a point is seen must move outwards when the point does: the radial part of OpenCV's model grows. Infinite
        without distortion.
        """
        return _widest(self.distortion)

    def see(self, points_cam: FloatArray) -> FloatArray:
        """Where the camera sees points of its frame, its lens's distortion included (OpenCV's model).

        Args:
            points_cam: ``(..., 3)`` metres.

        Returns:
            ``(..., 2)`` pixels (u, v), inside the image or not; NaN for points at or behind the camera plane, and for
            those beyond :attr:`widest`.

        Example:
            A barrel distortion leaves the axis where it is and draws the rest inwards; :meth:`project` knows nothing
            of it.

            >>> from surgbench.camera import Camera
            >>> lens = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60, distortion=(-0.2, 0, 0, 0))
            >>> lens.see([[0, 0, 0.1], [0.02, 0.01, 0.1]]).round(3)
            array([[ 80. ,  60. ],
                   [119.6,  79.8]])
        """
        straight = self.project(points_cam)
        if not any(self.distortion):
            return straight
        rays = (straight - [self.cx, self.cy]) / [self.fx, self.fy]
        rays[np.hypot(rays[..., 0], rays[..., 1]) > self.widest] = np.nan
        rays = np.concatenate([rays, np.ones((*rays.shape[:-1], 1))], axis=-1)
        if rays.size == 0:
            return straight
        none = np.zeros(3)
        bent, _ = cv2.projectPoints(rays.reshape(-1, 1, 3), none, none, self.matrix, np.array(self.distortion))
        return np.asarray(bent, dtype=np.float64).reshape(straight.shape)

    def contains(self, pixels: FloatArray, margin_px: float = 0.0) -> np.ndarray:
        """Which pixels (``(..., 2)``) lie inside the image, at least ``margin_px`` from its border.

        Example:
            >>> import numpy as np
            >>> from surgbench.camera import Camera
            >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
            >>> camera.contains(np.array([[-0.5, 0.0], [-0.6, 0.0], [159.5, 119.5]]))
            array([ True, False,  True])
        """
        # Centres are integers, so that the first pixel begins half a pixel before 0 and the last ends half one later.
        u, v = pixels[..., 0], pixels[..., 1]
        inside: np.ndarray = (
            (u >= margin_px - 0.5)
            & (u <= self.width - 0.5 - margin_px)
            & (v >= margin_px - 0.5)
            & (v <= self.height - 0.5 - margin_px)
        )
        return inside


@lru_cache(maxsize=64)
def _widest(distortion: tuple[float, ...]) -> float:
    """:attr:`Camera.widest` of coefficients."""
    if not any(distortion):
        return float("inf")
    # OpenCV's order: the third and fourth are tangential, and those after the eighth not radial either.
    k1, k2, _, _, k3, k4, k5, k6 = (*distortion, *(0.0,) * 8)[:8]
    tangent = np.linspace(0.0, _WIDEST, _STEPS + 1)
    square = tangent**2
    numerator = 1.0 + square * (k1 + square * (k2 + square * k3))
    denominator = 1.0 + square * (k4 + square * (k5 + square * k6))
    with np.errstate(divide="ignore", invalid="ignore"):
        grows = np.diff(tangent * numerator / denominator) > 0
    return float(tangent[-1] if grows.all() else tangent[int(np.argmin(grows))])


def read_camera(path: Path) -> Camera:
    """Read a camera JSON file (keys width, height, fx, fy, cx, cy, optional distortion).

    Raises:
        DatasetError: The file is missing, is not JSON, or lacks a key; the message names it.
    """
    try:
        return parse_model(Camera, json.loads(path.read_text(encoding="utf-8")), str(path))
    except FileNotFoundError:
        raise DatasetError(f"{path}: camera file is missing (keys: width, height, fx, fy, cx, cy)") from None
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DatasetError(f"{path}: not valid JSON ({error})") from None
    except ConfigError as error:
        raise DatasetError(str(error)) from None
