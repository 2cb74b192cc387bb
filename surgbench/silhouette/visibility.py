"""Which of several arms is seen at each pixel, and how far away it is.

An arm's own silhouette is the evaluator's. Where silhouettes overlap, the arm whose surface is nearest there is
seen, pixel by pixel: arms may cross, or even run through each other. Depths come from a rasteriser with the kernel's
rules (see :mod:`surgbench.silhouette.kernel`): the inverse of the depth is linear in the pixel over a plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgbench.camera import NEAR_M, Camera
from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.silhouette.evaluator import SilhouetteEvaluator
from surgbench.silhouette.layout import lens
from surgbench.state import STATE_SIZE, split_arms


class _Arm:
    """The silhouette of one arm alone, and its body in one piece."""

    def __init__(self, instrument: Instrument, camera: Camera, near_m: float) -> None:
        self.instrument = instrument
        self.evaluator = SilhouetteEvaluator([instrument], camera, near_m=near_m)
        bodies = [(instrument.link_index[name], mesh) for name, mesh in instrument.meshes.items()]
        counts = [len(mesh.vertices_m) for _, mesh in bodies]
        starts = np.cumsum([0, *counts[:-1]])
        self.vertices_m = np.concatenate([mesh.vertices_m for _, mesh in bodies])
        self.vertex_link = np.repeat([link for link, _ in bodies], counts)
        faces = [mesh.faces + start for (_, mesh), start in zip(bodies, starts, strict=True)]
        self.faces = np.concatenate(faces).astype(np.int32)

    def points_cam(self, state: FloatArray) -> FloatArray:
        """All vertices ``(V, 3)`` in the camera frame, metres."""
        return self.points_of(self.instrument.link_transforms(state))

    def points_of(self, link_transforms: FloatArray) -> FloatArray:
        """The same from where its links are, ``(L, 4, 4)``."""
        points: FloatArray = np.empty_like(self.vertices_m)
        place_points(link_transforms, self.vertex_link, self.vertices_m, points)
        return points


class VisibilityEvaluator:
    """Tells the arms of one image apart.

    Args:
        instruments: One per arm; states have ``9 * len(instruments)`` components.
        camera: The view.
        near_m: Surfaces nearer to the camera plane are not seen. A solid that the near plane cuts is seen there.

    Attributes:
        arms: The silhouette and the body of each arm alone.
        lens: The camera, as compiled functions take it.

    Raises:
        ValueError: A link's mesh is not closed.

    Example:
        Two shafts that lie level across the whole image, one behind the other; the nearer one hides it.

        >>> import numpy as np
        >>> from surgbench.camera import Camera
        >>> from surgbench.instrument import load_instrument
        >>> from surgbench.silhouette import VisibilityEvaluator
        >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
        >>> visibility = VisibilityEvaluator([load_instrument("large_needle_driver")] * 2, camera)
        >>> states = [0, 0, np.pi / 2, 0.08, 0, 0.16, 0, 0, 0] + [0, 0, np.pi / 2, 0.08, 0, 0.13, 0, 0, 0]
        >>> visibility.silhouettes(states).sum(axis=(1, 2)), visibility.visible_masks(states).sum(axis=(1, 2))
        (array([1760, 2080]), array([   0, 2080]))
        >>> visibility.front_fractions(states)
        array([0., 1.])
    """

    def __init__(self, instruments: Sequence[Instrument], camera: Camera, near_m: float = NEAR_M) -> None:
        if not instruments:
            raise ValueError("at least one instrument is needed, one per arm")
        self.camera = camera
        self.arms = [_Arm(instrument, camera, near_m) for instrument in instruments]
        self.lens = lens(camera, near_m)

    def silhouettes(self, state: ArrayLike) -> NDArray[np.bool_]:
        """Each arm's silhouette as if it were alone.

        Args:
            state: ``(9 * arms,)``; one that is not finite covers nothing.

        Returns:
            ``(arms, H, W)``; their union is the mask of a :class:`SilhouetteEvaluator` of all arms.

        Raises:
            ValueError: Wrong shape.
        """
        states = self._split(state)
        if not np.isfinite(states).all():
            return np.zeros((len(states), self.camera.height, self.camera.width), dtype=bool)
        return np.stack([arm.evaluator.mask(own) for arm, own in zip(self.arms, states, strict=True)])

    def visible_masks(self, state: ArrayLike) -> NDArray[np.bool_]:
        """Where each arm is seen and not hidden by another.

        Args:
            state: ``(9 * arms,)``.

        Returns:
            ``(arms, H, W)``: no pixel belongs to two arms, and the union is that of the silhouettes. Of arms at the
            same depth the first is seen.

        Raises:
            ValueError: Wrong shape.
        """
        return self._resolve(self._split(state), self.silhouettes(state))

    def depths_m(self, state: ArrayLike) -> FloatArray:
        """Depth of each arm's nearest surface as if it were alone.

        Args:
            state: ``(9 * arms,)``.

        Returns:
            ``(arms, H, W)`` metres along the camera's z at the pixel centres, ``near_m`` where the ray enters the arm
            through the near plane, and inf outside the arm's silhouette.

        Raises:
            ValueError: Wrong shape.
        """
        return self._depths(self._split(state), self.silhouettes(state))

    def front_fractions(self, state: ArrayLike) -> FloatArray:
        """The depth order in short: in which part of the pixels that several arms cover each arm is in front.

        Args:
            state: ``(9 * arms,)``.

        Returns:
            ``(arms,)``, sum 1; NaN where no two arms overlap.

        Raises:
            ValueError: Wrong shape.
        """
        silhouettes = self.silhouettes(state)
        in_front = self._resolve(self._split(state), silhouettes) & _overlap(silhouettes)
        pixels = np.count_nonzero(in_front, axis=(1, 2))
        return pixels / pixels.sum() if pixels.any() else np.full(len(pixels), np.nan)

    def _split(self, state: ArrayLike) -> FloatArray:
        array = np.asarray(state, dtype=np.float64)
        if array.shape != (STATE_SIZE * len(self.arms),):
            raise ValueError(f"state must have shape ({STATE_SIZE * len(self.arms)},); got {array.shape}")
        return split_arms(array)

    def _resolve(self, states: FloatArray, silhouettes: NDArray[np.bool_]) -> NDArray[np.bool_]:
        overlap = _overlap(silhouettes)
        rows, columns = np.nonzero(overlap)
        if len(rows) == 0:
            return silhouettes
        front = self._depths(states, silhouettes & overlap)[:, rows, columns].argmin(axis=0)
        visible: NDArray[np.bool_] = silhouettes & ~overlap
        visible[front, rows, columns] = True
        return visible

    def _depths(self, states: FloatArray, wanted: NDArray[np.bool_]) -> FloatArray:
        """Depths at the wanted pixels of each arm's silhouette ``(arms, H, W)``, inf elsewhere."""
        depths = np.empty(wanted.shape)
        for arm, state, pixels, depth in zip(self.arms, states, wanted, depths, strict=True):
            if pixels.any():
                nearest_surface(arm.points_cam(state), arm.faces, self.lens, pixels, depth)
            else:
                depth[:] = np.inf
        return depths


