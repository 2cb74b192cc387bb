"""The silhouette score on PyTorch tensors, so that a GPU can take thousands of candidate states at once.

The same geometry as :mod:`surgbench.silhouette.contour` in the same float64 arithmetic, written as operations on whole
batches: place the vertices, find the contour of the back facets, cut every contour edge into its crossings of pixel
rows, sort all crossings of all candidates by one integer key, and let one running sum of their directions tell where
a span begins and ends. A row's directions add up to zero (the contour is closed, and columns are clamped, never
dropped), so the sum needs no start per row. No image is made, and nothing needs a kernel of our own: the work is
sparse, about 1,300 crossings a candidate, and sorting them is what the library does best.

The host waits for the device twice a chunk: for the number of contour edges and for that of their crossings.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgbench.camera import NEAR_M, Camera
from surgbench.contract import Mask
from surgbench.errors import ConfigError, unknown_name
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.silhouette.evaluator import Reference, RowSums, Score
from surgbench.silhouette.layout import Links, assemble
from surgbench.state import ALPHA, BETA, GAMMA, JOINTS, POSITION, STATE_SIZE

try:
    import torch
    from torch import Tensor
except ImportError as error:
    raise ConfigError(
        f"device 'cuda' needs PyTorch, which cannot be imported ({error}); pip install torch, or use device 'cpu'"
    ) from None

# Tensors held at a time by one crossing, and how many a candidate has in a 700 x 493 image.
CROSSING_BYTES = 128
USUAL_CROSSINGS = 1500
# Behind the camera, where nothing is seen.
NOWHERE_M = -1e6


def check_device(device: str | torch.device) -> torch.device:
    """The device of a name, which is there.

    Args:
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:1"``.

    Raises:
        ConfigError: It is none, or this machine or this PyTorch has no CUDA.
    """
    try:
        found = torch.device(device)
    except RuntimeError:
        raise ConfigError(unknown_name("device", str(device), ("cpu", "cuda"))) from None
    if found.type not in ("cpu", "cuda"):
        raise ConfigError(unknown_name("device", str(device), ("cpu", "cuda")))
    if found.type == "cuda" and (found.index or 0) >= torch.cuda.device_count():
        reason = "was built without CUDA" if torch.version.cuda is None else "finds no such GPU on this machine"
        raise ConfigError(f"device '{device}': PyTorch {torch.__version__} {reason}; use device 'cpu'")
    return found


class _Frames(NamedTuple):
    """Moving frames as ``constant + cos(theta) cosine + sin(theta) sine``, theta linear in the state.

    First gamma of each arm, then alpha, then beta, then all links, last the identity.
    """

    gain: Tensor  # (9 * arms, J)
    offset: Tensor  # (J,)
    constant: Tensor  # (J, 4, 4)
    cosine: Tensor
    sine: Tensor
    path: Tensor  # (L * D,): from the camera to each link, the frames to be multiplied; D is a power of two


class _Body(NamedTuple):
    """Meshes of all links.

    A piece is what may become a contour edge: an edge of the mesh, or a face that crosses the near plane and is
    closed there. It has up to 7 variants, by which of its facets turn away or which of its corners are seen. An end
    of a piece is a vertex or, where that is not seen, the point between it and another one at the near plane.
    """

    vertices: Tensor  # (3, V)
    vertex_link: Tensor  # (V,)
    normals: Tensor  # (3, P)
    minus_offset: Tensor  # (P,)
    facet_link: Tensor  # (P,)
    corners: Tensor  # (3 * F,) first corners of all faces, then second, then third
    face_facet: Tensor  # (F,)
    edge_facets: Tensor  # (2 * E,)
    ends: Tensor  # (7, E + F, 2, 2): variant, piece, end, (vertex, other vertex)


class _Edges(NamedTuple):
    """Contour edges of a chunk: where they begin, how they go on, and what part of a key they share."""

    line: Tensor  # (K, 3): u and v of the upper end, columns per row
    head: Tensor  # (K, 2): first row less the crossings before it, key of candidate and direction
    crossings: Tensor  # (K,)


class _Spans(NamedTuple):
    """Crossings of a chunk, sorted: weight -1 where a covered span begins, +1 where one ends, else 0."""

    candidate: Tensor  # (C,)
    cell: Tensor  # (C,) row * (W + 1) + column
    weight: Tensor  # (C,)


class TorchSilhouetteEvaluator:
    """Counts the pixels that instruments cover, for very many states at once, on any PyTorch device.

    Means what :class:`surgbench.silhouette.SilhouetteEvaluator` means; counts differ from its by the few pixels whose
    centre lies within rounding of an edge, on the same CPU hardly ever. A state's counts do not depend on the
    others in its batch, nor on the memory allowed (on a GPU, but for such pixels).

    Args:
        instruments: One per arm; states have ``9 * len(instruments)`` components.
        camera: The view.
        near_m: Surfaces nearer to the camera plane are not seen.
        device: Where to count.
        memory_bytes: About how much of the device's memory to use at a time.

    Raises:
        ConfigError: The device is not there.
        ValueError: A link's mesh is not closed.
    """

    def __init__(
        self,
        instruments: Sequence[Instrument],
        camera: Camera,
        near_m: float = NEAR_M,
        device: str | torch.device = "cuda",
        memory_bytes: int = 1 << 30,
    ) -> None:
        self.instruments = tuple(instruments)
        self.camera = camera
        self.device = check_device(device)
        links, _, mesh = assemble(self.instruments)
        self._links = len(links.parent)
        self._frames = self._lay_frames(links)
        self._body = _Body(
            vertices=self._tensor(np.stack([mesh.x, mesh.y, mesh.z])),
            vertex_link=self._tensor(_owners(mesh.vertex_start)),
            normals=self._tensor(np.stack([mesh.nx, mesh.ny, mesh.nz])),
            minus_offset=self._tensor(-mesh.offset),
            facet_link=self._tensor(_owners(mesh.facet_start)),
            corners=self._tensor(mesh.faces.T.reshape(-1)),
            face_facet=self._tensor(mesh.face_facet),
            edge_facets=self._tensor(np.concatenate([mesh.edge_facet0, mesh.edge_facet1])),
            ends=self._tensor(_piece_ends(np.stack([mesh.edge_start, mesh.edge_end], axis=1), mesh.faces)),
        )
        self._intrinsics = self._tensor(np.pad(camera.matrix, ((0, 0), (0, 1))))
        nowhere = np.zeros(STATE_SIZE * len(self.instruments))
        nowhere[5::STATE_SIZE] = NOWHERE_M
        self._nowhere = self._tensor(nowhere)
        self._near = self._tensor(np.array(near_m))
        self._zero = self._tensor(np.array(0.0))
        self._one = self._tensor(np.ones(1, np.int64))
        # A crossing's key is its candidate, its cell in the prefix sums (row by row) and its direction.
        self._stride = camera.width + 1
        self._cell_bits = (camera.height * self._stride).bit_length()
        vertices, faces, edges = len(mesh.x), len(mesh.faces), len(mesh.edge_start)
        dense_bytes = 144 * vertices + 4 * (edges + 2 * faces)
        self._chunk = max(1, memory_bytes // (dense_bytes + USUAL_CROSSINGS * CROSSING_BYTES))
        self._most_crossings = memory_bytes // CROSSING_BYTES
        self._uploaded: WeakKeyDictionary[RowSums, Tensor] = WeakKeyDictionary()

    @property
    def triangles(self) -> int:
        """Number of triangles of all arms."""
        return len(self._body.face_facet)

    def _tensor(self, array: NDArray[np.generic]) -> Tensor:
        kind = np.float64 if array.dtype.kind == "f" else np.int64
        return torch.tensor(array.astype(kind), device=self.device)

    def _lay_frames(self, links: Links) -> _Frames:
        arms, count = len(self.instruments), len(links.parent)
        gain = np.zeros((3 * arms + count + 1, STATE_SIZE * arms))
        constant, cosine, sine = np.zeros((3, len(gain), 4, 4))
        base: tuple[tuple[int, int], ...] = ((GAMMA, 1), (ALPHA, 0), (BETA, 2))  # component of the state, axis
        for place, (component, axis) in enumerate(base):
            for arm in range(arms):
                index = place * arms + arm
                gain[index, STATE_SIZE * arm + component] = 1.0
                constant[index], cosine[index], sine[index] = _turn(axis)
        for link in range(count):
            index = 3 * arms + link
            gain[index, STATE_SIZE * links.arm[link] :][JOINTS] = links.gain[link]
            fixed = np.vstack([links.fixed[link], [0, 0, 0, 1]])
            constant[index], cosine[index], sine[index] = (fixed @ part for part in _turn(2))
        identity = len(gain) - 1
        constant[identity] = np.eye(4)
        paths = []
        for link in range(count):
            path: list[int] = []
            above = link
            while above >= 0:
                path.insert(0, 3 * arms + above)
                above = int(links.parent[above])
            paths.append([place * arms + int(links.arm[link]) for place in range(3)] + path)
        length = 1 << (max(len(path) for path in paths) - 1).bit_length()
        padded = np.array([path + [identity] * (length - len(path)) for path in paths])
        return _Frames(
            self._tensor(np.ascontiguousarray(gain.T)),
            self._tensor(np.concatenate([np.zeros(3 * arms), links.offset, np.zeros(1)])),
            self._tensor(constant),
            self._tensor(cosine),
            self._tensor(sine),
            self._tensor(padded.reshape(-1)),
        )

    def _states(self, states: ArrayLike | Tensor, ndim: int) -> Tensor:
        if isinstance(states, Tensor):
            batch = states.detach().to(self.device, torch.float64)
        else:
            batch = torch.tensor(np.asarray(states, dtype=np.float64), device=self.device)
        size = STATE_SIZE * len(self.instruments)
        if batch.ndim != ndim or batch.shape[-1] != size:
            raise ValueError(f"states must have {ndim} dimensions, the last of size {size}; got {tuple(batch.shape)}")
        return batch

    def _place(self, states: Tensor) -> Tensor:
        """Forward kinematics: ``(N, L, 4, 4)`` T_cam_link."""
        frames, arms = self._frames, len(self.instruments)
        theta = torch.addmm(frames.offset, states, frames.gain)[:, :, None, None]
        local = frames.constant + theta.cos() * frames.cosine + theta.sin() * frames.sine
        local[:, :arms, :3, 3] = states.reshape(-1, arms, STATE_SIZE)[:, :, POSITION]
        path = local.index_select(1, frames.path).view(len(states), self._links, -1, 4, 4)
        while path.shape[2] > 1:
            path = path[:, :, 0::2] @ path[:, :, 1::2]
        return path[:, :, 0]

    def _project(self, poses: Tensor) -> Tensor:
        """Vertices as ``(N, 3, V)`` u z, v z and z (no division: that is for the few on the contour)."""
        rows = (self._intrinsics @ poses).permute(2, 3, 0, 1)
        a, b, c, d = rows.index_select(3, self._body.vertex_link).unbind(1)
        x, y, z = self._body.vertices
        # Sums are written out, here and below: a library's order of adding may change with the batch.
        points: Tensor = a * x + b * y + c * z + d
        return points.transpose(0, 1)

    def _turned_away(self, poses: Tensor) -> Tensor:
        """Which facets turn away from the camera, ``(N, P)``; decided in three dimensions, in the links' frames."""
        minus_centre = poses[:, :, :3, :3].mT @ poses[:, :, :3, 3:]  # the camera's is -R't
        a, b, c = minus_centre[..., 0].permute(2, 0, 1).index_select(2, self._body.facet_link)
        nx, ny, nz = self._body.normals
        back: Tensor = nx * a + ny * b + nz * c > self._body.minus_offset
        return back

    def _variants(self, points: Tensor, back: Tensor) -> Tensor:
        """Which variant each piece has, ``(N, E + F)`` uint8; 0 where it is not on the contour."""
        count = len(back)
        away = back.view(torch.uint8)
        seen = (points[:, 2] > self._near).view(torch.uint8)
        along, against = away.index_select(1, self._body.edge_facets).view(count, 2, -1).unbind(1)
        first, second, third = seen.index_select(1, self._body.corners).view(count, 3, -1).unbind(1)
        edges = torch.add(along, against, alpha=2).remainder_(3)  # both turn away: inside the outline
        faces = torch.add(first, second, alpha=2).add_(third, alpha=4).remainder_(7)  # all are seen: not cut
        return torch.cat([edges, faces.mul_(away.index_select(1, self._body.face_facet))], dim=1)

    def _contour(self, states: Tensor) -> _Edges:
        """Contour edges of a chunk, cut off at the near plane."""
        # Squares, so that nothing after this can overflow.
        sound = states.square().sum(1, keepdim=True) < torch.inf
        poses = self._place(torch.where(sound, states, self._nowhere))
        points = self._project(poses)
        variants = self._variants(points, self._turned_away(poses))
        candidate, piece = variants.nonzero(as_tuple=True)  # waits for the device
        ends = self._body.ends[variants[candidate, piece].long(), piece]
        own, other = points[candidate[:, None, None], :, ends].unbind(2)  # (K, 2, 3) at both ends of an edge
        depth, depth_other = own[..., 2:], other[..., 2:]
        is_seen = depth > self._near
        # Always from the vertex that is not seen to the one that is: the same numbers for all edges that end here.
        cut = own + (self._near - depth) / (depth_other - depth) * (other - own)
        ends_uv = torch.where(is_seen, own, cut)[..., :2] / torch.where(is_seen, depth, self._near)
        begin, end = ends_uv.unbind(1)
        is_downward = end[:, 1] > begin[:, 1]
        along = end - begin
        # An edge of which nothing is seen crosses no row.
        v = torch.where(torch.maximum(depth, depth_other)[..., 0] > self._near, ends_uv[..., 1], self._zero)
        first, last = v.clamp(0, self.camera.height).ceil_().long().aminmax(dim=1)
        crossings = last - first
        line = torch.cat([torch.where(is_downward[:, None], begin, end), along[:, :1] / along[:, 1:]], dim=1)
        key = (candidate << (self._cell_bits + 1)) + is_downward
        return _Edges(line, torch.stack([last - crossings.cumsum(0), key], dim=1), crossings)

    def _spans(self, edges: _Edges, total: int) -> _Spans:
        """All crossings of contour edges with pixel rows, in order."""
        edge = torch.repeat_interleave(edges.crossings, output_size=total)
        first, key = edges.head[edge].unbind(1)
        u, v, slope = edges.line[edge].unbind(1)
        row = first + torch.arange(total, device=self.device)
        column = (u + (row - v) * slope).ceil_().clamp_(0, self.camera.width).nan_to_num_().long()
        cell = torch.add(column, row, alpha=self._stride)
        keys = torch.sort(torch.add(key, cell, alpha=2)).values
        is_closed = torch.rsub(keys & 1, 1, alpha=2).cumsum(0) == 0  # adds up 1 and -1
        return _Spans(
            candidate=keys >> (self._cell_bits + 1),
            cell=(keys >> 1) & ((1 << self._cell_bits) - 1),
            weight=torch.diff(is_closed.long(), prepend=self._one),
        )

    def _all_spans(self, states: Tensor, size: int) -> Iterator[tuple[int, _Spans]]:
        """Spans of at most ``size`` states at a time, each with the number of its first state."""
        for start in range(0, len(states), size):
            chunk = states[start : start + size]
            edges = self._contour(chunk)
            total = int(edges.crossings.sum())  # waits for the device
            if total > self._most_crossings and len(chunk) > 1:
                del edges
                for offset, spans in self._all_spans(chunk, (len(chunk) + 1) // 2):
                    yield start + offset, spans
            else:
                yield start, self._spans(edges, total)

    def counts(self, states: Tensor, prefix: Tensor) -> tuple[Tensor, Tensor]:
        """Area of each state's silhouette, and the sum of an integer image over it, left on the device.

        Args:
            states: ``(N, 9 * arms)``; a state that is not finite covers nothing.
            prefix: ``(H, W + 1)`` integers on the device: sum of the image's row left of each column, as
                :meth:`upload` returns it.

        Returns:
            ``(N,)`` int64 pixels and ``(N,)`` int64 sums.

        Raises:
            ValueError: Wrong shape of states or image.
        """
        if prefix.shape != (self.camera.height, self.camera.width + 1):
            height, width = prefix.shape
            expected = f"{self.camera.width} x {self.camera.height}"
            raise ValueError(f"the image is {width - 1} x {height}, the camera {expected}")
        batch = self._states(states, 2)
        flat = prefix.reshape(-1)
        sums = torch.zeros((2, len(batch)), dtype=torch.int64, device=self.device)
        for start, spans in self._all_spans(batch, self._chunk):
            at_ends = torch.stack([spans.cell % self._stride, flat[spans.cell].long()])
            sums[:, start:].index_add_(1, spans.candidate, at_ends * spans.weight)
        area, total = sums
        return area, total

    def upload(self, sums: RowSums) -> Tensor:
        """The prefix sums of an image on the device, for :meth:`counts`; they stay there as long as the image lives."""
        if sums not in self._uploaded:
            prefix = sums.prefix
            # A row of a mask has at most 16384 pixels, so that its sums are the same numbers as int16.
            array = prefix.view(np.int16) if prefix.dtype == np.uint16 else prefix
            self._uploaded[sums] = torch.tensor(array, device=self.device)
        return self._uploaded[sums]

    def score(self, states: ArrayLike | Tensor, reference: Reference) -> Score:
        """Area and overlap of each state's silhouette.

        Args:
            states: ``(N, 9 * arms)``, array or tensor; a state that is not finite covers nothing.
            reference: Mask of the camera's size.

        Returns:
            Pixel counts, as arrays.

        Raises:
            ValueError: Wrong shape of states or mask.
        """
        batch = self._states(states, 2)
        area, overlap = self.sum_over(batch, reference)
        return Score(area, overlap, self._boxes(batch))

    def sum_over(self, states: ArrayLike | Tensor, sums: RowSums) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Area of each state's silhouette, and the sum of an integer image over it.

        Args:
            states: ``(N, 9 * arms)``, array or tensor; a state that is not finite covers nothing.
            sums: Image of the camera's size.

        Returns:
            ``(N,)`` pixels and ``(N,)`` sums, as arrays.

        Raises:
            ValueError: Wrong shape of states or image.
        """
        area, total = torch.stack(self.counts(self._states(states, 2), self.upload(sums))).cpu().numpy()
        return area, total

    def _boxes(self, batch: Tensor) -> NDArray[np.int64]:
        """Bounding box of each state's silhouette, as in ``Score.box``; a pass of its own, since few ask for it."""
        width, height = self.camera.width, self.camera.height
        empty = torch.tensor([width, height, 0, 0], device=self.device)
        boxes = empty.repeat(len(batch), 1)
        for start, spans in self._all_spans(batch, self._chunk):
            ends = spans.weight.nonzero()[:, 0].view(-1, 2)  # waits for the device; a span's end follows its begin
            begin, end = spans.cell[ends].unbind(1)
            begin, end = begin[begin < end], end[begin < end]
            candidate = (start + spans.candidate[ends[:, 0]])[spans.cell[ends[:, 0]] < spans.cell[ends[:, 1]]]
            row = begin // self._stride
            for column, values, reduce in (
                (0, begin % self._stride, "amin"),
                (1, row, "amin"),
                (2, end % self._stride, "amax"),
                (3, row + 1, "amax"),
            ):
                boxes[:, column].scatter_reduce_(0, candidate, values, reduce)
        boxes[boxes[:, 2] == 0] = 0
        array: NDArray[np.int64] = boxes.cpu().numpy()
        return array

    def mask(self, state: ArrayLike | Tensor) -> Mask:
        """Silhouette of one state ``(9 * arms,)`` as an ``(H, W)`` bool image."""
        changes = torch.zeros(self.camera.height * self._stride, dtype=torch.int64, device=self.device)
        for _, spans in self._all_spans(self._states(state, 1)[None], 1):
            changes.index_add_(0, spans.cell, spans.weight)
        image: Mask = (changes.view(-1, self._stride).cumsum(1)[:, :-1] < 0).cpu().numpy()
        return image


def _turn(axis: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A rotation about a coordinate axis as ``(4, 4)`` parts: constant, with the cosine, with the sine."""
    constant, cosine, sine = np.zeros((3, 4, 4))
    j, k = (axis + 1) % 3, (axis + 2) % 3
    constant[axis, axis] = constant[3, 3] = 1.0
    cosine[j, j] = cosine[k, k] = 1.0
    sine[j, k], sine[k, j] = -1.0, 1.0
    return constant, cosine, sine


def _owners(start: NDArray[np.integer]) -> NDArray[np.int64]:
    """The link of each vertex or facet, from where the links' own begin, ``(L + 1,)``."""
    return np.repeat(np.arange(len(start) - 1), np.diff(start))


def _piece_ends(edges: NDArray[np.integer], faces: NDArray[np.integer]) -> NDArray[np.int64]:
    """``_Body.ends`` of mesh edges ``(E, 2)`` and faces ``(F, 3)``."""
    ends = np.zeros((7, len(edges) + len(faces), 2, 2), np.int64)
    # An edge runs along its first facet: variant 1 where that one looks away, 2 where the other one does.
    ends[1, : len(edges)] = edges[:, [[0, 1], [1, 0]]]
    ends[2, : len(edges)] = edges[:, [[1, 0], [0, 1]]]
    # A face's variant has a bit for each corner that is seen. Its outline is closed from where it leaves the seen
    # side to where it comes back.
    for corner in range(3):
        after, before = (corner + 1) % 3, (corner + 2) % 3
        alone = 1 << corner
        ends[alone, len(edges) :] = faces[:, [[after, corner], [before, corner]]]
        ends[7 - alone, len(edges) :] = faces[:, [[corner, before], [corner, after]]]
    return ends
