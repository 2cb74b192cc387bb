"""The compiled inner loop: from a state to the pixel spans that its silhouette covers.

For a closed mesh a pixel is covered if and only if its ray leaves the solid somewhere beyond the near
plane, that is, if a back-facing triangle lies over it. So the silhouette is the union of the back-facing
triangles, and the edges between a back-facing and a front-facing triangle bound it. Along a pixel row those
edges raise and lower the number of back faces over a pixel; the pixels where it is above zero are covered.
No image is made: the overlap of a span with a reference mask is one difference in a per-row prefix sum.

A pixel is covered where its centre is: column ``c`` of row ``r`` belongs to a span that begins at the first
``c >= u`` of its left edge and ends before the first ``c >= u`` of its right edge, and an edge crosses row
``r`` when ``v_low <= r < v_high``. Crossings are computed from the upper to the lower end of an edge, so
that two triangles which share an edge agree on it to the last bit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

# Far outside any image, yet safely inside int32 after the shift that packs a crossing's direction.
MAX_COLUMN = 1 << 20


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _place_links(state: Any, links: Any, pose: Any) -> None:
    """Forward kinematics: fill ``pose (L, 3, 4)`` with T_cam_link of one state ``(9 * arms,)``."""
    for link in range(links.parent.shape[0]):
        base = links.arm[link] * 9
        theta = links.offset[link]
        for joint in range(3):
            theta += links.gain[link, joint] * state[base + 6 + joint]
        ct, st = np.cos(theta), np.sin(theta)
        parent = links.parent[link]
        if parent < 0:
            ca, sa = np.cos(state[base]), np.sin(state[base])
            cb, sb = np.cos(state[base + 1]), np.sin(state[base + 1])
            cg, sg = np.cos(state[base + 2]), np.sin(state[base + 2])
            above = np.empty((3, 4))
            above[0, 0] = cg * cb + sg * sa * sb
            above[0, 1] = -cg * sb + sg * sa * cb
            above[0, 2] = sg * ca
            above[1, 0] = ca * sb
            above[1, 1] = ca * cb
            above[1, 2] = -sa
            above[2, 0] = -sg * cb + cg * sa * sb
            above[2, 1] = sg * sb + cg * sa * cb
            above[2, 2] = cg * ca
            for i in range(3):
                above[i, 3] = state[base + 3 + i]
        else:
            above = pose[parent]
        fixed = links.fixed[link]
        for i in range(3):
            a0, a1, a2 = above[i, 0], above[i, 1], above[i, 2]
            m0 = a0 * fixed[0, 0] + a1 * fixed[1, 0] + a2 * fixed[2, 0]
            m1 = a0 * fixed[0, 1] + a1 * fixed[1, 1] + a2 * fixed[2, 1]
            m2 = a0 * fixed[0, 2] + a1 * fixed[1, 2] + a2 * fixed[2, 2]
            m3 = a0 * fixed[0, 3] + a1 * fixed[1, 3] + a2 * fixed[2, 3] + above[i, 3]
            pose[link, i, 0] = m0 * ct + m1 * st
            pose[link, i, 1] = -m0 * st + m1 * ct
            pose[link, i, 2] = m2
            pose[link, i, 3] = m3


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _project_and_face(links: Any, mesh: Any, lens: Any, pose: Any, work: Any) -> bool:
    """Project all vertices and mark back faces; true if a vertex lies at or before the near plane."""
    clipped = False
    for link in range(links.parent.shape[0]):
        p = pose[link]
        r00, r01, r02, tx = p[0, 0], p[0, 1], p[0, 2], p[0, 3]
        r10, r11, r12, ty = p[1, 0], p[1, 1], p[1, 2], p[1, 3]
        r20, r21, r22, tz = p[2, 0], p[2, 1], p[2, 2], p[2, 3]
        nearest = np.inf
        for i in range(links.vertex_start[link], links.vertex_start[link + 1]):
            a, b, c = mesh.x[i], mesh.y[i], mesh.z[i]
            z = r20 * a + r21 * b + r22 * c + tz
            inverse = 1.0 / z
            work.u[i] = lens.fx * (r00 * a + r01 * b + r02 * c + tx) * inverse + lens.cx
            work.v[i] = lens.fy * (r10 * a + r11 * b + r12 * c + ty) * inverse + lens.cy
            work.z[i] = z
            nearest = min(nearest, z)
        if nearest <= lens.near:
            clipped = True
        # Facing is decided in three dimensions, in the link's frame, from the camera centre -R't.
        ex = -(r00 * tx + r10 * ty + r20 * tz)
        ey = -(r01 * tx + r11 * ty + r21 * tz)
        ez = -(r02 * tx + r12 * ty + r22 * tz)
        for f in range(links.face_start[link], links.face_start[link + 1]):
            work.back[f] = mesh.nx[f] * ex + mesh.ny[f] * ey + mesh.nz[f] * ez < mesh.offset[f]
    return clipped


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _add_edge(u0: float, v0: float, u1: float, v1: float, lens: Any, work: Any) -> None:
    """Enter the row crossings of the directed contour edge from (u0, v0) to (u1, v1)."""
    if v0 == v1:
        return
    down = v1 > v0
    if not down:
        u0, v0, u1, v1 = u1, v1, u0, v0
    if v1 <= 0.0 or v0 > lens.height - 1:
        return
    first = 0 if v0 <= 0.0 else int(np.ceil(v0))
    last = lens.height if v1 >= lens.height else int(np.ceil(v1))  # exclusive
    slope = (u1 - u0) / (v1 - v0)
    capacity = work.crossings.shape[1]
    for row in range(first, last):
        column = np.ceil(u0 + (row - v0) * slope)
        c = 0 if not column > 0.0 else (lens.width if column >= lens.width else int(column))
        n = work.counts[row]
        if n < capacity:
            work.crossings[row, n] = (c << 1) | (1 if down else 0)
        work.counts[row] = n + 1


@njit(cache=True, nogil=True, error_model="numpy")
def _near_point(i: int, j: int, lens: Any, mesh: Any, links: Any, pose: Any, work: Any) -> tuple[float, float]:
    """Pixel where the edge between vertices i and j, which lie on both sides, meets the near plane."""
    if i > j:  # the same numbers for both triangles of the edge
        i, j = j, i
    p = pose[mesh.vertex_link[i]]
    t = (lens.near - work.z[i]) / (work.z[j] - work.z[i])
    a = mesh.x[i] + t * (mesh.x[j] - mesh.x[i])
    b = mesh.y[i] + t * (mesh.y[j] - mesh.y[i])
    c = mesh.z[i] + t * (mesh.z[j] - mesh.z[i])
    u = lens.fx * (p[0, 0] * a + p[0, 1] * b + p[0, 2] * c + p[0, 3]) / lens.near + lens.cx
    v = lens.fy * (p[1, 0] * a + p[1, 1] * b + p[1, 2] * c + p[1, 3]) / lens.near + lens.cy
    return u, v


@njit(cache=True, nogil=True, error_model="numpy")
def _add_clipped(links: Any, mesh: Any, lens: Any, pose: Any, work: Any) -> None:
    """Enter the contour of the back faces cut off at the near plane."""
    near = lens.near
    for e in range(mesh.edge_start.shape[0]):
        back0, back1 = work.back[mesh.edge_face0[e]], work.back[mesh.edge_face1[e]]
        if back0 == back1:
            continue
        i, j = mesh.edge_start[e], mesh.edge_end[e]
        if back1:
            i, j = j, i
        if work.z[i] > near and work.z[j] > near:
            _add_edge(work.u[i], work.v[i], work.u[j], work.v[j], lens, work)
        elif work.z[i] > near:
            u, v = _near_point(i, j, lens, mesh, links, pose, work)
            _add_edge(work.u[i], work.v[i], u, v, lens, work)
        elif work.z[j] > near:
            u, v = _near_point(i, j, lens, mesh, links, pose, work)
            _add_edge(u, v, work.u[j], work.v[j], lens, work)
    # A back face that crosses the near plane is closed there by one more edge: from where its outline
    # leaves the visible side to where it comes back.
    for f in range(mesh.faces.shape[0]):
        if not work.back[f]:
            continue
        out_u = out_v = in_u = in_v = 0.0
        crosses = False
        for k in range(3):
            i, j = mesh.faces[f, k], mesh.faces[f, (k + 1) % 3]
            if work.z[i] > near and not work.z[j] > near:
                out_u, out_v = _near_point(i, j, lens, mesh, links, pose, work)
                crosses = True
            elif work.z[j] > near and not work.z[i] > near:
                in_u, in_v = _near_point(i, j, lens, mesh, links, pose, work)
        if crosses:
            _add_edge(out_u, out_v, in_u, in_v, lens, work)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _trace(state: Any, links: Any, mesh: Any, lens: Any, pose: Any, work: Any) -> None:
    """Enter all crossings of one state's silhouette into ``work``; a state that is not finite has none."""
    work.counts[:] = 0
    if not np.isfinite(state.sum()):
        return
    _place_links(state, links, pose)
    clipped = _project_and_face(links, mesh, lens, pose, work)
    if clipped:
        _add_clipped(links, mesh, lens, pose, work)
        return
    for e in range(mesh.edge_start.shape[0]):
        back0, back1 = work.back[mesh.edge_face0[e]], work.back[mesh.edge_face1[e]]
        if back0 != back1:
            i, j = mesh.edge_start[e], mesh.edge_end[e]
            if back1:
                i, j = j, i
            _add_edge(work.u[i], work.v[i], work.u[j], work.v[j], lens, work)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _sort_row(crossings: Any, n: int) -> None:
    """Insertion sort: rows hold a handful of crossings."""
    for i in range(1, n):
        key = crossings[i]
        j = i - 1
        while j >= 0 and crossings[j] > key:
            crossings[j + 1] = crossings[j]
            j -= 1
        crossings[j + 1] = key


