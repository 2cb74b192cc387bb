"""Pinhole cameras with OpenCV's axes and pixel centres at integer coordinates."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from surgbench.config import parse_model
from surgbench.errors import ConfigError, DatasetError
from surgbench.geometry import FloatArray

# Surfaces nearer to the camera plane than this are not seen.
NEAR_M = 1e-3

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Camera(BaseModel):
    """Intrinsics of one pinhole camera, pixels.

    A point ``(x, y, z)`` of the camera frame (metres; x right, y down, z forward) is seen at
    ``u = fx x / z + cx``, ``v = fy y / z + cy``; pixel ``(column 0, row 0)`` has its centre at (0, 0).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

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
        """
        points = np.asarray(points_cam, dtype=np.float64)
        z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
        u = self.fx * points[..., 0] / z + self.cx
        v = self.fy * points[..., 1] / z + self.cy
        return np.stack([u, v], axis=-1)

    def contains(self, pixels: FloatArray, margin_px: float = 0.0) -> np.ndarray:
        """Which pixels (``(..., 2)``) lie inside the image, at least ``margin_px`` from its border."""
        u, v = pixels[..., 0], pixels[..., 1]
        inside: np.ndarray = (
            (u >= margin_px - 0.5)
            & (u <= self.width - 0.5 - margin_px)
            & (v >= margin_px - 0.5)
            & (v <= self.height - 0.5 - margin_px)
        )
        return inside


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
