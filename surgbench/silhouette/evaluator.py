"""Scores batches of candidate states against a mask, exactly and without rendering an image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgbench.camera import Camera
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.silhouette import kernel
from surgbench.state import STATE_SIZE

# Surfaces nearer to the camera plane than this are not seen.
NEAR_M = 1e-3


class _Links(NamedTuple):
    parent: NDArray[np.int32]  # (L,), -1 for the first link of an arm
    arm: NDArray[np.int32]  # (L,)
    fixed: FloatArray  # (L, 3, 4)
    offset: FloatArray  # (L,)
    gain: FloatArray  # (L, 3)
    vertex_start: NDArray[np.int32]  # (L + 1,)
    face_start: NDArray[np.int32]  # (L + 1,)
    edge_start: NDArray[np.int32]  # (L + 1,)


class _Mesh(NamedTuple):
    x: FloatArray  # (V,) vertices in their links' frames
    y: FloatArray
    z: FloatArray
    vertex_link: NDArray[np.int32]  # (V,)
    faces: NDArray[np.int32]  # (F, 3)
    nx: FloatArray  # (F,) outward normals; the plane is n . p = offset
    ny: FloatArray
    nz: FloatArray
    offset: FloatArray
    edge_start: NDArray[np.int32]  # (E,) directed as in edge_face0
    edge_end: NDArray[np.int32]
    edge_face0: NDArray[np.int32]
    edge_face1: NDArray[np.int32]


class _Lens(NamedTuple):
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    near: float


class _Work(NamedTuple):
    u: FloatArray  # (V,)
    v: FloatArray
    z: FloatArray
    back: NDArray[np.bool_]  # (F,)
    found: NDArray[np.int32]  # (E,) edges of a link's contour
    edge_u: FloatArray  # (E + F,) contour edges: upper end, ...
    edge_v: FloatArray
    edge_slope: FloatArray  # ... columns per row, ...
    edge_last: NDArray[np.int32]  # ... row before which it ends, ...
    edge_entry: NDArray[np.int64]  # ... direction and index, as in the active list, ...
    edge_next: NDArray[np.int32]  # ... and the next edge that begins at the same row, or -1
    row_first: NDArray[np.int32]  # (H,) first edge that begins at the row, or -1
    active: NDArray[np.int64]  # (E + F,) edges that cross the row in work, from left to right
    spans: NDArray[np.int64]  # (E + F, 2) covered columns of the row in work, begin and end


class RowSums:
    """An integer image prepared to be summed over silhouettes: one difference a span.

    Args:
        image: ``(H, W)`` integers or bool; the sum of a row's absolute values must fit 31 bits.

    Attributes:
        prefix: ``(H, W + 1)``: sum of the row left of each column; uint16 for masks, else int32.
    """

    def __init__(self, image: NDArray[np.integer] | Mask) -> None:
        height, width = image.shape
        dtype = np.uint16 if image.dtype == bool else np.int32
        self.prefix: NDArray[np.integer] = np.zeros((height, width + 1), dtype=dtype)
        np.cumsum(image, axis=1, dtype=dtype, out=self.prefix[:, 1:])


class Reference(RowSums):
    """A mask prepared to be scored against.

    Attributes:
        mask: ``(H, W)`` bool.
        area: Number of its pixels.
    """

    def __init__(self, mask: Mask) -> None:
        self.mask: Mask = np.ascontiguousarray(mask, dtype=bool)
        super().__init__(self.mask)
        self.area = int(np.count_nonzero(self.mask))


class Score(NamedTuple):
    """What a batch of states covers, pixels.

    Attributes:
        area: ``(N,)`` int64, ``|S|``.
        overlap: ``(N,)`` int64, ``|S and M|``.
    """

    area: NDArray[np.int64]
    overlap: NDArray[np.int64]

    def iou(self, reference: Reference) -> FloatArray:
        """Intersection over union with the reference, ``(N,)``; 1 where both are empty."""
        union = self.area + reference.area - self.overlap
        return np.where(union > 0, self.overlap / np.maximum(union, 1), 1.0)


def _edges(faces: NDArray[np.int32]) -> tuple[NDArray[np.int32], ...]:
    """Pair the directed edges of closed meshes: start, end, face along it, face against it."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    owner = np.tile(np.arange(len(faces), dtype=np.int32), 3)
    is_forward = directed[:, 0] < directed[:, 1]
    low, high = directed.min(axis=1), directed.max(axis=1)
    order = np.lexsort((high, low))
    along, against = order[is_forward[order]], order[~is_forward[order]]
    if len(along) != len(against) or not np.array_equal(directed[along], directed[against][:, ::-1]):
        raise ValueError("mesh is not closed: an edge is not shared by two consistently oriented faces")
    return directed[along, 0], directed[along, 1], owner[along], owner[against]


