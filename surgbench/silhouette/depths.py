"""Compiled: how far away the surface of closed solids is at pixels that they cover.

A rasteriser with the rules of :mod:`surgbench.silhouette.spans`: the inverse of the depth is linear in the pixel over a
plane.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from surgbench.compiled import compiled


@compiled
def place_body(b: int, pose: Any, bodies: Any, mesh: Any, lens: Any, points: Any, seen: Any) -> None:
    """Fill the vertices of body b in the camera frame, ``points (V, 3)``, and as they are seen, ``seen (V, 3)``.

    Args:
        b: Number of the body.
        pose: ``(L, 3, 4)`` T_cam_link.
        bodies: All bodies of the arm.
        mesh: Their meshes.
        lens: The camera.
        points: ``(V, 3)``, metres.
        seen: ``(V, 3)`` pixels, and inverse depth.
    """
    T = pose[bodies.link[b]]
    for v in range(bodies.vertex_first[b], bodies.vertex_last[b]):
        x, y, z = mesh.x[v], mesh.y[v], mesh.z[v]
        for k in range(3):
            points[v, k] = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3]
        _project(points[v, 0], points[v, 1], points[v, 2], lens, seen[v])


@compiled
def nearest_surface(
    points: Any, seen: Any, faces: Any, cut: bool, lens: Any, wanted: Any, box: Any, room: Any, corners: Any, depth: Any
) -> None:
    """Depth of a union of closed solids at pixels of its silhouette, in a part of the picture.

    Args:
        points: ``(V, 3)`` vertices in the camera frame, metres.
        seen: ``(V, 3)``: the same projected, and their inverse depths.
        faces: ``(F, 3)``, counter-clockwise seen from outside; at least those that reach within a pixel of the box,
            and those that the near plane cuts.
        cut: Whether some vertex lies at or before the near plane.
        lens: The camera.
        wanted: ``(H, W)`` bool; true within the box only on the silhouette.
        box: First row, row after the last, first column and column after the last.
        room: ``(H, W)`` int32, scratch.
        corners: ``(4, 3)``, scratch.
        depth: ``(H, W)``, filled within the box with metres along z where wanted, inf elsewhere.
    """
    # Front faces beyond the near plane, less back faces: below zero where the ray begins inside a solid.
    entered = room if cut else room[:0]
    for row in range(box[0], box[1]):
        depth[row, box[2] : box[3]] = 0.0  # the inverse, until the end
        if cut:
            entered[row, box[2] : box[3]] = 0
    for f in range(faces.shape[0]):
        if is_aside(points, seen, faces[f], lens, box):
            continue
        count = clip(points, faces[f], lens, corners)
        if count > 0:
            plane = _inverse_depth_plane(points, faces[f], lens)
            for k in range(2, count):
                _fill(corners, k, plane, box, entered, depth)
    for row in range(box[0], box[1]):
        for column in range(box[2], box[3]):
            if not wanted[row, column]:
                depth[row, column] = np.inf
            elif entered.size > 0 and entered[row, column] < 0:
                depth[row, column] = lens.near
            elif depth[row, column] > 0:
                depth[row, column] = 1.0 / depth[row, column]
            else:
                # By rounding the silhouette has a pixel here and the faces have none: it lies on an edge.
                depth[row, column] = _depth_of_nearest_edge(points, faces, lens, float(column), float(row), corners)


@compiled(inline="always")
def is_aside(points: Any, seen: Any, face: Any, lens: Any, box: Any) -> Any:
    """Whether a face that lies wholly beyond the near plane has no pixel in the box."""
    i, j, k = face[0], face[1], face[2]
    if not min(points[i, 2], points[j, 2], points[k, 2]) > lens.near:
        return False
    top, bottom = min(seen[i, 1], seen[j, 1], seen[k, 1]), max(seen[i, 1], seen[j, 1], seen[k, 1])
    left, right = min(seen[i, 0], seen[j, 0], seen[k, 0]), max(seen[i, 0], seen[j, 0], seen[k, 0])
    return bottom < box[0] - 1 or top > box[1] or right < box[2] - 1 or left > box[3]


@compiled(inline="always")
def _project(x: float, y: float, z: float, lens: Any, corner: Any) -> None:
    corner[0] = lens.fx * x / z + lens.cx
    corner[1] = lens.fy * y / z + lens.cy
    corner[2] = 1.0 / z


@compiled
def near_point(points: Any, i: Any, j: Any, lens: Any) -> Any:
    """Pixel where the edge between vertices i and j, which lie on both sides, meets the near plane."""
    if i > j:  # the same numbers for both faces of the edge
        i, j = j, i
    t = (lens.near - points[i, 2]) / (points[j, 2] - points[i, 2])
    x = points[i, 0] + t * (points[j, 0] - points[i, 0])
    y = points[i, 1] + t * (points[j, 1] - points[i, 1])
    return lens.fx * x / lens.near + lens.cx, lens.fy * y / lens.near + lens.cy


@compiled
def clip(points: Any, face: Any, lens: Any, corners: Any) -> int:
    """Corners ``(u, v, 1/z)`` of the part of a face beyond the near plane; returns how many: 0, 3 or 4."""
    count = 0
    for k in range(3):
        i, j = face[k], face[(k + 1) % 3]
        seen = points[i, 2] > lens.near
        if seen:
            _project(points[i, 0], points[i, 1], points[i, 2], lens, corners[count])
            count += 1
        if seen != (points[j, 2] > lens.near):
            corners[count, 0], corners[count, 1] = near_point(points, i, j, lens)
            corners[count, 2] = 1.0 / lens.near
            count += 1
    return count


@compiled
def _inverse_depth_plane(points: Any, face: Any, lens: Any) -> tuple[float, float, float]:
    """``(a, b, c)`` such that ``1/z = a u + b v + c`` on the face's plane; not finite if seen edge-on."""
    o, p, q = points[face[0]], points[face[1]], points[face[2]]
    px, py, pz = p[0] - o[0], p[1] - o[1], p[2] - o[2]
    qx, qy, qz = q[0] - o[0], q[1] - o[1], q[2] - o[2]
    nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
    offset = nx * o[0] + ny * o[1] + nz * o[2]
    a, b = nx / (lens.fx * offset), ny / (lens.fy * offset)
    return a, b, nz / offset - a * lens.cx - b * lens.cy


