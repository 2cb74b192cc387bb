"""Scores batches of candidate states against a mask, exactly and without rendering an image."""

from __future__ import annotations

import operator
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgbench.camera import NEAR_M, Camera
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.silhouette import kernel
from surgbench.silhouette.boundary import Boundary, boundary_scratch
from surgbench.silhouette.contour import contour_scratch
from surgbench.silhouette.layout import Bodies, Lens, Links, Mesh, assemble, lens
from surgbench.silhouette.spans import add_up, rows_scratch
from surgbench.state import STATE_SIZE


class RowSums:
    """An integer image prepared to be summed over silhouettes: one difference a span.

    Args:
        image: ``(H, W)`` integers or bool; the sum of a row's absolute values must fit 31 bits.

    Attributes:
        prefix: ``(H, W + 1)``: sum of the row left of each column; uint16 for masks, else int32.

    Raises:
        ValueError: Not such an image.
    """

    def __init__(self, image: NDArray[np.integer] | Mask) -> None:
        array = np.array(image, order="C")  # a copy: the caller may go on writing into his
        if array.ndim != 2 or array.dtype.kind not in "biu":
            raise ValueError(f"an image of bool or integers, (H, W), is needed; got {array.dtype} {array.shape}")
        if array.dtype != bool:
            if array.size and np.abs(array.astype(np.float64)).sum(axis=1).max() >= 2**31:
                raise ValueError("the sum of a row's absolute values must fit 31 bits")
            array = array.astype(np.int64)
        height, width = array.shape
        self.prefix: NDArray[np.integer] = np.empty((height, width + 1), np.uint16 if array.dtype == bool else np.int32)
        self._total = int(add_up(array, self.prefix))


class Reference(RowSums):
    """A mask prepared to be scored against.

    Args:
        mask: ``(H, W)`` bool, or integers of which only one is not zero (0 and 1, or 0 and 255).

    Attributes:
        mask: ``(H, W)`` bool, a copy.
        area: Number of its pixels.

    Raises:
        ValueError: Not a mask.

    Example:
        >>> import numpy as np
        >>> from surgbench.silhouette import Reference
        >>> Reference(np.array([[0, 255, 255], [0, 0, 255]], dtype=np.uint8)).area
        3
    """

    def __init__(self, mask: Mask | NDArray[np.integer]) -> None:
        array = np.asarray(mask)
        if array.dtype.kind not in "biu" or (array.dtype != bool and not ((array == 0) | (array == array.max())).all()):
            raise ValueError(f"a mask must be bool, or integers 0 and one other; got {array.dtype}: threshold it first")
        self.mask: Mask = np.array(array, dtype=bool, order="C")
        super().__init__(self.mask)
        self.area = self._total


def iou(area: NDArray[np.int64], overlap: NDArray[np.int64], other_area: int) -> FloatArray:
    """Intersection over union of two masks, from their areas and overlap, pixels; 1 where both are empty.

    Example:
        >>> import numpy as np
        >>> from surgbench.silhouette import iou
        >>> iou(np.array([100, 60]), np.array([60, 0]), 60)  # two masks against one of 60 pixels
        array([0.6, 0. ])
    """
    union = area + other_area - overlap
    return np.where(union > 0, overlap / np.maximum(union, 1), 1.0)


class Score(NamedTuple):
    """What a batch of states covers, pixels.

    Attributes:
        area: ``(N,)`` int64, ``|S|``.
        overlap: ``(N,)`` int64, ``|S and M|``.
        box: ``(N, 4)`` int64, first column, first row, and the column and row after the last; zeros where nothing is
            covered.
    """

    area: NDArray[np.int64]
    overlap: NDArray[np.int64]
    box: NDArray[np.int64]

    def iou(self, reference: Reference) -> FloatArray:
        """Intersection over union with the reference, ``(N,)``; 1 where both are empty."""
        return iou(self.area, self.overlap, reference.area)


class Gradient(NamedTuple):
    """Derivatives of the area integrals behind a :class:`Score`.

    Attributes:
        area: ``(N, 9 * arms)`` float64, pixels per radian or metre.
        overlap: ``(N, 9 * arms)`` float64.
    """

    area: FloatArray
    overlap: FloatArray


