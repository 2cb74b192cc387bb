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

# An entry of the active list packs an edge's column, its direction and its index, so that sorting entries
# sorts columns.
COLUMN_SHIFT = 32
DIRECTION_BIT = np.int64(1) << 31
INDEX_MASK = DIRECTION_BIT - 1
EDGE_MASK = (np.int64(1) << COLUMN_SHIFT) - 1


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


@njit(cache=True, nogil=True, error_model="numpy")
def _project(x: Any, y: Any, z: Any, lens: Any, pose: Any, u: Any, v: Any, depth: Any) -> bool:
    """Project the vertices of one link; true if one of them lies at or before the near plane."""
    fx, fy, cx, cy, near = lens.fx, lens.fy, lens.cx, lens.cy, lens.near
    r20, r21, r22, tz = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    # Rows of K [R | t]: one division gives the pixel.
    a0, a1, a2 = fx * pose[0, 0] + cx * r20, fx * pose[0, 1] + cx * r21, fx * pose[0, 2] + cx * r22
    b0, b1, b2 = fy * pose[1, 0] + cy * r20, fy * pose[1, 1] + cy * r21, fy * pose[1, 2] + cy * r22
    at, bt = fx * pose[0, 3] + cx * tz, fy * pose[1, 3] + cy * tz
    hidden = 0
    for i in range(x.shape[0]):
        d = r20 * x[i] + r21 * y[i] + r22 * z[i] + tz
        inverse = 1.0 / d
        u[i] = (a0 * x[i] + a1 * y[i] + a2 * z[i] + at) * inverse
        v[i] = (b0 * x[i] + b1 * y[i] + b2 * z[i] + bt) * inverse
        depth[i] = d
        hidden += not d > near
    return hidden > 0


@njit(cache=True, nogil=True, error_model="numpy")
def _mark_back_faces(nx: Any, ny: Any, nz: Any, offset: Any, pose: Any, back: Any) -> None:
    """Facing is decided in three dimensions, in the link's frame, from the camera centre ``-R't``."""
    ex = -(pose[0, 0] * pose[0, 3] + pose[1, 0] * pose[1, 3] + pose[2, 0] * pose[2, 3])
    ey = -(pose[0, 1] * pose[0, 3] + pose[1, 1] * pose[1, 3] + pose[2, 1] * pose[2, 3])
    ez = -(pose[0, 2] * pose[0, 3] + pose[1, 2] * pose[1, 3] + pose[2, 2] * pose[2, 3])
    for f in range(nx.shape[0]):
        back[f] = nx[f] * ex + ny[f] * ey + nz[f] * ez < offset[f]


@njit(cache=True, nogil=True, error_model="numpy")
def _add_edge(u0: float, v0: float, u1: float, v1: float, lens: Any, work: Any, n: int) -> int:
    """Enter the directed contour edge from (u0, v0) to (u1, v1) as number n, if it crosses a row of the image.

    Returns:
        The number of the next edge.
    """
    direction = np.int64(0)
    if v1 > v0:
        direction = DIRECTION_BIT
    else:
        u0, v0, u1, v1 = u1, v1, u0, v0
    first = int(np.ceil(min(max(v0, 0.0), float(lens.height))))
    last = int(np.ceil(min(max(v1, 0.0), float(lens.height))))
    if first >= last:
        return n
    work.edge_u[n] = u0
    work.edge_v[n] = v0
    work.edge_slope[n] = (u1 - u0) / (v1 - v0)
    work.edge_last[n] = last
    work.edge_entry[n] = direction | n
    # Edges that begin at the same row are a linked list.
    work.edge_next[n] = work.row_first[first]
    work.row_first[first] = n
    return n + 1