class SilhouetteEvaluator:
    """Counts the pixels that instruments cover, for many states at once.

    The counts are those of a rasteriser that tests every pixel centre: parts outside the image, behind the
    camera or crossing the near plane, overlapping arms and interpenetrating parts included.

    Args:
        instruments: One per arm; states have ``9 * len(instruments)`` components.
        camera: The view.
        near_m: Surfaces nearer to the camera plane are not seen.

    Raises:
        ValueError: A link's mesh is not closed.
    """

    def __init__(self, instruments: Sequence[Instrument], camera: Camera, near_m: float = NEAR_M) -> None:
        self.instruments = tuple(instruments)
        self.camera = camera
        self._lens = _Lens(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, near_m)
        self._links, self._mesh = _assemble(self.instruments)
        self._work = self._scratch()

    @property
    def triangles(self) -> int:
        """Number of triangles of all arms."""
        return len(self._mesh.faces)

    def _scratch(self) -> _Work:
        vertices, faces, edges = len(self._mesh.x), len(self._mesh.faces), len(self._mesh.edge_start)
        # Each edge of the mesh is in the contour at most once, and each face adds at most one at the near plane.
        most = edges + faces
        u, v, z = np.empty((3, vertices))
        edge_u, edge_v, edge_slope = np.empty((3, most))
        return _Work(
            u=u, v=v, z=z,
            back=np.zeros(faces, bool),
            found=np.empty(edges + 1, np.int32),
            edge_u=edge_u, edge_v=edge_v, edge_slope=edge_slope,
            edge_last=np.empty(most, np.int32),
            edge_entry=np.empty(most, np.int64),
            edge_next=np.empty(most, np.int32),
            row_first=np.full(self.camera.height, -1, np.int32),
            active=np.empty(most, np.int64),
            spans=np.empty((most, 2), np.int64),
        )  # fmt: skip

    def _states(self, states: ArrayLike, ndim: int) -> FloatArray:
        array = np.ascontiguousarray(states, dtype=np.float64)
        size = STATE_SIZE * len(self.instruments)
        if array.ndim != ndim or array.shape[-1] != size:
            raise ValueError(f"states must have {ndim} dimensions, the last of size {size}; got {array.shape}")
        return array

    def score(self, states: ArrayLike, reference: Reference) -> Score:
        """Area and overlap of each state's silhouette.

        Args:
            states: ``(N, 9 * arms)``; a state that is not finite covers nothing.
            reference: Mask of the camera's size.

        Returns:
            Exact pixel counts.

        Raises:
            ValueError: Wrong shape of states or mask.
        """
        return Score(*self.sum_over(states, reference))

    def sum_over(self, states: ArrayLike, sums: RowSums) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Area of each state's silhouette, and the sum of an integer image over it.

        Args:
            states: ``(N, 9 * arms)``; a state that is not finite covers nothing.
            sums: Image of the camera's size.

        Returns:
            ``(N,)`` pixels and ``(N,)`` sums, both exact.

        Raises:
            ValueError: Wrong shape of states or image.
        """
        batch = self._states(states, 2)
        if sums.prefix.shape != (self.camera.height, self.camera.width + 1):
            height, width = sums.prefix.shape
            expected = f"{self.camera.width} x {self.camera.height}"
            raise ValueError(f"the image is {width - 1} x {height}, the camera {expected}")
        result = np.empty(len(batch), np.int64), np.empty(len(batch), np.int64)
        kernel.score(batch, self._links, self._mesh, self._lens, self._work, sums.prefix, *result)
        return result

    def mask(self, state: ArrayLike) -> Mask:
        """Silhouette of one state ``(9 * arms,)`` as an ``(H, W)`` bool image."""
        one = self._states(state, 1)
        image = np.zeros((self.camera.height, self.camera.width), dtype=bool)
        kernel.paint(one, self._links, self._mesh, self._lens, self._work, image)
        return image


def _assemble(instruments: tuple[Instrument, ...]) -> tuple[_Links, _Mesh]:
    """Lay the links and meshes of all arms end to end."""
    parents: list[NDArray[np.int32]] = []
    vertices: list[FloatArray] = []
    faces: list[NDArray[np.int32]] = []
    vertex_start, face_start = [0], [0]
    for instrument in instruments:
        first_link = len(vertices)
        parents.append(np.where(instrument.parents < 0, -1, instrument.parents + first_link).astype(np.int32))
        for link in instrument.spec.links:
            body = instrument.meshes.get(link.name)
            link_vertices = np.empty((0, 3)) if body is None else body.vertices_m
            link_faces = np.empty((0, 3), np.int32) if body is None else body.faces
            vertices.append(link_vertices)
            faces.append(link_faces + np.int32(vertex_start[-1]))
            vertex_start.append(vertex_start[-1] + len(link_vertices))
            face_start.append(face_start[-1] + len(link_faces))
    points, triangles = np.concatenate(vertices), np.concatenate(faces).astype(np.int32)
    start, end, along, against = _edges(triangles)
    # Closed links share no edge, so that edges sorted by face stay together with their link.
    order = np.argsort(along, kind="stable")
    start, end, along, against = start[order], end[order], along[order], against[order]
    links = _Links(
        parent=np.concatenate(parents),
        arm=np.repeat(np.arange(len(instruments), dtype=np.int32), [len(i.spec.links) for i in instruments]),
        fixed=np.ascontiguousarray(np.concatenate([i.fixed_transforms for i in instruments])[:, :3, :]),
        offset=np.concatenate([i.theta_offsets_rad for i in instruments]),
        gain=np.concatenate([i.theta_gains for i in instruments]),
        vertex_start=np.array(vertex_start, np.int32),
        face_start=np.array(face_start, np.int32),
        edge_start=np.searchsorted(along, face_start).astype(np.int32),
    )
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    x, y, z = (np.ascontiguousarray(column) for column in points.T)
    nx, ny, nz = (np.ascontiguousarray(column) for column in normals.T)
    mesh = _Mesh(
        x=x, y=y, z=z,
        vertex_link=np.repeat(np.arange(len(vertices), dtype=np.int32), [len(v) for v in vertices]),
        faces=triangles,
        nx=nx, ny=ny, nz=nz,
        offset=np.einsum("fi,fi->f", normals, corners[:, 0]),
        edge_start=start, edge_end=end, edge_face0=along, edge_face1=against,
    )  # fmt: skip
    return links, mesh