class RowCrossings(NamedTuple):
    """Where the visible contour of a silhouette crosses pixel rows, from the top and from left to right.

    Attributes:
        row: ``(K,)`` int64.
        u_px: ``(K,)`` float64, place in the row.
        sign: ``(K,)`` int64, -1 where the silhouette begins and 1 where it ends.
    """

    row: NDArray[np.int64]
    u_px: FloatArray
    sign: NDArray[np.int64]


class ContourPoints(NamedTuple):
    """Samples of the visible contour of a silhouette.

    Attributes:
        points_px: ``(K, 2)`` float64, column and row.
        normals: ``(K, 2)`` float64, of unit length, out of the silhouette.
        lengths_px: ``(K,)`` float64, how much of the contour each stands for.
        arm: ``(K,)`` int64, the arm whose outline it is.
        link: ``(K,)`` int64, which of that arm's links, in the instrument file's order.
        jacobian: ``(K, 9 * arms)`` float64: how far the contour moves along the normal, pixels per radian or metre.
    """

    points_px: FloatArray
    normals: FloatArray
    lengths_px: FloatArray
    arm: NDArray[np.int64]
    link: NDArray[np.int64]
    jacobian: FloatArray


@lru_cache(maxsize=8)
def _helpers(threads: int) -> ThreadPoolExecutor:
    """The threads beside the calling one; shared by all evaluators of the process."""
    return ThreadPoolExecutor(threads - 1, thread_name_prefix="silhouette")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helpers.cache_clear)  # threads do not come along


def most_of(work: Callable[[int], int], threads: int) -> int:
    """The greatest of what ``work`` returns when each of some threads is given its number."""
    if threads == 1:
        return work(0)
    helpers = [_helpers(threads).submit(work, thread) for thread in range(1, threads)]
    try:
        own = work(0)
    finally:
        wait(helpers)  # also when interrupted: they write into an evaluator's scratch
    return max([own, *(helper.result() for helper in helpers)])


