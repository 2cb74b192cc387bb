"""Compiled: whether something stands in a ray's way.

Triangles as in Moeller and Trumbore (1997), of those pieces of parts alone whose boxes the ray meets.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.viewpoint.optics.triangles import Triangles


@compiled
def blocked(origin: FloatArray, way: FloatArray, near: float, far: float, triangles: Triangles) -> bool:
    """Whether a ray meets any triangle, from either side.

    Args:
        origin: ``(3,)``.
        way: ``(3,)``, of any length.
        near: Where the ray begins, in lengths of ``way``.
        far: Where it ends.
        triangles: In the same frame.
    """
    for part in range(triangles.box.shape[0]):
        if not _passes(origin, way, near, far, triangles.box[part]):
            continue
        for piece in range(triangles.piece_of[part], triangles.piece_of[part + 1]):
            if not _passes(origin, way, near, far, triangles.piece_box[piece]):
                continue
            for face in range(triangles.piece_first[piece], triangles.piece_first[piece + 1]):
                if _meets(origin, way, near, far, triangles.corners[face]):
                    return True
    return False


@compiled
def _passes(origin: FloatArray, way: FloatArray, near: float, far: float, box: FloatArray) -> bool:
    """Whether a ray meets a box ``(2, 3)``."""
    for k in range(3):
        low, high = box[0, k] - origin[k], box[1, k] - origin[k]
        if way[k] == 0.0:
            if low > 0.0 or high < 0.0:
                return False
        elif way[k] > 0.0:
            near, far = max(near, low / way[k]), min(far, high / way[k])
        else:
            near, far = max(near, high / way[k]), min(far, low / way[k])
    return near <= far


@compiled
def _meets(origin: FloatArray, way: FloatArray, near: float, far: float, corners: FloatArray) -> bool:
    ax, ay, az = corners[0, 0], corners[0, 1], corners[0, 2]
    ux, uy, uz = corners[1, 0] - ax, corners[1, 1] - ay, corners[1, 2] - az
    vx, vy, vz = corners[2, 0] - ax, corners[2, 1] - ay, corners[2, 2] - az
    px, py, pz = way[1] * vz - way[2] * vy, way[2] * vx - way[0] * vz, way[0] * vy - way[1] * vx
    volume = ux * px + uy * py + uz * pz
    if volume == 0.0:
        return False
    sx, sy, sz = origin[0] - ax, origin[1] - ay, origin[2] - az
    u = (sx * px + sy * py + sz * pz) / volume
    if not 0.0 <= u <= 1.0:
        return False
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    v = (way[0] * qx + way[1] * qy + way[2] * qz) / volume
    if v < 0.0 or u + v > 1.0:
        return False
    along = (vx * qx + vy * qy + vz * qz) / volume
    return bool(near <= along <= far)


@compiled(makes_arrays=True)
def mark_free(origins: FloatArray, targets: FloatArray, short_m: float, triangles: Triangles, free: Any) -> None:
    """Which targets are seen from which origins.

    Args:
        origins: ``(n, 3)``.
        targets: ``(m, 3)``.
        short_m: The rays end so far before their targets.
        triangles: In the same frame.
        free: ``(n, m)`` bool, filled.
    """
    way = np.empty(3)
    for i in range(origins.shape[0]):
        for j in range(targets.shape[0]):
            length = 0.0
            for k in range(3):
                way[k] = targets[j, k] - origins[i, k]
                length += way[k] ** 2
            length = np.sqrt(length)
            free[i, j] = length <= short_m or not blocked(origins[i], way, 0.0, 1.0 - short_m / length, triangles)
