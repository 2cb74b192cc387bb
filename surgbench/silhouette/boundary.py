"""Compiled: where the visible contour crosses rows and columns, and how those crossings move with the state.

The number of covered pixels is piecewise constant. Its gradient is that of the area integral behind it: the line
integral, along the visible contour, of the integrand times the contour's normal velocity. The contour is sampled where
it crosses pixel rows if it is steep, and where it crosses pixel columns if it is flat, so that each sample stands for
at most sqrt(2) pixels of it, in horizontal and vertical shafts alike.

An edge's crossing with a row moves as the material point under it moves across the edge. So each sample is a force in
the image, pulled back through the projection to a force on that point of the link, and the sum over a link to a wrench
(force and moment about the camera); from the wrenches the principle of virtual work gives the derivative with respect
to every joint, rotation and translation, as in inverse dynamics.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.silhouette.contour import edge_ends
from surgbench.silhouette.layout import Bodies, Indices, Lens, Links, Mesh
from surgbench.silhouette.spans import Rows, cover, crossing, rows_scratch
from surgbench.state import STATE_SIZE

# Edges of at most so many columns a row are sampled by rows, the others by columns.
STEEP = 1.0
# An edge of exactly that slope is sampled by rows alone.
FLAT = float(np.nextafter(1.0 / STEEP, 0.0))

# So many edges in a row that cross no line are found by following the contour.
SHORT_CHAIN = 4

# Spans nearer to each other than this touch, but for rounding.
TOUCHING_PX = 1e-9

# Spans of a line are sorted by packed keys.
PLACE_BITS = 16
SPAN_BITS = 16
SPAN_MASK = (1 << SPAN_BITS) - 1
FARTHEST_PX = float(1 << 30)


class Boundary(NamedTuple):
    """Scratch, and after :func:`find_boundary` the crossings of one state's visible contour."""

    rows: Rows
    columns: Rows
    edge: Indices  # (K,) number of the contour edge; crossings of rows come first, then those of columns
    line: Indices  # (K,) the row or column crossed
    at: FloatArray  # (K,) where in it, pixels
    length: FloatArray  # (C,) lines that each edge's visible samples stand for, ...
    moment: FloatArray  # ... and the sum of their places
    mask_length: FloatArray  # the same inside the reference mask
    mask_moment: FloatArray
    lowest: NDArray[np.int32]  # (C,) first and last line where an edge is visible
    highest: NDArray[np.int32]
    visible: NDArray[np.bool_]  # (V,) whether the contour is visible at a vertex
    wrench: FloatArray  # (2, L, 6) force and moment on each link, of the area and of the overlap
    maps: FloatArray  # (L, 9, 6) what they do to the state


def boundary_scratch(links: Links, bodies: Bodies, mesh: Mesh, lens: Lens, layers: int | None = None) -> Boundary:
    """Room for the visible contour of any state with fewer than ``layers`` spans in a line."""
    rows = rows_scratch(bodies, mesh, lens.height, layers)
    room = len(rows.merged)
    most = 2 * room * (lens.width + lens.height)
    edge, line = np.empty((2, most), np.uint32)
    length, moment, mask_length, mask_moment = np.empty((4, len(rows.u)))
    lowest, highest = np.empty((2, len(rows.u)), np.int32)
    return Boundary(
        rows=rows,
        columns=rows_scratch(bodies, mesh, lens.width, layers),
        edge=edge, line=line, at=np.empty(most),
        length=length, moment=moment, mask_length=mask_length, mask_moment=mask_moment,
        lowest=lowest, highest=highest,
        visible=np.zeros(len(mesh.x), bool),
        wrench=np.zeros((2, len(links.parent), 6)),
        maps=np.zeros((len(links.parent), STATE_SIZE, 6)),
    )  # fmt: skip


