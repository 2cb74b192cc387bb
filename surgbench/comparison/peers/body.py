"""An instrument's meshes placed before the camera, for renderers that want one mesh, and the rays of a camera."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import NEAR_M, Camera
from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument


class Body:
    """All meshes of an instrument laid end to end, to be placed in the camera frame.

    Args:
        instrument: The instrument.

    Attributes:
        links: ``(B,)`` place in the chain of each link that has a mesh.
        vertices_m: ``(V, 3)`` in the frames of their links.
        vertex_link: ``(V,)`` place in the chain.
        faces: ``(F, 3)``.
    """

    def __init__(self, instrument: Instrument) -> None:
        meshes = {instrument.link_index[name]: mesh for name, mesh in instrument.meshes.items()}
        sizes = [len(mesh.vertices_m) for mesh in meshes.values()]
        self._starts = np.cumsum([0, *sizes])
        self.links = np.array(list(meshes))
        self.vertices_m: FloatArray = np.concatenate([mesh.vertices_m for mesh in meshes.values()])
        self.vertex_link = np.repeat(self.links, sizes)
        pairs = zip(meshes.values(), self._starts[:-1], strict=True)
        self.faces: NDArray[np.int32] = np.concatenate([mesh.faces + start for mesh, start in pairs]).astype(np.int32)

    def place(self, transforms: FloatArray) -> FloatArray:
        """Vertices ``(V, 3)`` in the camera frame, for ``(L, 4, 4)`` T_cam_link."""
        placed = np.empty_like(self.vertices_m)
        for link, start, end in zip(self.links, self._starts[:-1], self._starts[1:], strict=True):
            np.matmul(self.vertices_m[start:end], transforms[link, :3, :3].T, out=placed[start:end])
            placed[start:end] += transforms[link, :3, 3]
        return placed

    def window(self, placed: FloatArray, camera: Camera) -> tuple[slice, slice]:
        """Rows and columns of the image outside of which the body is not seen, for renderers that cast rays.

        Args:
            placed: ``(V, 3)`` vertices in the camera frame.
            camera: The view.
        """
        lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        left, right, top, bottom = _bounds(placed, self.faces, lens)
        # One more on either side, for rounding.
        columns = slice(max(int(left) - 1, 0), max(min(int(right) + 3, camera.width), 0))
        return slice(max(int(top) - 1, 0), max(min(int(bottom) + 3, camera.height), 0)), columns


@compiled(makes_arrays=True)
def _bounds(placed: Any, faces: Any, lens: Any) -> Any:
    """Least and largest u and v of what is seen of any face; what is seen of nothing lies left of and above the image.

    A face is cut to the pyramid of view, one plane after the other (Sutherland and Hodgman).
    """
    width, height, fx, fy, cx, cy = lens
    left, right, top, bottom = np.inf, -3.0, np.inf, -3.0
    # Inside is where n . p >= d.
    planes = np.array(
        [
            [0.0, 0.0, 1.0, NEAR_M],
            [fx, 0.0, cx + 0.5, 0.0],
            [-fx, 0.0, width - 0.5 - cx, 0.0],
            [0.0, fy, cy + 0.5, 0.0],
            [0.0, -fy, height - 0.5 - cy, 0.0],
        ]
    )
    polygon, other = np.empty((8, 3)), np.empty((8, 3))
    for f in range(len(faces)):
        count = 3
        for k in range(3):
            polygon[k] = placed[faces[f, k]]
        for n0, n1, n2, d in planes:
            kept = 0
            for k in range(count):
                a, b = polygon[k], polygon[(k + 1) % count]
                from_a = n0 * a[0] + n1 * a[1] + n2 * a[2] - d
                from_b = n0 * b[0] + n1 * b[1] + n2 * b[2] - d
                if from_a >= 0.0:
                    other[kept] = a
                    kept += 1
                if (from_a >= 0.0) != (from_b >= 0.0):
                    t = from_a / (from_a - from_b)
                    for i in range(3):
                        other[kept, i] = a[i] + t * (b[i] - a[i])
                    kept += 1
            count = kept
            polygon, other = other, polygon
            if count == 0:
                break
        for k in range(count):
            u = fx * polygon[k, 0] / polygon[k, 2] + cx
            v = fy * polygon[k, 1] / polygon[k, 2] + cy
            left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
    return min(left, width), right, min(top, height), bottom


def pixel_rays(camera: Camera) -> NDArray[np.float32]:
    """Directions through the pixel centres, ``(H, W, 3)``, with z = 1."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    return np.ascontiguousarray(rays, dtype=np.float32)
