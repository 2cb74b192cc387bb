"""The arms' chains and meshes laid end to end, as flat arrays for compiled and tensor code."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from surgbench.camera import Camera
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.instrument.meshes import Faces, check_mesh

# Unsigned: compiled code need not look whether an index counts from the end.
Indices = NDArray[np.uint32]
Starts = NDArray[np.int64]

# Adjacent triangles are one facet if no corner of one is farther than this from the plane of the other: 1e-8 pixels
# at a working distance.
COPLANAR_M = 1e-12

# Each link's vertices and facets fill whole vectors, so that compiled loops have no remainder.
LANES = 16


class Links(NamedTuple):
    """Kinematic chains."""

    parent: Starts  # (L,), -1 for the first link of an arm
    arm: Starts  # (L,)
    first: Starts  # (L,) the first link of the same arm
    fixed: FloatArray  # (L, 3, 4)
    offset: FloatArray  # (L,)
    gain: FloatArray  # (L, 3)


class Bodies(NamedTuple):
    """Closed connected meshes; a link has any number of them, and they may interpenetrate."""

    link: Starts  # (B,)
    vertex_first: Starts  # (B,) its vertices lie together, ...
    vertex_last: Starts  # (B,) ... up to before this one
    edge_start: Starts  # (B + 1,)
    face_start: Starts  # (B + 1,)


class Mesh(NamedTuple):
    """Vertices in their links' frames, the planes of facets, triangles, and edges between different facets."""

    vertex_start: Starts  # (L + 1,) each link's vertices and facets, padded to whole vectors
    facet_start: Starts  # (L + 1,)
    x: FloatArray  # (V,)
    y: FloatArray
    z: FloatArray
    nx: FloatArray  # (P,) outward normals; the plane is n . p = offset
    ny: FloatArray
    nz: FloatArray
    offset: FloatArray
    faces: Indices  # (F, 3)
    face_facet: Indices  # (F,)
    edge_start: Indices  # (E,) directed as in edge_facet0
    edge_end: Indices
    edge_facet0: Indices
    edge_facet1: Indices
    edge_link: Indices


