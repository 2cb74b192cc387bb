"""Compiled: between which depths the surface of an arm lies, tile by tile, before anything is drawn."""

from __future__ import annotations

from typing import Any

import numpy as np

from surgbench.compiled import compiled
from surgbench.silhouette.depths import clip, near_point, place_body

# Sides of the tiles.
TILE_PX = 32
# Of a facet whose plane passes the camera this near nothing is made of the plane: it is seen edge-on. Of all others the
# plane, from which its triangles may be COPLANAR_M off, is good to a share of 1e-5 of the depth.
EDGE_ON_M = 1e-7


@compiled
def bound_nearness(
    arm: Any, lens: Any, box: Any, contour: Any, points: Any, seen: Any, corners: Any, bounds: Any
) -> None:
    """Between which inverse depths the nearest surface lies at the pixels of each tile of a box that an arm covers.

    Of each front face that reaches into a tile it is the range of its facet's plane there, within that of its corners.

    Args:
        arm: Links, bodies and mesh.
        lens: The camera.
        box: First row, row after the last, first column and column after the last.
        contour: Of the arm's state, as :func:`surgbench.silhouette.contour.trace` leaves it.
        points: ``(V, 3)``, scratch.
        seen: ``(V, 3)``, scratch.
        corners: ``(4, 3)``, scratch.
        bounds: ``(rows, columns, 2)``, filled for each tile of the box, which begin at its first row and column: the
            least and the greatest; 0 and inf where the near plane cuts the arm.
    """
    bodies, mesh = arm.bodies, arm.mesh
    for row in range(bounds.shape[0]):
        for column in range(bounds.shape[1]):
            bounds[row, column, 0], bounds[row, column, 1] = np.inf, 0.0
    # Where the near plane cuts it.
    top, bottom, left, right = np.inf, -np.inf, np.inf, -np.inf
    for n in range(bodies.link.shape[0]):
        first, last = bodies.vertex_first[n], bodies.vertex_last[n]
        cut, aside = reach(contour.u[first:last], contour.v[first:last], contour.depth[first:last], lens, box)
        if aside and not cut:
            continue
        pose = contour.pose[bodies.link[n]]
        if cut:
            place_body(n, contour.pose, bodies, mesh, lens, points, seen)
            for e in range(bodies.edge_start[n], bodies.edge_start[n + 1]):
                i, j = mesh.edge_start[e], mesh.edge_end[e]
                if (points[i, 2] > lens.near) != (points[j, 2] > lens.near):
                    u, v = near_point(points, i, j, lens)
                    top, bottom = min(top, v), max(bottom, v)
                    left, right = min(left, u), max(right, u)
        facet, known, facing, a, b, c = np.int64(-1), False, False, 0.0, 0.0, 0.0
        for f in range(bodies.face_start[n], bodies.face_start[n + 1]):
            if mesh.face_facet[f] != facet:
                facet = np.int64(mesh.face_facet[f])
                known, facing, a, b, c = _plane(facet, pose, mesh, lens)
            if known and not facing:
                continue
            i, j, k = mesh.faces[f, 0], mesh.faces[f, 1], mesh.faces[f, 2]
            whole = not cut or min(points[i, 2], points[j, 2], points[k, 2]) > lens.near
            count = 3 if whole else clip(points, mesh.faces[f], lens, corners)
            if count == 0:
                continue
            if whole:
                u0, u1, u2 = contour.u[i], contour.u[j], contour.u[k]
                v0, v1, v2 = contour.v[i], contour.v[j], contour.v[k]
                if max(v0, v1, v2) < box[0] - 1 or min(v0, v1, v2) > box[1]:
                    continue
                if max(u0, u1, u2) < box[2] - 1 or min(u0, u1, u2) > box[3]:
                    continue
                corners[0, 0], corners[0, 1], corners[0, 2] = u0, v0, 1.0 / contour.depth[i]
                corners[1, 0], corners[1, 1], corners[1, 2] = u1, v1, 1.0 / contour.depth[j]
                corners[2, 0], corners[2, 1], corners[2, 2] = u2, v2, 1.0 / contour.depth[k]
            _enter(corners, count, a, b, c, box, bounds)
    for row in range(bounds.shape[0]):
        for column in range(bounds.shape[1]):
            v, u = box[0] + row * TILE_PX, box[2] + column * TILE_PX
            if not (bottom < v - 1 or top > v + TILE_PX or right < u - 1 or left > u + TILE_PX):
                bounds[row, column, 0], bounds[row, column, 1] = 0.0, np.inf