@njit(cache=True, nogil=True, error_model="numpy")
def score(states: Any, links: Any, mesh: Any, lens: Any, work: Any, prefix: Any, area: Any, total: Any) -> int:
    """Area of each state's silhouette and the sum of an image over it.

    Args:
        states: ``(N, 9 * arms)`` float64.
        links: The chains of all arms.
        mesh: The meshes of all links.
        lens: The camera.
        work: Scratch.
        prefix: ``(H, W + 1)`` integers: sum of the image's row before each column.
        area: ``(N,)`` int64, filled with the pixels covered.
        total: ``(N,)`` int64, filled with the sums.

    Returns:
        The largest number of crossings in a row; above the scratch's capacity the results are not valid.
    """
    most = 0
    capacity = work.crossings.shape[1]
    pose = np.empty((links.parent.shape[0], 3, 4))
    for n in range(states.shape[0]):
        _trace(states[n], links, mesh, lens, pose, work)
        covered = np.int64(0)
        inside = np.int64(0)
        for row in range(lens.height):
            count = work.counts[row]
            if count == 0:
                continue
            if count > capacity:
                most = max(most, count)
                continue
            crossings = work.crossings[row]
            _sort_row(crossings, count)
            winding, begin = 0, 0
            for k in range(count):
                column = crossings[k] >> 1
                before = winding
                winding += 1 if crossings[k] & 1 else -1
                if before == 0:
                    begin = column
                elif winding == 0:
                    covered += column - begin
                    inside += np.int64(prefix[row, column]) - np.int64(prefix[row, begin])
        area[n] = covered
        total[n] = inside
    return most


@njit(cache=True, nogil=True, error_model="numpy")
def paint(state: Any, links: Any, mesh: Any, lens: Any, work: Any, image: Any) -> int:
    """Set the pixels of one state's silhouette in ``image (H, W)`` bool; returns as :func:`score`."""
    most = 0
    pose = np.empty((links.parent.shape[0], 3, 4))
    _trace(state, links, mesh, lens, pose, work)
    for row in range(lens.height):
        count = work.counts[row]
        most = max(most, count)
        if count == 0 or count > work.crossings.shape[1]:
            continue
        crossings = work.crossings[row]
        _sort_row(crossings, count)
        winding, begin = 0, 0
        for k in range(count):
            column = crossings[k] >> 1
            before = winding
            winding += 1 if crossings[k] & 1 else -1
            if before == 0:
                begin = column
            elif winding == 0:
                image[row, begin:column] = True
    return most