class Lens(NamedTuple):
    """A pinhole camera in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    near: float  # metres


def lens(camera: Camera, near_m: float) -> Lens:
    """The camera's numbers as compiled code takes them.

    Raises:
        ValueError: The near plane is not before the camera.
    """
    near = float(near_m)
    if not 0.0 < near < np.inf:
        raise ValueError(f"near_m must be positive and finite, got {near_m}")
    return Lens(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, near)


def assemble_links(instruments: Sequence[Instrument]) -> Links:
    """Lay the chains of all arms end to end.

    Raises:
        ValueError: There is no instrument.
    """
    if not instruments:
        raise ValueError("at least one instrument is needed, one per arm")
    counts = [len(instrument.spec.links) for instrument in instruments]
    first = np.cumsum([0, *counts[:-1]])
    parents = [np.where(i.parents < 0, -1, i.parents + offset) for i, offset in zip(instruments, first, strict=True)]
    return Links(
        parent=np.concatenate(parents).astype(np.int64),
        arm=np.repeat(np.arange(len(instruments)), counts),
        first=np.repeat(first, counts).astype(np.int64),
        fixed=np.ascontiguousarray(np.concatenate([i.fixed_transforms for i in instruments])[:, :3, :]),
        offset=np.concatenate([i.theta_offsets_rad for i in instruments]),
        gain=np.concatenate([i.theta_gains for i in instruments]),
    )


def assemble(instruments: Sequence[Instrument]) -> tuple[Links, Bodies, Mesh]:
    """Lay the links and meshes of all arms end to end.

    Raises:
        ValueError: A link's mesh is not closed, or no link has one.
    """
    links = assemble_links(instruments)
    if not any(instrument.meshes for instrument in instruments):
        raise ValueError("the instruments have no meshes, so that there is nothing to see")
    vertices: list[FloatArray] = []
    planes: list[FloatArray] = []
    faces: list[Indices] = []
    edges: list[Indices] = []
    body_table: list[tuple[int, int, int]] = []
    vertex_start, facet_start, edge_start, face_start = [0], [0], [0], [0]
    link_count = 0
    for instrument in instruments:
        for link in instrument.spec.links:
            body = instrument.meshes.get(link.name)
            facets_before = facet_start[-1]
            if body is not None:
                check_mesh(link.name, body)
                points, parts = _connected(body.vertices_m, body.faces)
                vertices.append(_padded(points, points[0]))
                for part in parts:
                    facet_faces, facet_planes, part_edges = _facets(points, part)
                    part_edges[:, :2] += vertex_start[-1]
                    part_edges[:, 2:] += facets_before
                    facet_faces[:, :3] += vertex_start[-1]
                    facet_faces[:, 3] += facets_before
                    facets_before += len(facet_planes)
                    planes.append(facet_planes)
                    faces.append(facet_faces)
                    edges.append(part_edges)
                    body_table.append((link_count, vertex_start[-1] + part.min(), vertex_start[-1] + part.max() + 1))
                    edge_start.append(edge_start[-1] + len(part_edges))
                    face_start.append(face_start[-1] + len(facet_faces))
                filled = facets_before - facet_start[-1]
                planes.append(np.zeros((-filled % LANES, 4)))
                facets_before += -filled % LANES
            vertex_start.append(vertex_start[-1] + (0 if body is None else len(vertices[-1])))
            facet_start.append(facets_before)
            link_count += 1
    table = np.array(body_table, np.int64)
    bodies = Bodies(
        link=_column(table, 0),
        vertex_first=_column(table, 1),
        vertex_last=_column(table, 2),
        edge_start=np.array(edge_start),
        face_start=np.array(face_start),
    )
    points, facets = np.concatenate(vertices), np.concatenate(planes)
    corners, ends = np.concatenate(faces), np.concatenate(edges)
    mesh = Mesh(
        vertex_start=np.array(vertex_start), facet_start=np.array(facet_start),
        x=_column(points, 0), y=_column(points, 1), z=_column(points, 2),
        nx=_column(facets, 0), ny=_column(facets, 1), nz=_column(facets, 2), offset=_column(facets, 3),
        faces=np.ascontiguousarray(corners[:, :3]), face_facet=_column(corners, 3),
        edge_start=_column(ends, 0), edge_end=_column(ends, 1),
        edge_facet0=_column(ends, 2), edge_facet1=_column(ends, 3),
        edge_link=np.repeat(bodies.link, np.diff(bodies.edge_start)).astype(np.uint32),
    )  # fmt: skip
    return links, bodies, mesh


def _column(table: NDArray[Any], index: int) -> NDArray[Any]:
    return np.ascontiguousarray(table[:, index])


def _padded(rows: FloatArray, fill: FloatArray) -> FloatArray:
    return np.concatenate([rows, np.tile(fill, (-len(rows) % LANES, 1))])


def _groups(count: int, pairs: NDArray[Any]) -> NDArray[np.int32]:
    """Number of the connected group that each of ``count`` nodes is in."""
    graph = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    groups: NDArray[np.int32] = connected_components(graph, directed=False)[1]
    return groups


def _connected(vertices_m: FloatArray, faces: Faces) -> tuple[FloatArray, list[Faces]]:
    """Split a mesh into the parts that hang together by vertices.

    Returns:
        The vertices, those of a part side by side, and the faces of each part.
    """
    group = _groups(len(vertices_m), faces[:, [0, 1, 1, 2]].reshape(-1, 2))
    order = np.argsort(group, kind="stable")
    faces = np.argsort(order)[faces].astype(np.int32)
    group = group[order][faces[:, 0]]
    by_group = np.argsort(group, kind="stable")
    return vertices_m[order], np.split(faces[by_group], np.flatnonzero(np.diff(group[by_group])) + 1)


def _facets(vertices_m: FloatArray, faces: Faces) -> tuple[Indices, FloatArray, Indices]:
    """Merge coplanar triangles: they turn to or from the camera together, so the edges between them never show.

    Returns:
        Corners and facet of each face, ``(F, 4)``; normal and offset of each facet, ``(P, 4)``; and of each edge that
        is left its vertices and the facets along and against it, ``(E, 4)``, sorted by facet.
    """
    corners = vertices_m[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    units = normals / np.maximum(lengths, np.finfo(float).tiny)[:, None]
    start, end, along, against = _edges(faces)

    def rise(face: NDArray[np.int32], other: NDArray[np.int32]) -> FloatArray:
        heights = np.einsum("eci,ei->ec", corners[other] - corners[face][:, :1], units[face])
        return np.asarray(np.abs(heights).max(axis=1))

    aligned = np.einsum("ei,ei->e", units[along], units[against]) > 0
    flat = aligned & (np.maximum(rise(along, against), rise(against, along)) < COPLANAR_M)
    facet = _groups(len(faces), np.stack([along[flat], against[flat]], axis=1))
    # The largest triangle gives the plane.
    order = np.lexsort((-lengths, facet))
    largest = order[np.searchsorted(facet[order], np.arange(facet.max() + 1))]
    planes = np.column_stack([normals[largest], np.einsum("fi,fi->f", normals[largest], corners[largest, 0])])
    edges = np.stack([start, end, facet[along], facet[against]], axis=1)[~flat]
    edges = edges[np.argsort(edges[:, 2], kind="stable")]
    return np.column_stack([faces, facet]).astype(np.uint32), planes, edges.astype(np.uint32)


def _edges(faces: Faces) -> tuple[NDArray[np.int32], ...]:
    """Pair the directed edges of closed meshes: start, end, face along it, face against it."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    owner = np.tile(np.arange(len(faces), dtype=np.int32), 3)
    is_forward = directed[:, 0] < directed[:, 1]
    order = np.lexsort((directed.max(axis=1), directed.min(axis=1)))
    along, against = order[is_forward[order]], order[~is_forward[order]]
    return directed[along, 0], directed[along, 1], owner[along], owner[against]