class SilhouetteEvaluator:
    """Counts the pixels that instruments cover, for many states at once.

    The counts are those of a rasteriser that tests every pixel centre: parts outside the image, behind the
    camera or crossing the near plane, overlapping arms and interpenetrating parts included. Calls from several threads
    wait for one another.

    Args:
        instruments: One per arm; states have ``9 * len(instruments)`` components.
        camera: The view.
        near_m: Surfaces nearer to the camera plane are not seen.
        threads: How many threads share a batch. The counts are the same for any number.

    Raises:
        ValueError: A link's mesh is not closed, or there is no thread.

    Example:
        A shaft 13 cm away that lies level across the whole image. It is 8.3 mm thick: 200 px * 8.3 / 130, 13 rows.

        >>> import numpy as np
        >>> from surgbench.camera import Camera
        >>> from surgbench.instrument import load_instrument
        >>> from surgbench.silhouette import Reference, SilhouetteEvaluator
        >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
        >>> evaluator = SilhouetteEvaluator([load_instrument("large_needle_driver")], camera)
        >>> state = np.array([0, 0, np.pi / 2, 0.08, 0, 0.13, 0, 0, 0])
        >>> reference = Reference(evaluator.mask(state))
        >>> lower = state + [0, 0, 0, 0, 0.002, 0, 0, 0, 0]  # 2 mm, 3 rows
        >>> score = evaluator.score([state, lower], reference)
        >>> score.area.tolist(), score.overlap.tolist(), score.iou(reference).tolist()
        ([2080, 2080], [2080, 1600], [1.0, 0.625])
    """

    def __init__(
        self, instruments: Sequence[Instrument], camera: Camera, near_m: float = NEAR_M, threads: int = 1
    ) -> None:
        if operator.index(threads) < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self.instruments = tuple(instruments)
        self.camera = camera
        self.threads = threads
        self._lock = threading.Lock()
        self._lens = lens(camera, near_m)
        self._links, self._bodies, self._mesh = assemble(self.instruments)
        self._contours = [contour_scratch(self._links, self._bodies, self._mesh) for _ in range(threads)]
        self._make_room(None)
        self._samples = self._room_for_samples(2 * (camera.width + camera.height))

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        # Made anew rather than copied: parts of the scratch share memory.
        return type(self), (self.instruments, self.camera, self._lens.near, self.threads)

    def _make_room(self, layers: int | None) -> None:
        self._rows = [rows_scratch(self._bodies, self._mesh, self.camera.height, layers) for _ in self._contours]
        self._boundary: Boundary | None = None

    def _scratch_boundary(self) -> Boundary:
        if self._boundary is None:
            room = len(self._rows[0].merged)
            self._boundary = boundary_scratch(self._links, self._bodies, self._mesh, self._lens, room)
        return self._boundary

    def _fits(self, layers: int) -> bool:
        """Whether there was room for so many spans in a row; if not, makes room for twice as many."""
        room = len(self._rows[0].merged)
        if layers < room - 1:
            return True
        self._make_room(2 * room)
        return False

    @property
    def triangles(self) -> int:
        """Number of triangles of all arms."""
        return len(self._mesh.faces)

    def _states(self, states: ArrayLike, ndim: int) -> FloatArray:
        # A copy, which compiled code can take whatever the original is like (read-only, say).
        array = np.array(states, dtype=np.float64, order="C")
        size = STATE_SIZE * len(self.instruments)
        if array.size == 0 and array.ndim == 1 and ndim == 2:
            array = array.reshape(0, size)
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
        counts = self._count(states, reference, 6)
        return Score(counts[0], counts[1], counts[2:].T)

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
        area, total = self._count(states, sums, 2)
        return area, total

    def _count(self, states: ArrayLike, sums: RowSums, numbers: int) -> NDArray[np.int64]:
        batch = self._states(states, 2)
        self._check_image(sums, RowSums)
        counts = np.empty((numbers, len(batch)), np.int64)
        with self._lock:
            while not self._fits(self._count_in_threads(batch, sums, counts)):
                pass
        return counts

    def _check_image(self, image: RowSums, kind: type[RowSums]) -> None:
        if not isinstance(image, kind):
            raise TypeError(f"expected a {kind.__name__}, got {type(image).__name__}: make {kind.__name__}(mask) of it")
        height, width = image.prefix.shape[0], image.prefix.shape[1] - 1
        if (height, width) != (self.camera.height, self.camera.width):
            expected = f"{self.camera.width} x {self.camera.height}"
            raise ValueError(f"the image is {width} x {height}, the camera {expected}")

    @property
    def _fixed(self) -> tuple[Links, Bodies, Mesh, Lens]:
        return self._links, self._bodies, self._mesh, self._lens

    def _count_in_threads(self, batch: FloatArray, sums: RowSums, counts: NDArray[np.int64]) -> int:
        taken = np.zeros(len(batch), bool)

        def work(thread: int) -> int:
            scratch = self._contours[thread], self._rows[thread]
            return int(kernel.score(batch, *self._fixed, *scratch, sums.prefix, counts, taken, thread, self.threads))

        return most_of(work, self.threads)

    def gradient(self, states: ArrayLike, reference: Reference) -> Gradient:
        """Derivatives of area and overlap with respect to each state.

        The counts of :meth:`score` are piecewise constant; this is the gradient of the area integral behind them,

            d/dx int_S w dA = int_(visible contour) w (n . dp/dx) ds,   w = 1 or the reference mask,

        sampled at every row that a steep edge crosses and every column that a flat one does
        (:mod:`surgbench.silhouette.boundary`). Where a facet is seen edge-on the area has a kink, and this is the
        derivative on one side of it.

        Args:
            states: ``(N, 9 * arms)``; a state that is not finite has the gradient zero.
            reference: Mask of the camera's size.

        Raises:
            ValueError: Wrong shape of states or mask.

        Example:
            The shaft of :class:`SilhouetteEvaluator`. A millimetre farther away it is thinner by 1/130, which is 16 of
            its 2080 pixels.

            >>> import numpy as np
            >>> from surgbench.camera import Camera
            >>> from surgbench.instrument import load_instrument
            >>> from surgbench.silhouette import Reference, SilhouetteEvaluator
            >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
            >>> evaluator = SilhouetteEvaluator([load_instrument("large_needle_driver")], camera)
            >>> state = np.array([0, 0, np.pi / 2, 0.08, 0, 0.13, 0, 0, 0])
            >>> gradient = evaluator.gradient([state], Reference(evaluator.mask(state)))
            >>> round(gradient.area[0, 5] / 1000)  # pixels per millimetre of z
            -16
        """
        batch = self._states(states, 2)
        self._check_image(reference, Reference)
        result = np.empty((2, *batch.shape))
        with self._lock:
            while True:
                scratch = self._contours[0], self._scratch_boundary()
                if self._fits(kernel.gradient(batch, *self._fixed, *scratch, reference.mask, result)):
                    return Gradient(result[0], result[1])

    def contour_points(self, state: ArrayLike, spacing_px: int = 2) -> ContourPoints:
        """Sample the visible contour of one state ``(9 * arms,)``, for least-squares trackers.

        Steep parts are sampled on rows and flat ones on columns. Parts of the image's border that the silhouette
        reaches are no contour, nor is where the near plane cuts it.

        Args:
            state: ``(9 * arms,)``.
            spacing_px: Take every so many rows and columns.

        Raises:
            ValueError: Wrong shape, or a spacing below 1.

        Example:
            The shaft of :class:`SilhouetteEvaluator`, upper and lower edge in the image's first column. Moved by 1 mm
            along the camera's y (down), the upper one goes 1.5 px into the silhouette, the lower one 1.5 px out of it.

            >>> import numpy as np
            >>> from surgbench.camera import Camera
            >>> from surgbench.instrument import load_instrument
            >>> from surgbench.silhouette import SilhouetteEvaluator
            >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
            >>> evaluator = SilhouetteEvaluator([load_instrument("large_needle_driver")], camera)
            >>> points = evaluator.contour_points([0, 0, np.pi / 2, 0.08, 0, 0.13, 0, 0, 0])
            >>> points.points_px[:2].round(1)  # column, row
            array([[ 0. , 53.6],
                   [ 0. , 66.4]])
            >>> points.normals[:2, 1].round(9)  # up and down, out of the silhouette
            array([-1.,  1.])
            >>> (points.jacobian[:2, 4] * 0.001).round(1)  # pixels
            array([-1.5,  1.5])
        """
        one = self._states(state, 1)
        spacing = operator.index(spacing_px)
        if spacing < 1:
            raise ValueError(f"spacing_px must be at least 1, got {spacing_px}")
        with self._lock:
            return self._sample(one, int(spacing))

    def _sample(self, one: FloatArray, spacing: int) -> ContourPoints:
        while True:
            samples = self._samples
            scratch = self._contours[0], self._scratch_boundary()
            found, layers = kernel.contour_points(one, spacing, *self._fixed, *scratch, *samples)
            if self._fits(layers) and found <= len(samples.arm):
                return ContourPoints._make(values[:found].copy() for values in samples)
            self._samples = self._room_for_samples(max(len(samples.arm), found))

    def _room_for_samples(self, count: int) -> ContourPoints:
        rates = np.empty((count, STATE_SIZE * len(self.instruments)))
        arm, link = np.empty(count, np.int64), np.empty(count, np.int64)
        return ContourPoints(np.empty((count, 2)), np.empty((count, 2)), np.empty(count), arm, link, rates)

    def row_crossings(self, state: ArrayLike) -> RowCrossings:
        """Where the visible contour of one state ``(9 * arms,)`` crosses the centre lines of pixel rows."""
        one = self._states(state, 1)
        with self._lock:
            while True:
                boundary = self._scratch_boundary()
                found, layers = kernel.row_crossings(one, *self._fixed, self._contours[0], boundary)
                if self._fits(layers):
                    edge = boundary.edge[:found]
                    sign = np.where(boundary.rows.begins[edge], -1, 1)
                    return RowCrossings(boundary.line[:found].astype(np.int64), boundary.at[:found].copy(), sign)

    def mask(self, state: ArrayLike) -> Mask:
        """Silhouette of one state ``(9 * arms,)`` as an ``(H, W)`` bool image."""
        image = np.zeros((self.camera.height, self.camera.width), dtype=bool)
        self.paint(state, image)
        return image

    def paint(self, state: ArrayLike, image: Mask) -> None:
        """Put the silhouette of one state ``(9 * arms,)`` into an ``(H, W)`` image that is false all over."""
        one = self._states(state, 1)
        with self._lock:
            while not self._fits(kernel.paint(one, *self._fixed, self._contours[0], self._rows[0], image)):
                image[:] = False