@compiled(inline="always")
def _sort_line(line: int, lines: int, rows: Any) -> Any:
    """Keys of a line's spans in ``rows.merged``, by where they begin; returns how many.

    A key is that place in units of 2^-PLACE_BITS pixels, and the number of the span.
    """
    merged = rows.merged
    count = 0
    for place in range(line, rows.slot[line] // 2, lines):
        start = min(max(crossing(rows.columns[2 * place + 1], line, rows), -FARTHEST_PX), FARTHEST_PX)
        key = (np.int64(start * (1 << PLACE_BITS)) << SPAN_BITS) | count
        m = count
        while m > 0 and merged[m - 1] > key:
            merged[m] = merged[m - 1]
            m -= 1
        merged[m] = key
        count += 1
    return count


@compiled(inline="always")
def _keep(n: Any, line: int, far: float, steep: float, mesh_edges: int, found: int, rows: Any, boundary: Any) -> Any:
    """Keep the crossing of edge n with a line, if it lies in the image and the edge is steep enough."""
    if abs(rows.slope[n]) > steep or n >= mesh_edges:
        return found
    at = crossing(n, line, rows)
    if not (at >= -0.5 and at < far):
        return found
    boundary.edge[found], boundary.line[found], boundary.at[found] = n, line, at
    return found + 1


@compiled
def _sweep(
    top: int, bottom: int, length: int, lines: int, spacing: int, steep: float, mesh_edges: int, found: int,
    rows: Any, boundary: Any,
) -> Any:  # fmt: skip
    """Keep the visible crossings of the lines that are filled, and clear them.

    Args:
        top: First line filled.
        bottom: The line after the last.
        length: Pixels in a line.
        lines: Number of lines in the image.
        spacing: Keep crossings of every so many lines.
        steep: Crossings of edges with a slope above this are left out.
        mesh_edges: Contour edges from this number on close the outline at the near plane: they do not move.
        found: Crossings kept before.
        rows: The lines.
        boundary: Filled with the crossings.

    Returns:
        The number of crossings kept, and the layers that were needed.
    """
    merged = rows.merged
    far = length - 0.5
    furthest = np.int64(0)
    for line in range(top, bottom):
        stop = np.int64(rows.slot[line])
        furthest = max(furthest, stop)
        if spacing > 1 and line % spacing != 0:
            rows.slot[line] = 2 * line
            continue
        if stop == 2 * (lines + line):  # one span, as along a shaft
            found = _keep(rows.columns[2 * line + 1], line, far, steep, mesh_edges, found, rows, boundary)
            found = _keep(rows.columns[2 * line], line, far, steep, mesh_edges, found, rows, boundary)
        elif stop > 2 * line:
            count = _sort_line(line, lines, rows)
            first, last, end = np.uint32(0), np.uint32(0), -np.inf
            for m in range(count):
                place = 2 * ((merged[m] & SPAN_MASK) * lines + line)
                next_first, next_last = rows.columns[place + 1], rows.columns[place]
                next_end = crossing(next_last, line, rows)
                if crossing(next_first, line, rows) > end + TOUCHING_PX:
                    if m > 0:
                        found = _keep(first, line, far, steep, mesh_edges, found, rows, boundary)
                        found = _keep(last, line, far, steep, mesh_edges, found, rows, boundary)
                    first, last, end = next_first, next_last, next_end
                elif next_end > end:
                    last, end = next_last, next_end
            found = _keep(first, line, far, steep, mesh_edges, found, rows, boundary)
            found = _keep(last, line, far, steep, mesh_edges, found, rows, boundary)
        rows.slot[line] = 2 * line
    return found, furthest // (2 * lines)


@compiled
def find_row_crossings(edges: int, bodies: Any, lens: Any, contour: Any, boundary: Any) -> Any:
    """Where the visible contour, steep or flat, crosses pixel rows; returns their number and the layers needed."""
    mesh_edges = contour.start[bodies.link.shape[0]]
    a, z = cover(edges, bodies, contour, boundary.rows, lens.width, lens.height, False, True)
    return _sweep(a, z, lens.width, lens.height, 1, np.inf, mesh_edges, 0, boundary.rows, boundary)


@compiled
def find_boundary(edges: int, spacing: int, bodies: Any, lens: Any, contour: Any, boundary: Any) -> Any:
    """Sample the visible contour of a traced state: steep edges by every so many rows, flat ones by columns.

    Returns:
        The number of crossings with rows, and with rows and columns; and the layers that were needed. If there was no
        room for them, crossings are missing.
    """
    width, height = lens.width, lens.height
    mesh_edges = contour.start[bodies.link.shape[0]]
    a, z = cover(edges, bodies, contour, boundary.rows, width, height, False, True)
    row_found, row_layers = _sweep(a, z, width, height, spacing, STEEP, mesh_edges, 0, boundary.rows, boundary)
    a, z = cover(edges, bodies, contour, boundary.columns, width, height, True, True)
    found, layers = _sweep(a, z, height, width, spacing, FLAT, mesh_edges, row_found, boundary.columns, boundary)
    return row_found, found, max(row_layers, layers)


@compiled(inline="always")
def _pixel(u: float, v: float, mask: Any) -> Any:
    """1 where the pixel around a place is in the mask, else 0; places beyond the border count as the border."""
    row = min(max(int(np.floor(v + 0.5)), 0), mask.shape[0] - 1)
    col = min(max(int(np.floor(u + 0.5)), 0), mask.shape[1] - 1)
    return 1.0 if mask[row, col] else 0.0


@compiled
def _sum_samples(first: int, last: int, across: bool, mask: Any, rows: Any, boundary: Any) -> Any:
    """Add the crossings of rows, or of columns, up by edge.

    From half a line before to half a line after, an edge lies over one pixel or two: each counts by its share.
    """
    limit = mask.shape[0] if across else mask.shape[1]
    for k in range(first, last):
        n, line = boundary.edge[k], boundary.line[k]
        at, half = boundary.at[k] + 0.5, 0.5 * abs(rows.slope[n])
        low, high = at - half, at + half
        a, b = max(np.int64(low), 0), min(np.int64(high), limit - 1)
        inside = 1.0 if (mask[a, line] if across else mask[line, a]) else 0.0
        if a != b:
            other = 1.0 if (mask[b, line] if across else mask[line, b]) else 0.0
            inside += (other - inside) * (high - b) / (high - low)
        boundary.length[n] += 1.0
        boundary.moment[n] += line
        boundary.mask_length[n] += inside
        boundary.mask_moment[n] += inside * line
        boundary.lowest[n] = min(boundary.lowest[n], np.int32(line))
        boundary.highest[n] = max(boundary.highest[n], np.int32(line))


@compiled(inline="always")
def _add_end(n: int, length: float, at: float, u: float, v: float, mask: Any, boundary: Any) -> Any:
    inside = _pixel(u, v, mask)
    boundary.length[n] += length
    boundary.moment[n] += length * at
    boundary.mask_length[n] += inside * length
    boundary.mask_moment[n] += inside * length * at


@compiled(inline="always")
def _within(u: float, v: float, lens: Any) -> Any:
    return (u >= -0.5) & (u < lens.width - 0.5) & (v >= -0.5) & (v < lens.height - 0.5)


@compiled
def _mend_ends(mesh_edges: int, mesh: Any, lens: Any, contour: Any, mask: Any, boundary: Any) -> Any:
    """Let each edge's samples stand for its whole length.

    Samples stand for a line each, from half a line before to half a line after. Where the edge is visible up to its
    end, that is up to half a line too much or too little. Edges that cross no line at all count where their neighbours
    are visible.
    """
    visible = boundary.visible
    visible[:] = False
    for n in range(mesh_edges):
        if boundary.length[n] == 0.0:
            continue
        u0, v0, u1, v1 = contour.u0[n], contour.v0[n], contour.u1[n], contour.v1[n]
        steep = abs(u1 - u0) <= STEEP * abs(v1 - v0)
        rows = boundary.rows if steep else boundary.columns
        a0, a1 = (v0, v1) if steep else (u0, u1)
        i, j = edge_ends(n, mesh, contour)
        # At the start, if the first line it crosses on this side is a visible one; then at the end.
        for side in range(2):
            u, v, a, vertex = (u0, v0, a0, i) if side == 0 else (u1, v1, a1, j)
            ascending = (a1 > a0) == (side == 0)
            if ascending and boundary.lowest[n] == rows.first[n]:
                missing = rows.first[n] - 0.5 - a
            elif not ascending and boundary.highest[n] == rows.last[n] - 1:
                missing = a - (rows.last[n] - 0.5)
            else:
                continue
            if _within(u, v, lens):
                visible[vertex] = True
                _add_end(n, missing, a, u, v, mask, boundary)
    for _ in range(SHORT_CHAIN):
        added = False
        for n in range(mesh_edges):
            u0, v0, u1, v1 = contour.u0[n], contour.v0[n], contour.u1[n], contour.v1[n]
            steep = abs(u1 - u0) <= STEEP * abs(v1 - v0)
            rows = boundary.rows if steep else boundary.columns
            if rows.first[n] < rows.last[n] or boundary.length[n] != 0.0:
                continue
            i, j = edge_ends(n, mesh, contour)
            u, v = (u0 + u1) / 2, (v0 + v1) / 2
            if (visible[i] or visible[j]) and _within(u, v, lens):
                added = visible[i] = visible[j] = True
                _add_end(n, abs(v1 - v0) if steep else abs(u1 - u0), v if steep else u, u, v, mask, boundary)
        if not added:
            break


@compiled
def push(
    link: int, u: float, v: float, z: float, du: float, dv: float, area: float, overlap: float, lens: Any, wrench: Any
) -> Any:
    """Add forces in the image, ``(du, dv)`` times two weights, at a point of a link to the link's two wrenches."""
    px, py = (u - lens.cx) / lens.fx * z, (v - lens.cy) / lens.fy * z
    fx, fy = du * lens.fx / z, dv * lens.fy / z
    fz = -(fx * px + fy * py) / z
    mx, my, mz = py * fz - z * fy, z * fx - px * fz, px * fy - py * fx
    for part in range(2):
        weight = area if part == 0 else overlap
        line = wrench[part, link]
        line[0] += weight * fx
        line[1] += weight * fy
        line[2] += weight * fz
        line[3] += weight * mx
        line[4] += weight * my
        line[5] += weight * mz


@compiled
def sum_wrenches(
    row_found: int, found: int, bodies: Any, mesh: Any, lens: Any, contour: Any, mask: Any, boundary: Any
) -> Any:
    """Turn the visible contour into wrenches on links: of the area, and of the overlap with a mask.

    The crossing of an edge with a line moves as the ends of the edge do, in proportion to how near they are; so the
    samples of an edge come down to forces on its two ends.
    """
    mesh_edges = contour.start[bodies.link.shape[0]]
    for n in range(mesh_edges):
        boundary.length[n] = boundary.moment[n] = boundary.mask_length[n] = boundary.mask_moment[n] = 0.0
        boundary.lowest[n], boundary.highest[n] = np.int32(2147483647), np.int32(-1)
    _sum_samples(0, row_found, False, mask, boundary.rows, boundary)
    _sum_samples(row_found, found, True, mask, boundary.columns, boundary)
    _mend_ends(mesh_edges, mesh, lens, contour, mask, boundary)
    wrench = boundary.wrench
    wrench[:] = 0.0
    for n in range(mesh_edges):
        if boundary.length[n] == 0.0:
            continue
        u0, v0, u1, v1 = contour.u0[n], contour.v0[n], contour.u1[n], contour.v1[n]
        steep = abs(u1 - u0) <= STEEP * abs(v1 - v0)
        rows = boundary.rows if steep else boundary.columns
        a0, a1 = (v0, v1) if steep else (u0, u1)
        end = (boundary.moment[n] - a0 * boundary.length[n]) / (a1 - a0)
        mask_end = (boundary.mask_moment[n] - a0 * boundary.mask_length[n]) / (a1 - a0)
        sign = -1.0 if rows.begins[n] else 1.0
        du, dv = (sign, -sign * rows.slope[n]) if steep else (-sign * rows.slope[n], sign)
        i, j = edge_ends(n, mesh, contour)
        link = mesh.edge_link[contour.edge[n]]
        # A point cut off at the near plane moves as a point of the link: the edge's line in the image moves as it does.
        zi, zj = max(contour.depth[i], lens.near), max(contour.depth[j], lens.near)
        push(link, u0, v0, zi, du, dv, boundary.length[n] - end, boundary.mask_length[n] - mask_end, lens, wrench)
        push(link, u1, v1, zj, du, dv, end, mask_end, lens, wrench)


@compiled
def map_links(state: Any, links: Any, pose: Any, maps: Any) -> Any:
    """How forces on each link do work on the state of its arm.

    Args:
        state: ``(9 * arms,)``.
        links: The chains.
        pose: ``(L, 3, 4)`` T_cam_link.
        maps: ``(L, 9, 6)``, filled: the derivative with respect to the arm's state of what a force and a moment about
            the camera centre, camera frame, do work on.
    """
    for link in range(links.parent.shape[0]):
        base = links.arm[link] * STATE_SIZE
        parent = links.parent[link]
        here = maps[link]
        if parent >= 0:
            for i in range(STATE_SIZE):
                for j in range(6):
                    here[i, j] = maps[parent, i, j]
        else:
            here[:] = 0.0
            here[3, 0] = here[4, 1] = here[5, 2] = 1.0
            # R = Ry(gamma) Rx(alpha) Rz(beta): the axes that the angles turn about, seen from the camera.
            ca, sa = np.cos(state[base]), np.sin(state[base])
            cg, sg = np.cos(state[base + 2]), np.sin(state[base + 2])
            x, y, z = state[base + 3], state[base + 4], state[base + 5]
            _add_axis(here[0], 1.0, cg, 0.0, -sg, x, y, z)
            _add_axis(here[1], 1.0, sg * ca, -sa, cg * ca, x, y, z)
            _add_axis(here[2], 1.0, 0.0, 1.0, 0.0, x, y, z)
        axis, origin = pose[link, :, 2], pose[link, :, 3]
        for joint in range(3):
            gain = links.gain[link, joint]
            if gain != 0.0:
                _add_axis(here[6 + joint], gain, axis[0], axis[1], axis[2], origin[0], origin[1], origin[2])


@compiled(inline="always")
def _add_axis(row: Any, gain: float, ax: float, ay: float, az: float, x: float, y: float, z: float) -> Any:
    """A rotation about an axis through a point: its work is the moment about the point, ``a . (m - p x f)``."""
    row[0] -= gain * (ay * z - az * y)
    row[1] -= gain * (az * x - ax * z)
    row[2] -= gain * (ax * y - ay * x)
    row[3] += gain * ax
    row[4] += gain * ay
    row[5] += gain * az


@compiled
def pull_back(links: Any, maps: Any, wrench: Any, gradient: Any) -> Any:
    """Derivative with respect to the state of what wrenches ``(L, 6)`` on links do work on (principle of virtual work).

    ``gradient (9 * arms,)`` is filled.
    """
    gradient[:] = 0.0
    for link in range(links.parent.shape[0]):
        base = links.arm[link] * STATE_SIZE
        for i in range(STATE_SIZE):
            for j in range(6):
                gradient[base + i] += maps[link, i, j] * wrench[link, j]


@compiled
def jacobians(
    row_found: int, found: int, spacing: int, state: Any, links: Any, mesh: Any, lens: Any, contour: Any, boundary: Any,
    points: Any, normals: Any, lengths: Any, arms: Any, own_links: Any, rates: Any,
) -> Any:  # fmt: skip
    """Place, outward normal, length and Jacobian of the displacement along the normal, for each crossing.

    Args:
        row_found: Number of crossings with rows.
        found: Number K of all crossings.
        spacing: Rows or columns from one to the next.
        state: ``(9 * arms,)``.
        links: The chains.
        mesh: The meshes.
        lens: The camera.
        contour: The traced contour.
        boundary: Its visible crossings.
        points: ``(K, 2)`` pixels, filled.
        normals: ``(K, 2)``, filled.
        lengths: ``(K,)`` pixels of contour that each stands for, filled.
        arms: ``(K,)`` arm that each belongs to, filled.
        own_links: ``(K,)`` link of that arm, filled.
        rates: ``(K, 9 * arms)`` pixels per radian or metre, filled.
    """
    map_links(state, links, contour.pose, boundary.maps)
    for k in range(found):
        n, line, at = boundary.edge[k], boundary.line[k], boundary.at[k]
        across = k >= row_found
        rows = boundary.columns if across else boundary.rows
        slope = rows.slope[n]
        length = np.sqrt(1.0 + slope * slope)
        scale = (-1.0 if rows.begins[n] else 1.0) / length
        u, v, du, dv = (line, at, -slope * scale, scale) if across else (at, line, scale, -slope * scale)
        points[k, 0], points[k, 1] = u, v
        normals[k, 0], normals[k, 1] = du, dv
        lengths[k] = length * spacing
        i, j = edge_ends(n, mesh, contour)
        link = mesh.edge_link[contour.edge[n]]
        arms[k] = links.arm[link]
        own_links[k] = link - links.first[link]
        zi, zj = max(contour.depth[i], lens.near), max(contour.depth[j], lens.near)
        a0, a1 = (contour.u0[n], contour.u1[n]) if across else (contour.v0[n], contour.v1[n])
        t = (line - a0) / (a1 - a0)
        # Inverse depth is linear along the edge's image.
        nearness = (1.0 - t) / zi + t / zj
        fx, fy = du * lens.fx * nearness, dv * lens.fy * nearness
        px, py, pz = (u - lens.cx) / lens.fx / nearness, (v - lens.cy) / lens.fy / nearness, 1.0 / nearness
        fz = -(fx * px + fy * py) * nearness
        mx, my, mz = py * fz - pz * fy, pz * fx - px * fz, px * fy - py * fx
        base = links.arm[link] * STATE_SIZE
        rates[k, :] = 0.0
        for i in range(STATE_SIZE):
            row = boundary.maps[link, i]
            work = row[0] * fx + row[1] * fy + row[2] * fz + row[3] * mx + row[4] * my + row[5] * mz
            rates[k, base + i] = work
