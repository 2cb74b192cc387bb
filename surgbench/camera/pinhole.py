"""Pinhole cameras with OpenCV's axes and pixel centres at integer coordinates."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from surgbench.camera.lens import DistortionModel, Lens, coefficients_problem, lens
from surgbench.config import Finite, Positive, Section
from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray

# Surfaces nearer to the camera plane than this are not seen.
NEAR_M = 1e-3


class Camera(Section):
    """Intrinsics of one pinhole camera, pixels, and its lens.

    A point ``(x, y, z)`` of the camera frame (metres; x right, y down, z forward) is seen at
    ``u = fx x / z + cx``, ``v = fy y / z + cy``; pixel ``(column 0, row 0)`` has its centre at (0, 0).
    ``distortion`` holds the coefficients of the lens's model, ``distortion_model``: ``"opencv"`` (none, or 4, 5, 8, 12
    or 14, in OpenCV's order) or ``"fisheye"`` (4, equidistant); see :mod:`surgbench.camera.lens`.

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
    distortion_model: DistortionModel = "opencv"

    @model_validator(mode="after")
    def _coefficients(self) -> Camera:
        if problem := coefficients_problem(self.distortion_model, self.distortion):
            raise ValueError(problem)
        return self

    @model_serializer(mode="wrap")
    def _without_what_is_not_there(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # Files of cameras that are no fisheyes, and their hashes, stay as they were before there were any.
        content = dict(serialise(self))
        if self.distortion_model == "opencv":
            content.pop("distortion_model", None)
        return content

    @property
    def is_distorted(self) -> bool:
        """Whether pictures of this camera must be undistorted before projection by K holds."""
        return self.distortion_model == "fisheye" or any(coefficient != 0.0 for coefficient in self.distortion)

    @property
    def pinhole(self) -> Camera:
        """The same camera without its lens."""
        return self.model_copy(update={"distortion": (), "distortion_model": "opencv"})

    @property
    def lens(self) -> Lens:
        """What takes pixels of :attr:`pinhole` to those of this camera, and back.

        Raises:
            ConfigError: The number of distortion coefficients is none of the model's.
        """
        intrinsics = self.fx, self.fy, self.cx, self.cy
        return lens(intrinsics, (self.width, self.height), self.distortion, self.distortion_model)

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

        Where a point is seen must move outwards when the point does: the radial part of the model grows. Infinite
        without distortion.
        """
        return self.lens.widest

    def see(self, points_cam: FloatArray) -> FloatArray:
        """Where the camera sees points of its frame, its lens's distortion included (OpenCV's models).

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
        return self.lens.distort(self.project(points_cam))

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the same pictures after ``cv2.resize`` to another size: pixels' areas are scaled, not centres.

        Raises:
            ConfigError: The size has another aspect ratio: neither length is the other's, rounded.

        Example:
            >>> from surgbench.camera import Camera
            >>> Camera(width=160, height=120, fx=200, fy=200, cx=79.5, cy=59.5).resized(80, 60)
            Camera(width=80, height=60, fx=100.0, fy=100.0, cx=39.5, cy=29.5, distortion=(), distortion_model='opencv')
        """
        across, down = width / self.width, height / self.height
        if abs(height - self.height * across) >= 1 and abs(width - self.width * down) >= 1:
            raise ConfigError(
                f"{self.width}x{self.height} pixels cannot be scaled to {width}x{height} (another aspect ratio)"
            )
        changes = {
            "width": width,
            "height": height,
            "fx": self.fx * across,
            "fy": self.fy * down,
            "cx": (self.cx + 0.5) * across - 0.5,
            "cy": (self.cy + 0.5) * down - 0.5,
        }
        return self.model_copy(update=changes)

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
