"""Compiled: triangles as a pinhole camera sees them, by inverse depth, which is linear in the pixel over a plane.

A pixel sees what a ray through its centre meets first. It is as bright as that reflects under light from all sides
alike, and dark where something covers the surface along its normal.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.viewpoint.optics.rays import blocked
from surgbench.viewpoint.optics.triangles import Triangles

# Of a surface: nothing covers it along its normal anywhere, everywhere, or in places.
FREE, COVERED, MIXED = 0, 1, 2
# Where on a triangle that is looked at: barycentric places, a little inside.
_INSIDE = np.array([
    (a, b, 1.0 - a - b) for a in np.linspace(0.02, 0.96, 5) for b in np.linspace(0.02, 0.96, 5) if a + b <= 0.985
])  # fmt: skip
# Rays along a normal begin so far from their surface: what lies on it, as tags do, does not darken what is beside it.
_OFF_M = 2e-4


@compiled(makes_arrays=True)
def find_covered(triangles: Triangles, places: FloatArray, covered: Any) -> None:
    """What covers each triangle along its normal: ``covered (F,)`` is filled with ``FREE``, ``COVERED`` or ``MIXED``.

    Args:
        triangles: The object.
        places: ``(n, 3)`` barycentric places that are tried.
        covered: ``(F,)`` int8.
    """
    origin = np.empty(3)
    for face in range(len(covered)):
        count = 0
        for place in places:
            for k in range(3):
                origin[k] = _OFF_M * triangles.normal[face, k]
                for corner in range(3):
                    origin[k] += place[corner] * triangles.corners[face, corner, k]
            if blocked(origin, triangles.normal[face], 0.0, 1.0, triangles):
                count += 1
        covered[face] = FREE if count == 0 else (COVERED if count == len(places) else MIXED)


def coverage(triangles: Triangles) -> Any:
    """``(F,)`` int8: ``FREE``, ``COVERED`` or ``MIXED``."""
    covered = np.empty(len(triangles.corners), dtype=np.int8)
    find_covered(triangles, _INSIDE, covered)
    return covered


@compiled
def clip(
    triangle: FloatArray, T_cam_object: FloatArray, near_m: float, polygon: FloatArray, scratch: FloatArray
) -> int:
    """The part of a triangle beyond the near plane.

    Args:
        triangle: ``(3, 3)`` corners in the object's frame.
        T_cam_object: ``(4, 4)``.
        near_m: Distance of that plane.
        polygon: ``(4, 3)``, filled with its corners in the camera's frame.
        scratch: ``(3, 3)``.

    Returns:
        How many corners it has.
    """
    for corner in range(3):
        for k in range(3):
            value = T_cam_object[k, 3]
            for j in range(3):
                value += T_cam_object[k, j] * triangle[corner, j]
            scratch[corner, k] = value
    count = 0
    for corner in range(3):
        after = (corner + 1) % 3
        here, there = scratch[corner, 2] - near_m, scratch[after, 2] - near_m
        if here >= 0.0:
            for k in range(3):
                polygon[count, k] = scratch[corner, k]
            count += 1
        if (here < 0.0) != (there < 0.0):
            share = here / (here - there)
            for k in range(3):
                polygon[count, k] = scratch[corner, k] + share * (scratch[after, k] - scratch[corner, k])
            count += 1
    return count


@compiled(makes_arrays=True)
def find_extent(
    triangles: Triangles, T_cam_object: FloatArray, intrinsics: FloatArray, near_m: float, extent: FloatArray
) -> None:
    """Within which pixels an object is seen: ``extent (2, 2)`` is filled with the lowest and highest u and v.

    Args:
        triangles: The object.
        T_cam_object: ``(4, 4)``.
        intrinsics: ``(4,)`` fx, fy, cx, cy.
        near_m: Nearer surfaces are not seen.
        extent: Its first row is above the second where nothing is seen.
    """
    polygon, scratch = np.empty((4, 3)), np.empty((3, 3))
    extent[0], extent[1] = np.inf, -np.inf
    for face in range(triangles.corners.shape[0]):
        for corner in range(clip(triangles.corners[face], T_cam_object, near_m, polygon, scratch)):
            for k in range(2):
                pixel = intrinsics[k] * polygon[corner, k] / polygon[corner, 2] + intrinsics[2 + k]
                extent[0, k], extent[1, k] = min(extent[0, k], pixel), max(extent[1, k], pixel)


@compiled(makes_arrays=True)
def find_nearest(
    triangles: Triangles,
    T_cam_object: FloatArray,
    intrinsics: FloatArray,
    near_m: float,
    corner_px: Any,
    inverse: FloatArray,
    face_of: Any,
) -> None:
    """Which triangle is nearest in each pixel of a part of the picture.

    Args:
        triangles: The object.
        T_cam_object: ``(4, 4)``.
        intrinsics: ``(4,)``.
        near_m: Nearer surfaces are not seen.
        corner_px: ``(2,)`` column and row of the part's first pixel.
        inverse: ``(rows, columns)`` zeros, filled with inverse depths.
        face_of: ``(rows, columns)`` of -1, filled with numbers of triangles.
    """
    polygon, scratch = np.empty((4, 3)), np.empty((3, 3))
    u, v = np.empty(4), np.empty(4)
    rows, columns = inverse.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2] - corner_px[0], intrinsics[3] - corner_px[1]
    for face in range(triangles.corners.shape[0]):
        count = clip(triangles.corners[face], T_cam_object, near_m, polygon, scratch)
        if count < 3:
            continue
        # The plane n . p = d has the inverse depth n . (x, y, 1) / d.
        nx = ny = nz = distance = 0.0
        for k in range(3):
            normal = 0.0
            for j in range(3):
                normal += T_cam_object[k, j] * triangles.normal[face, j]
            distance += normal * scratch[0, k]
            if k == 0:
                nx = normal
            elif k == 1:
                ny = normal
            else:
                nz = normal
        if distance == 0.0:
            continue  # seen from its edge
        slope_u, slope_v = nx / (fx * distance), ny / (fy * distance)
        constant = nz / distance - slope_u * cx - slope_v * cy
        for corner in range(count):
            u[corner] = fx * polygon[corner, 0] / polygon[corner, 2] + cx
            v[corner] = fy * polygon[corner, 1] / polygon[corner, 2] + cy
        lowest, highest = v[:count].min(), v[:count].max()
        for row in range(max(0, int(np.ceil(lowest))), min(rows - 1, int(np.floor(highest))) + 1):
            left, right = np.inf, -np.inf
            for corner in range(count):
                after = (corner + 1) % count
                low, high = v[corner], v[after]
                if (row < low and row < high) or (row > low and row > high):
                    continue
                if low == high:
                    left, right = min(left, u[corner], u[after]), max(right, u[corner], u[after])
                else:
                    crossing = u[corner] + (row - low) / (high - low) * (u[after] - u[corner])
                    left, right = min(left, crossing), max(right, crossing)
            for column in range(max(0, int(np.ceil(max(left, -1.0)))), int(np.floor(min(right, columns - 1.0))) + 1):
                found = slope_u * column + slope_v * row + constant
                if found > inverse[row, column]:
                    inverse[row, column] = found
                    face_of[row, column] = face


@compiled(makes_arrays=True)
def shade(
    triangles: Triangles,
    covered: Any,
    T_cam_object: FloatArray,
    intrinsics: FloatArray,
    corner_px: Any,
    inverse: FloatArray,
    face_of: Any,
    grey: Any,
) -> None:
    """How bright the pixels of a part of the picture are, where something is seen.

    Args:
        triangles: The object.
        covered: From :func:`coverage`.
        T_cam_object: ``(4, 4)``.
        intrinsics: ``(4,)``.
        corner_px: ``(2,)`` column and row of the part's first pixel.
        inverse: From :func:`find_nearest`.
        face_of: Likewise.
        grey: ``(rows, columns)`` float32, filled there, 0 to 1.
    """
    point, spot, ahead = np.empty(3), np.empty(3), np.empty(3)
    for row in range(grey.shape[0]):
        for column in range(grey.shape[1]):
            face = face_of[row, column]
            if face < 0:
                continue
            part = triangles.part[face]
            panel = triangles.panel[part]
            if panel < 0 and covered[face] == FREE:
                grey[row, column] = triangles.reflectance[part]
                continue
            depth = 1.0 / inverse[row, column]
            x = (column + corner_px[0] - intrinsics[2]) / intrinsics[0] * depth - T_cam_object[0, 3]
            y = (row + corner_px[1] - intrinsics[3]) / intrinsics[1] * depth - T_cam_object[1, 3]
            z = depth - T_cam_object[2, 3]
            facing = 0.0
            for k in range(3):
                point[k] = T_cam_object[0, k] * x + T_cam_object[1, k] * y + T_cam_object[2, k] * z
                eye = -(
                    T_cam_object[0, k] * T_cam_object[0, 3]
                    + T_cam_object[1, k] * T_cam_object[1, 3]
                    + T_cam_object[2, k] * T_cam_object[2, 3]
                )
                facing += triangles.normal[face, k] * (eye - point[k])
            side = 1.0 if facing >= 0.0 else -1.0
            if covered[face] == COVERED and side > 0.0:
                grey[row, column] = 0.0
                continue
            if covered[face] != FREE or side < 0.0:
                for k in range(3):
                    ahead[k] = side * triangles.normal[face, k]
                    spot[k] = point[k] + _OFF_M * ahead[k]
                if blocked(spot, ahead, 0.0, 1.0, triangles):
                    grey[row, column] = 0.0
                    continue
            if panel < 0:
                grey[row, column] = triangles.reflectance[part]
                continue
            T = triangles.T_panel_object[panel]
            across = T[0, 0] * point[0] + T[0, 1] * point[1] + T[0, 2] * point[2] + T[0, 3]
            up = T[1, 0] * point[0] + T[1, 1] * point[1] + T[1, 2] * point[2] + T[1, 3]
            rows, columns = triangles.cells[panel, 0], triangles.cells[panel, 1]
            i = int(np.floor((0.5 - up / triangles.size[panel, 1]) * rows))
            j = int(np.floor((0.5 + across / triangles.size[panel, 0]) * columns))
            grey[row, column] = triangles.texture[panel, min(max(i, 0), rows - 1), min(max(j, 0), columns - 1)]