@compiled
def _fill(corners: Any, k: int, plane: Any, box: Any, entered: Any, depth: Any) -> None:
    """Enter the triangle of corners 0, k - 1 and k: its inverse depth if it is a front face, and the count."""
    a, b, c = 0, k - 1, k
    # Sort by row; an odd number of swaps turns the triangle over.
    turned = False
    if corners[a, 1] > corners[b, 1]:
        a, b, turned = b, a, not turned
    if corners[b, 1] > corners[c, 1]:
        b, c, turned = c, b, not turned
    if corners[a, 1] > corners[b, 1]:
        a, b, turned = b, a, not turned
    top, middle, bottom = corners[a], corners[b], corners[c]
    low, high = min(top[2], middle[2], bottom[2]), max(top[2], middle[2], bottom[2])
    long_slope = (bottom[0] - top[0]) / (bottom[1] - top[1])
    upper_slope = (middle[0] - top[0]) / (middle[1] - top[1])
    lower_slope = (bottom[0] - middle[0]) / (bottom[1] - middle[1])
    first, last = int(np.ceil(max(top[1], float(box[0])))), int(np.ceil(min(bottom[1], float(box[1]))))
    for row in range(first, last):
        long_side = top[0] + (row - top[1]) * long_slope
        short_side = middle[0] + (row - middle[1]) * lower_slope
        if row < middle[1]:
            short_side = top[0] + (row - top[1]) * upper_slope
        begin, end = _column(min(long_side, short_side), box), _column(max(long_side, short_side), box)
        # Facing as projected, so that along a ray the faces of a closed mesh turn in and out in step.
        front = (long_side > short_side) != turned
        for column in range(begin, end):
            if entered.size > 0:
                entered[row, column] += 1 if front else -1
            if front:
                w = plane[0] * column + plane[1] * row + plane[2]
                # An edge-on plane is steep or not finite, yet no point of the face lies beyond its corners.
                w = min(w, high) if w > low else low
                depth[row, column] = max(depth[row, column], w)


@compiled(inline="always")
def _column(u: float, box: Any) -> int:
    """First column at or right of u, within the box."""
    return int(np.ceil(min(max(u, float(box[2])), float(box[3]))))


@compiled
def _depth_of_nearest_edge(points: Any, faces: Any, lens: Any, u: float, v: float, corners: Any) -> float:
    """Depth of the mesh where an edge, as cut by the near plane, comes nearest to a pixel."""
    nearest, w = np.inf, 0.0
    for f in range(faces.shape[0]):
        count = clip(points, faces[f], lens, corners)
        for k in range(count):
            p, q = corners[k], corners[(k + 1) % count]
            du, dv = q[0] - p[0], q[1] - p[1]
            length = du * du + dv * dv
            t = ((u - p[0]) * du + (v - p[1]) * dv) / length if length > 0 else 0.0
            t = min(max(t, 0.0), 1.0)
            distance = (p[0] + t * du - u) ** 2 + (p[1] + t * dv - v) ** 2
            if distance < nearest:
                nearest, w = distance, p[2] + t * (q[2] - p[2])
    return 1.0 / w