@compiled
def reach(u: Any, v: Any, depth: Any, lens: Any, box: Any) -> Any:
    """Of a body's vertices: whether some lie at or before the near plane, and whether all lie aside of the box."""
    hidden = 0
    below, above, right, left = 0, 0, 0, 0
    for i in range(u.shape[0]):
        hidden += not depth[i] > lens.near
        below += v[i] > box[1]
        above += v[i] < box[0] - 1
        right += u[i] > box[3]
        left += u[i] < box[2] - 1
    return hidden > 0, max(below, above, right, left) == u.shape[0]


@compiled(inline="always")
def _plane(f: Any, pose: Any, mesh: Any, lens: Any) -> Any:
    """Whether a facet is not seen edge-on, whether it faces the camera, and ``a, b, c`` of ``1/z = a u + b v + c``."""
    nx, ny, nz = mesh.nx[f], mesh.ny[f], mesh.nz[f]
    x = pose[0, 0] * nx + pose[0, 1] * ny + pose[0, 2] * nz
    y = pose[1, 0] * nx + pose[1, 1] * ny + pose[1, 2] * nz
    z = pose[2, 0] * nx + pose[2, 1] * ny + pose[2, 2] * nz
    # n . p = offset in the link's frame is this in the camera's; below zero where the camera is before it.
    offset = mesh.offset[f] + x * pose[0, 3] + y * pose[1, 3] + z * pose[2, 3]
    if not offset * offset > EDGE_ON_M * EDGE_ON_M * (nx * nx + ny * ny + nz * nz):
        return False, False, np.nan, 0.0, 0.0
    if offset > 0:
        return True, False, np.nan, 0.0, 0.0
    a, b = x / (lens.fx * offset), y / (lens.fy * offset)
    return True, True, a, b, z / offset - a * lens.cx - b * lens.cy


@compiled
def _enter(corners: Any, count: int, a: float, b: float, c: float, box: Any, bounds: Any) -> None:
    """Widen the bounds of the tiles that a face with the plane ``1/z = a u + b v + c`` may reach into.

    Where a is NaN nothing is known of the plane.
    """
    low, high = corners[0, 2], corners[0, 2]
    top, bottom, left, right = corners[0, 1], corners[0, 1], corners[0, 0], corners[0, 0]
    for n in range(1, count):
        low, high = min(low, corners[n, 2]), max(high, corners[n, 2])
        top, bottom = min(top, corners[n, 1]), max(bottom, corners[n, 1])
        left, right = min(left, corners[n, 0]), max(right, corners[n, 0])
    for row in range(bounds.shape[0]):
        v = box[0] + row * TILE_PX
        if bottom < v - 1 or top > v + TILE_PX:
            continue
        for column in range(bounds.shape[1]):
            u = box[2] + column * TILE_PX
            if right < u - 1 or left > u + TILE_PX:
                continue
            # Over what of the tile the face may cover.
            u0, u1 = max(float(u), left - 1.0), min(float(u + TILE_PX), right + 1.0)
            v0, v1 = max(float(v), top - 1.0), min(float(v + TILE_PX), bottom + 1.0)
            w, across, down = a * u0 + b * v0 + c, a * (u1 - u0), b * (v1 - v0)
            first, last = w + min(across, 0.0) + min(down, 0.0), w + max(across, 0.0) + max(down, 0.0)
            least, greatest = low, high
            if a == a:
                least, greatest = max(low, first), min(high, last)
            if least <= greatest:  # else its plane has these depths elsewhere
                bounds[row, column, 0] = min(bounds[row, column, 0], least)
                bounds[row, column, 1] = max(bounds[row, column, 1], greatest)
