"""Compiled: from a state to the directed edges that bound its silhouette in the image.

For a closed mesh a pixel is covered if and only if its ray leaves the solid somewhere beyond the near plane, that is,
if a back-facing facet lies over it. So the silhouette is the union of the back-facing facets, and the edges between a
back-facing and a front-facing facet bound it. Facing is decided in three dimensions, so that it holds for facets that
reach behind the camera too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.silhouette.layout import Bodies, Indices, Links, Mesh, Starts

# States with larger components cover nothing.
LARGEST = 1e100


class Contour(NamedTuple):
    """Scratch, and after :func:`trace` the contour of one state."""

    pose: FloatArray  # (L, 3, 4) T_cam_link
    u: FloatArray  # (V,) pixels
    v: FloatArray
    depth: FloatArray  # metres
    back: NDArray[np.uint8]  # (P,) whether a facet turns away from the camera
    clipped: NDArray[np.bool_]  # (L,) whether some vertex lies at or before the near plane
    start: Starts  # (B + 1,) contour edges of each body ...
    closing: Starts  # (B + 1,) ... and the edges that close it at the near plane
    edge: Indices  # (C,) the mesh edge, for all but closing edges
    u0: FloatArray  # (C,) where it starts, ...
    v0: FloatArray
    u1: FloatArray  # ... and where it ends, the silhouette on its left as seen in the image
    v1: FloatArray


def contour_scratch(links: Links, bodies: Bodies, mesh: Mesh) -> Contour:
    """Room for the contour of any state."""
    count = len(bodies.link)
    # Each edge of the mesh is in the contour at most once, and each face adds at most one at the near plane. One more
    # is written beyond the last edge found.
    most = len(mesh.edge_start) + len(mesh.faces) + 1
    u, v, depth = np.empty((3, len(mesh.x)))
    u0, v0, u1, v1 = np.empty((4, most))
    return Contour(
        pose=np.empty((len(links.parent), 3, 4)),
        u=u, v=v, depth=depth,
        back=np.zeros(len(mesh.nx), np.uint8),
        clipped=np.zeros(len(links.parent), bool),
        start=np.zeros(count + 1, np.int64),
        closing=np.zeros(count + 1, np.int64),
        edge=np.empty(most, np.uint32),
        u0=u0, v0=v0, u1=u1, v1=v1,
    )  # fmt: skip


@compiled
def place_links(state: Any, links: Any, pose: Any) -> None:
    """Forward kinematics: fill ``pose (L, 3, 4)`` with T_cam_link of one state ``(9 * arms,)``."""
    for link in range(links.parent.shape[0]):
        base = links.arm[link] * 9
        theta = links.offset[link]
        for joint in range(3):
            theta += links.gain[link, joint] * state[base + 6 + joint]
        ct, st = np.cos(theta), np.sin(theta)
        parent = links.parent[link]
        if parent < 0:
            # R = Ry(gamma) Rx(alpha) Rz(beta), as geometry.look_at_rotation; written into the link's own place.
            ca, sa = np.cos(state[base]), np.sin(state[base])
            cb, sb = np.cos(state[base + 1]), np.sin(state[base + 1])
            cg, sg = np.cos(state[base + 2]), np.sin(state[base + 2])
            above = pose[link]
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


@compiled
def _project(x: Any, y: Any, z: Any, lens: Any, pose: Any, u: Any, v: Any, depth: Any) -> Any:
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


@compiled
def _mark_back(nx: Any, ny: Any, nz: Any, offset: Any, pose: Any, back: Any) -> None:
    """Which facets of one link the camera, at ``-R't`` in the link's frame, lies behind."""
    ex = -(pose[0, 0] * pose[0, 3] + pose[1, 0] * pose[1, 3] + pose[2, 0] * pose[2, 3])
    ey = -(pose[0, 1] * pose[0, 3] + pose[1, 1] * pose[1, 3] + pose[2, 1] * pose[2, 3])
    ez = -(pose[0, 2] * pose[0, 3] + pose[1, 2] * pose[1, 3] + pose[2, 2] * pose[2, 3])
    for f in range(nx.shape[0]):
        back[f] = nx[f] * ex + ny[f] * ey + nz[f] * ez < offset[f]


@compiled
def _near_point(i: int, j: int, pose: Any, mesh: Any, lens: Any, contour: Any) -> Any:
    """Pixel where the edge between vertices i and j, which lie on both sides, meets the near plane."""
    if i > j:  # the same numbers for both triangles of the edge
        i, j = j, i
    t = (lens.near - contour.depth[i]) / (contour.depth[j] - contour.depth[i])
    a = mesh.x[i] + t * (mesh.x[j] - mesh.x[i])
    b = mesh.y[i] + t * (mesh.y[j] - mesh.y[i])
    c = mesh.z[i] + t * (mesh.z[j] - mesh.z[i])
    u = lens.fx * (pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3]) / lens.near + lens.cx
    v = lens.fy * (pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3]) / lens.near + lens.cy
    return u, v


@compiled
def _reaches(depth: Any, near: float) -> Any:
    """Whether some vertex lies at or before the near plane."""
    hidden = 0
    for i in range(depth.shape[0]):
        hidden += not depth[i] > near
    return hidden > 0


@compiled(inline="always")
def edge_ends(n: Any, mesh: Any, contour: Any) -> Any:
    """Vertices that contour edge n runs from and to; for edges of the mesh, not for closing ones."""
    e = contour.edge[n]
    i, j = mesh.edge_start[e], mesh.edge_end[e]
    return (j, i) if contour.back[mesh.edge_facet1[e]] else (i, j)


@compiled
def _cut(b: int, pose: Any, mesh: Any, lens: Any, contour: Any) -> None:
    """Cut the contour edges of body b off at the near plane; those wholly before it shrink to nothing."""
    near = lens.near
    for n in range(contour.start[b], contour.start[b + 1]):
        i, j = edge_ends(n, mesh, contour)
        starts, ends = contour.depth[i] > near, contour.depth[j] > near
        if starts and ends:
            continue
        if starts:
            contour.u1[n], contour.v1[n] = _near_point(i, j, pose, mesh, lens, contour)
        elif ends:
            contour.u0[n], contour.v0[n] = _near_point(i, j, pose, mesh, lens, contour)
        else:
            contour.u0[n] = contour.v0[n] = contour.u1[n] = contour.v1[n] = 0.0


@compiled
def _close(b: int, n: int, pose: Any, bodies: Any, mesh: Any, lens: Any, contour: Any) -> Any:
    """Close the outline of body b at the near plane, from edge n on; returns the number of the next edge.

    A back face that crosses the plane adds one edge, from where its outline leaves the visible side to where it comes
    back.
    """
    near = lens.near
    found = n
    for f in range(bodies.face_start[b], bodies.face_start[b + 1]):
        i, j, k = mesh.faces[f, 0], mesh.faces[f, 1], mesh.faces[f, 2]
        a, b_, c = contour.depth[i] > near, contour.depth[j] > near, contour.depth[k] > near
        contour.edge[found] = f
        found += ((a ^ b_) | (a ^ c)) & (contour.back[mesh.face_facet[f]] != 0)
    for m in range(n, found):
        f = contour.edge[m]
        i, j, k = mesh.faces[f, 0], mesh.faces[f, 1], mesh.faces[f, 2]
        seen = int(contour.depth[i] > near) + int(contour.depth[j] > near) + int(contour.depth[k] > near)
        # Turn the corners so that the first is on one side alone.
        alone = seen == 1
        if (contour.depth[j] > near) == alone:
            i, j, k = j, k, i
        elif (contour.depth[k] > near) == alone:
            i, j, k = k, i, j
        u0, v0 = _near_point(i, j, pose, mesh, lens, contour)
        u1, v1 = _near_point(k, i, pose, mesh, lens, contour)
        if not alone:
            u0, v0, u1, v1 = u1, v1, u0, v0
        contour.u0[m], contour.v0[m], contour.u1[m], contour.v1[m] = u0, v0, u1, v1
    return found


@compiled
def _gather(edge: Any, mesh: Any, contour: Any) -> None:
    """Ends of the contour edges, a back face along each of them. Without branches: which way they run is random."""
    start, end, along, back = mesh.edge_start, mesh.edge_end, mesh.edge_facet1, contour.back
    u, v = contour.u, contour.v
    u0, v0, u1, v1 = contour.u0, contour.v0, contour.u1, contour.v1
    for n in range(edge.shape[0]):
        e = edge[n]
        i, j = np.uint32(start[e]), np.uint32(end[e])
        turn = np.uint32(back[along[e]]) * (i ^ j)
        i ^= turn
        j ^= turn
        u0[n], v0[n], u1[n], v1[n] = u[i], v[i], u[j], v[j]


@compiled
def trace(state: Any, links: Any, bodies: Any, mesh: Any, lens: Any, contour: Any) -> Any:
    """Find the contour of one state ``(9 * arms,)``; returns how many edges it has, closing ones included.

    A state that is not finite, or so large that its pixels would not be, has none.
    """
    count = bodies.link.shape[0]
    largest = 0.0
    for i in range(state.shape[0]):
        largest = max(largest, abs(state[i])) if state[i] == state[i] else np.inf
    if largest > LARGEST:
        contour.start[:] = 0
        contour.closing[:] = 0
        return 0
    pose = contour.pose
    place_links(state, links, pose)
    for link in range(pose.shape[0]):
        a, b = mesh.vertex_start[link], mesh.vertex_start[link + 1]
        x, y, z = mesh.x[a:b], mesh.y[a:b], mesh.z[a:b]
        u, v, depth = contour.u[a:b], contour.v[a:b], contour.depth[a:b]
        contour.clipped[link] = _project(x, y, z, lens, pose[link], u, v, depth)
        a, b = mesh.facet_start[link], mesh.facet_start[link + 1]
        nx, ny, nz, offset = mesh.nx[a:b], mesh.ny[a:b], mesh.nz[a:b], mesh.offset[a:b]
        _mark_back(nx, ny, nz, offset, pose[link], contour.back[a:b])
    edge, back, facet0, facet1 = contour.edge, contour.back, mesh.edge_facet0, mesh.edge_facet1
    n = 0
    for b in range(count):
        contour.start[b] = n
        for e in range(bodies.edge_start[b], bodies.edge_start[b + 1]):
            edge[n] = e
            n += back[facet0[e]] ^ back[facet1[e]]
    contour.start[count] = n
    _gather(edge[:n], mesh, contour)
    for b in range(count):
        contour.closing[b] = n
        link = bodies.link[b]
        if contour.clipped[link] and _reaches(contour.depth[bodies.vertex_first[b] : bodies.vertex_last[b]], lens.near):
            _cut(b, pose[link], mesh, lens, contour)
            n = _close(b, n, pose[link], bodies, mesh, lens, contour)
    contour.closing[count] = n
    return n