def _overlap(masks: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels ``(H, W)`` that several of the masks ``(arms, H, W)`` cover."""
    overlap: NDArray[np.bool_] = masks.sum(axis=0, dtype=np.int32) > 1
    return overlap


@compiled(makes_arrays=True)
def nearest_surface(points: Any, faces: Any, lens: Any, wanted: Any, depth: Any) -> None:
    """Depth of a union of closed solids at pixels of its silhouette.

    Args:
        points: ``(V, 3)`` vertices in the camera frame, metres.
        faces: ``(F, 3)``, counter-clockwise seen from outside.
        lens: The camera.
        wanted: ``(H, W)`` bool; true somewhere, and only on the silhouette.
        depth: ``(H, W)``, filled with metres along z where wanted, inf elsewhere.
    """
    depth[:] = np.inf
    room, seen = np.empty(wanted.shape, np.int32), np.empty(points.shape)
    nearest_surface_in(points, faces, lens, wanted, _bounds(wanted), room, seen, depth)


@compiled(makes_arrays=True)
def nearest_surface_in(
    points: Any, faces: Any, lens: Any, wanted: Any, box: Any, room: Any, seen: Any, depth: Any
) -> None:
    """:func:`nearest_surface` in a part of the picture.

    Args:
        points: ``(V, 3)`` vertices in the camera frame, metres.
        faces: ``(F, 3)``, counter-clockwise seen from outside.
        lens: The camera.
        wanted: ``(H, W)`` bool; true somewhere within the box, and there only on the silhouette.
        box: First row, row after the last, first column and column after the last.
        room: ``(H, W)`` int32, scratch.
        seen: ``(V, 3)``, scratch.
        depth: ``(H, W)``, filled within the box.
    """
    # Front faces beyond the near plane, less back faces: below zero where the ray begins inside a solid.
    entered = room if points[:, 2].min() <= lens.near else room[:0]
    entered[box[0] : box[1], box[2] : box[3]] = 0
    corners = np.empty((4, 3))
    depth[box[0] : box[1], box[2] : box[3]] = 0.0  # the inverse, until the end
    for i in range(points.shape[0]):
        _project(points[i, 0], points[i, 1], points[i, 2], lens, seen[i])
    for f in range(faces.shape[0]):
        if _is_aside(points, seen, faces[f], lens, box):
            continue
        count = _clip(points, faces[f], lens, corners)
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


@compiled(makes_arrays=True)
def _bounds(wanted: Any) -> tuple[int, int, int, int]:
    """First row, row after the last, first column and column after the last that hold a wanted pixel."""
    top, bottom, left, right = wanted.shape[0], 0, wanted.shape[1], 0
    for row in range(wanted.shape[0]):
        for column in range(wanted.shape[1]):
            if wanted[row, column]:
                top, bottom = min(top, row), row + 1
                left, right = min(left, column), max(right, column + 1)
    return top, bottom, left, right


@compiled
def place_points(link_transforms: Any, vertex_link: Any, vertices: Any, points: Any) -> None:
    """Fill ``points (V, 3)``: vertices in the camera frame, each moved with its link ``(L, 4, 4)``."""
    for v in range(vertices.shape[0]):
        T = link_transforms[vertex_link[v]]
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        for k in range(3):
            points[v, k] = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3]


@compiled(inline="always", makes_arrays=True)
def _is_aside(points: Any, seen: Any, face: Any, lens: Any, box: Any) -> Any:
    """Whether a face that lies wholly beyond the near plane has no pixel in the box."""
    i, j, k = face[0], face[1], face[2]
    if not min(points[i, 2], points[j, 2], points[k, 2]) > lens.near:
        return False
    top, bottom = min(seen[i, 1], seen[j, 1], seen[k, 1]), max(seen[i, 1], seen[j, 1], seen[k, 1])
    left, right = min(seen[i, 0], seen[j, 0], seen[k, 0]), max(seen[i, 0], seen[j, 0], seen[k, 0])
    return bottom < box[0] or top > box[1] or right < box[2] or left > box[3]


@compiled(inline="always", makes_arrays=True)
def _project(x: float, y: float, z: float, lens: Any, corner: Any) -> None:
    corner[0] = lens.fx * x / z + lens.cx
    corner[1] = lens.fy * y / z + lens.cy
    corner[2] = 1.0 / z


@compiled(makes_arrays=True)
def _clip(points: Any, face: Any, lens: Any, corners: Any) -> int:
    """Corners ``(u, v, 1/z)`` of the part of a face beyond the near plane; returns how many: 0, 3 or 4."""
    count = 0
    for k in range(3):
        i, j = face[k], face[(k + 1) % 3]
        seen = points[i, 2] > lens.near
        if seen:
            _project(points[i, 0], points[i, 1], points[i, 2], lens, corners[count])
            count += 1
        if seen != (points[j, 2] > lens.near):
            if i > j:  # the same numbers for both faces of the edge
                i, j = j, i
            t = (lens.near - points[i, 2]) / (points[j, 2] - points[i, 2])
            x = points[i, 0] + t * (points[j, 0] - points[i, 0])
            y = points[i, 1] + t * (points[j, 1] - points[i, 1])
            _project(x, y, lens.near, lens, corners[count])
            count += 1
    return count


@compiled(makes_arrays=True)
def _inverse_depth_plane(points: Any, face: Any, lens: Any) -> tuple[float, float, float]:
    """``(a, b, c)`` such that ``1/z = a u + b v + c`` on the face's plane; not finite if seen edge-on."""
    o, p, q = points[face[0]], points[face[1]], points[face[2]]
    px, py, pz = p[0] - o[0], p[1] - o[1], p[2] - o[2]
    qx, qy, qz = q[0] - o[0], q[1] - o[1], q[2] - o[2]
    nx, ny, nz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
    offset = nx * o[0] + ny * o[1] + nz * o[2]
    a, b = nx / (lens.fx * offset), ny / (lens.fy * offset)
    return a, b, nz / offset - a * lens.cx - b * lens.cy


@compiled(makes_arrays=True)
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


@compiled(inline="always", makes_arrays=True)
def _column(u: float, box: Any) -> int:
    """First column at or right of u, within the box."""
    return int(np.ceil(min(max(u, float(box[2])), float(box[3]))))


@compiled(makes_arrays=True)
def _depth_of_nearest_edge(points: Any, faces: Any, lens: Any, u: float, v: float, corners: Any) -> float:
    """Depth of the mesh where an edge, as cut by the near plane, comes nearest to a pixel."""
    nearest, w = np.inf, 0.0
    for f in range(faces.shape[0]):
        count = _clip(points, faces[f], lens, corners)
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