@njit(cache=True, nogil=True, error_model="numpy")
def _near_point(i: int, j: int, lens: Any, mesh: Any, pose: Any, work: Any) -> tuple[float, float]:
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
def _add_clipped(link: int, links: Any, mesh: Any, lens: Any, pose: Any, work: Any, n: int) -> int:
    """Enter the contour of one link's back faces cut off at the near plane; returns as :func:`_add_edge`."""
    near = lens.near
    for e in range(links.edge_start[link], links.edge_start[link + 1]):
        back0, back1 = work.back[mesh.edge_face0[e]], work.back[mesh.edge_face1[e]]
        if back0 == back1:
            continue
        i, j = mesh.edge_start[e], mesh.edge_end[e]
        if back1:
            i, j = j, i
        if work.z[i] > near and work.z[j] > near:
            n = _add_edge(work.u[i], work.v[i], work.u[j], work.v[j], lens, work, n)
        elif work.z[i] > near:
            u, v = _near_point(i, j, lens, mesh, pose, work)
            n = _add_edge(work.u[i], work.v[i], u, v, lens, work, n)
        elif work.z[j] > near:
            u, v = _near_point(i, j, lens, mesh, pose, work)
            n = _add_edge(u, v, work.u[j], work.v[j], lens, work, n)
    # A back face that crosses the near plane is closed there by one more edge: from where its outline
    # leaves the visible side to where it comes back.
    for f in range(links.face_start[link], links.face_start[link + 1]):
        i, j, k = mesh.faces[f, 0], mesh.faces[f, 1], mesh.faces[f, 2]
        seen = int(work.z[i] > near) + int(work.z[j] > near) + int(work.z[k] > near)
        if not work.back[f] or seen == 0 or seen == 3:
            continue
        # Turn the corners so that the first is on one side alone.
        alone = seen == 1
        if (work.z[j] > near) == alone:
            i, j, k = j, k, i
        elif (work.z[k] > near) == alone:
            i, j, k = k, i, j
        u0, v0 = _near_point(i, j, lens, mesh, pose, work)
        u1, v1 = _near_point(k, i, lens, mesh, pose, work)
        if not alone:
            u0, v0, u1, v1 = u1, v1, u0, v0
        n = _add_edge(u0, v0, u1, v1, lens, work, n)
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _add_contour(link: int, links: Any, mesh: Any, lens: Any, work: Any, n: int) -> int:
    """Enter the contour of one link's back faces, all before the camera; returns as :func:`_add_edge`."""
    back, face0, face1 = work.back, mesh.edge_face0, mesh.edge_face1
    found = 0
    for e in range(links.edge_start[link], links.edge_start[link + 1]):
        work.found[found] = e
        found += back[face0[e]] != back[face1[e]]
    for k in range(found):
        e = work.found[k]
        i, j = mesh.edge_start[e], mesh.edge_end[e]
        if back[face1[e]]:
            i, j = j, i
        n = _add_edge(work.u[i], work.v[i], work.u[j], work.v[j], lens, work, n)
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _collect_edges(state: Any, links: Any, mesh: Any, lens: Any, pose: Any, work: Any) -> int:
    """Enter all contour edges of one state into ``work``; returns how many. A state that is not finite has none."""
    if not np.isfinite(state.sum()):
        return 0
    _place_links(state, links, pose)
    n = 0
    for link in range(links.parent.shape[0]):
        a, b = links.vertex_start[link], links.vertex_start[link + 1]
        if a == b:
            continue
        x, y, z = mesh.x[a:b], mesh.y[a:b], mesh.z[a:b]
        clipped = _project(x, y, z, lens, pose[link], work.u[a:b], work.v[a:b], work.z[a:b])
        a, b = links.face_start[link], links.face_start[link + 1]
        _mark_back_faces(mesh.nx[a:b], mesh.ny[a:b], mesh.nz[a:b], mesh.offset[a:b], pose[link], work.back[a:b])
        if clipped:
            n = _add_clipped(link, links, mesh, lens, pose, work, n)
        else:
            n = _add_contour(link, links, mesh, lens, work, n)
    return n


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _column(edge: Any, row: int, lens: Any, work: Any) -> Any:
    """First column whose pixel centre lies at or right of an edge's crossing of a row, within [0, width]."""
    u = np.ceil(work.edge_u[edge] + (row - work.edge_v[edge]) * work.edge_slope[edge])
    return np.int64(min(max(u, 0.0), float(lens.width)))


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _insert(active: Any, count: int, entry: Any) -> None:
    """Insert an entry into the first ``count``, which are sorted. Rows differ little: it seldom travels."""
    j = count - 1
    while j >= 0 and active[j] > entry:
        active[j + 1] = active[j]
        j -= 1
    active[j + 1] = entry


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _advance(row: int, count: int, lens: Any, work: Any) -> int:
    """Bring the active list from the row before to this one, sorted by column; returns its new length."""
    active = work.active
    kept = 0
    for k in range(count):
        entry = active[k]
        edge = entry & INDEX_MASK
        if work.edge_last[edge] > row:
            _insert(active, kept, (_column(edge, row, lens, work) << COLUMN_SHIFT) | (entry & EDGE_MASK))
            kept += 1
    edge = np.int64(work.row_first[row])
    work.row_first[row] = -1
    while edge >= 0:
        _insert(active, kept, (_column(edge, row, lens, work) << COLUMN_SHIFT) | work.edge_entry[edge])
        kept += 1
        edge = np.int64(work.edge_next[edge])
    return kept


