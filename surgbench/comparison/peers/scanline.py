"""A plain scan-line rasteriser in numba: what one writes without a library.

Back faces are cut at the near plane, projected, and filled into an image row by row. It shares no code with the
engine, so that it also checks it.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from surgbench.camera import NEAR_M, Camera
from surgbench.comparison.peers.base import Peer
from surgbench.comparison.peers.body import Body
from surgbench.compiled import compiled
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument


@compiled(makes_arrays=True)
def _fill(
    transforms: Any, vertices: Any, link: Any, faces: Any, lens: Any, placed: Any, low: Any, high: Any, image: Any
) -> None:
    fx, fy, cx, cy, near = lens
    height, width = image.shape
    image[:] = False
    for i in range(len(vertices)):
        T = transforms[link[i]]
        for k in range(3):
            placed[i, k] = T[k, 0] * vertices[i, 0] + T[k, 1] * vertices[i, 1] + T[k, 2] * vertices[i, 2] + T[k, 3]
    u, v = np.empty(4), np.empty(4)
    for f in range(len(faces)):
        n = 0
        for k in range(3):
            a, b = placed[faces[f, k]], placed[faces[f, (k + 1) % 3]]
            if a[2] > near:
                u[n], v[n] = fx * a[0] / a[2] + cx, fy * a[1] / a[2] + cy
                n += 1
            if (a[2] > near) != (b[2] > near):
                t = (near - a[2]) / (b[2] - a[2])
                u[n] = fx * (a[0] + t * (b[0] - a[0])) / near + cx
                v[n] = fy * (a[1] + t * (b[1] - a[1])) / near + cy
                n += 1
        if n < 3:
            continue
        area = (u[1] - u[0]) * (v[2] - v[0]) - (u[2] - u[0]) * (v[1] - v[0])
        if n == 4:
            area += (u[2] - u[0]) * (v[3] - v[0]) - (u[3] - u[0]) * (v[2] - v[0])
        if area <= 0.0:  # it faces the camera: v points down
            continue
        first, last = height, 0
        for k in range(n):
            first = min(first, int(np.ceil(min(max(v[k], 0.0), height))))
            last = max(last, int(np.ceil(min(max(v[k], 0.0), height))))
        low[first:last] = width
        high[first:last] = 0
        for k in range(n):
            u0, v0, u1, v1 = u[k], v[k], u[(k + 1) % n], v[(k + 1) % n]
            if v0 > v1:
                u0, v0, u1, v1 = u1, v1, u0, v0
            slope = (u1 - u0) / (v1 - v0)
            begin, end = int(np.ceil(min(max(v0, 0.0), height))), int(np.ceil(min(max(v1, 0.0), height)))
            for row in range(begin, end):
                column = int(np.ceil(min(max(u0 + (row - v0) * slope, 0.0), width)))
                low[row] = min(low[row], column)
                high[row] = max(high[row], column)
        for row in range(first, last):
            for column in range(low[row], high[row]):
                image[row, column] = True


class Scanline(Peer):
    """Fills triangles row by row, then counts."""

    name: ClassVar[str] = "scanline"
    module: ClassVar[str] = "numba"
    third_party: ClassVar[bool] = False

    def prepare(self, instrument: Instrument, camera: Camera) -> None:
        """Lay the meshes end to end."""
        super().prepare(instrument, camera)
        self._body = Body(instrument)
        self._lens = (camera.fx, camera.fy, camera.cx, camera.cy, NEAR_M)
        self._placed = np.empty_like(self._body.vertices_m)
        self._low, self._high = np.empty((2, camera.height), np.int64)
        self._image = np.empty((camera.height, camera.width), dtype=bool)

    def draw(self, transforms: FloatArray) -> Mask:
        """Fill the back faces."""
        body = self._body
        _fill(
            transforms, body.vertices_m, body.vertex_link, body.faces, self._lens,
            self._placed, self._low, self._high, self._image,
        )  # fmt: skip
        return self._image

    def remark(self) -> str:
        """What it is."""
        return "plain numba, of our own"
