"""OpenCV's polygon filling, one call a triangle."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from surgbench.camera import NEAR_M, Camera
from surgbench.comparison.peers.base import Peer
from surgbench.comparison.peers.body import Body
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument

# Coordinates are fixed-point numbers with this many bits behind the point.
FRACTION_BITS = 8


class OpenCV(Peer):
    """``fillConvexPoly`` on the back faces. It also draws the pixels that a boundary only touches."""

    name: ClassVar[str] = "opencv"
    module: ClassVar[str] = "cv2"
    exact: ClassVar[bool] = False

    def prepare(self, instrument: Instrument, camera: Camera) -> None:
        """Lay the meshes end to end."""
        import cv2

        super().prepare(instrument, camera)
        cv2.setNumThreads(1)
        self._cv2 = cv2
        self._body = Body(instrument)
        self._image = np.empty((camera.height, camera.width), dtype=np.uint8)

    def draw(self, transforms: FloatArray) -> Mask:
        """Project, cull, fill."""
        fill, image, camera = self._cv2.fillConvexPoly, self._image, self.camera
        image[:] = 0
        placed = self._body.place(transforms)
        corners = placed[self._body.faces]
        # A face points away where the camera lies behind its plane.
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        corners = corners[np.einsum("fi,fi->f", normals, corners[:, 0]) > 0]
        seen = np.count_nonzero(corners[:, :, 2] > NEAR_M, axis=1)
        for triangle in _fixed_point(corners[seen == 3], camera):
            fill(image, triangle, 1, shift=FRACTION_BITS)
        for triangle in corners[(seen > 0) & (seen < 3)]:
            fill(image, _fixed_point(_clip(triangle), camera), 1, shift=FRACTION_BITS)
        return image.view(bool)

    def remark(self) -> str:
        """Why it disagrees."""
        return "draws boundary pixels too"


def _clip(polygon: FloatArray) -> FloatArray:
    """The part of a convex polygon ``(n, 3)`` before the near plane."""
    kept = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if a[2] > NEAR_M:
            kept.append(a)
        if (a[2] > NEAR_M) != (b[2] > NEAR_M):
            kept.append(a + (NEAR_M - a[2]) / (b[2] - a[2]) * (b - a))
    return np.array(kept)


def _fixed_point(points_cam: FloatArray, camera: Camera) -> np.ndarray:
    """``(..., 2)`` int32 pixels of ``(..., 3)`` points before the camera."""
    return np.asarray(np.rint(camera.project(points_cam) * (1 << FRACTION_BITS)), dtype=np.int32)