@njit(cache=True, nogil=True, error_model="numpy")
def _spans(count: int, work: Any) -> int:
    """Covered spans of the row in work as pairs in ``work.spans``; returns how many."""
    spans, winding = 0, 0
    for k in range(count):
        entry = work.active[k]
        before = winding
        winding += 1 if entry & DIRECTION_BIT else -1
        if before == 0:
            work.spans[spans, 0] = entry >> COLUMN_SHIFT
        elif winding == 0:
            work.spans[spans, 1] = entry >> COLUMN_SHIFT
            spans += 1
    return spans


@njit(cache=True, nogil=True, error_model="numpy")
def score(states: Any, links: Any, mesh: Any, lens: Any, work: Any, prefix: Any, area: Any, total: Any) -> None:
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
    """
    pose = np.empty((links.parent.shape[0], 3, 4))
    active = work.active
    for s in range(states.shape[0]):
        edges = _collect_edges(states[s], links, mesh, lens, pose, work)
        covered, inside = np.int64(0), np.int64(0)
        row, count = 0, 0
        last = 0
        for n in range(edges):
            last = max(last, work.edge_last[n])
        while row < last:
            if count == 0 and work.row_first[row] < 0:
                row += 1
                continue
            if count == 2:
                # Between two edges alone, as along a shaft, nothing has to be sorted until a row where one begins or
                # ends.
                e0, e1 = active[0] & INDEX_MASK, active[1] & INDEX_MASK
                stop = min(work.edge_last[e0], work.edge_last[e1])
                while row < stop and work.row_first[row] < 0:
                    c0, c1 = _column(e0, row, lens, work), _column(e1, row, lens, work)
                    begin, end = min(c0, c1), max(c0, c1)
                    covered += end - begin
                    inside += np.int64(prefix[row, end]) - np.int64(prefix[row, begin])
                    row += 1
                if row >= last:
                    break
            count = _advance(row, count, lens, work)
            for k in range(_spans(count, work)):
                begin, end = work.spans[k, 0], work.spans[k, 1]
                covered += end - begin
                inside += np.int64(prefix[row, end]) - np.int64(prefix[row, begin])
            row += 1
        area[s] = covered
        total[s] = inside


@njit(cache=True, nogil=True, error_model="numpy")
def paint(state: Any, links: Any, mesh: Any, lens: Any, work: Any, image: Any) -> None:
    """Set the pixels of one state's silhouette in ``image (H, W)`` bool."""
    pose = np.empty((links.parent.shape[0], 3, 4))
    _collect_edges(state, links, mesh, lens, pose, work)
    count = 0
    for row in range(lens.height):
        count = _advance(row, count, lens, work)
        for k in range(_spans(count, work)):
            image[row, work.spans[k, 0] : work.spans[k, 1]] = True
