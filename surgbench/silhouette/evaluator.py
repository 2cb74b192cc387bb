"""Scores batches of candidate states against a mask, exactly and without rendering an image."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgbench.camera import Camera
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.silhouette import kernel
from surgbench.silhouette.contour import contour_scratch
from surgbench.silhouette.layout import NEAR_M, assemble, lens
from surgbench.silhouette.spans import rows_scratch
from surgbench.state import STATE_SIZE


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


@lru_cache(maxsize=8)
def _helpers(threads: int) -> ThreadPoolExecutor:
    """The threads beside the calling one; shared by all evaluators of the process."""
    return ThreadPoolExecutor(threads - 1, thread_name_prefix="silhouette")


class SilhouetteEvaluator:
    """Counts the pixels that instruments cover, for many states at once.

    The counts are those of a rasteriser that tests every pixel centre: parts outside the image, behind the
    camera or crossing the near plane, overlapping arms and interpenetrating parts included.

    Args:
        instruments: One per arm; states have ``9 * len(instruments)`` components.
        camera: The view.
        near_m: Surfaces nearer to the camera plane are not seen.
        threads: How many threads share a batch. The counts are the same for any number.

    Raises:
        ValueError: A link's mesh is not closed, or there is no thread.
    """

    def __init__(
        self, instruments: Sequence[Instrument], camera: Camera, near_m: float = NEAR_M, threads: int = 1
    ) -> None:
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self.instruments = tuple(instruments)
        self.camera = camera
        self.threads = threads
        self._lens = lens(camera, near_m)
        self._links, self._bodies, self._mesh = assemble(self.instruments)
        self._contours = [contour_scratch(self._links, self._bodies, self._mesh) for _ in range(threads)]
        self._make_room(None)

    def _make_room(self, layers: int | None) -> None:
        self._rows = [rows_scratch(self._bodies, self._mesh, self.camera.height, layers) for _ in self._contours]

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
        counts = np.empty((2, len(batch)), np.int64)
        while not self._fits(self._score(batch, sums, counts)):
            pass
        return counts[0], counts[1]

    def _score(self, batch: FloatArray, sums: RowSums, counts: NDArray[np.int64]) -> int:
        taken = np.zeros(len(batch), bool)
        fixed = self._links, self._bodies, self._mesh, self._lens

        def work(thread: int) -> int:
            scratch = self._contours[thread], self._rows[thread]
            return int(kernel.score(batch, *fixed, *scratch, sums.prefix, counts, taken, thread, self.threads))

        if self.threads == 1:
            return work(0)
        helpers = [_helpers(self.threads).submit(work, thread) for thread in range(1, self.threads)]
        return max([work(0), *(helper.result() for helper in helpers)])

    def mask(self, state: ArrayLike) -> Mask:
        """Silhouette of one state ``(9 * arms,)`` as an ``(H, W)`` bool image."""
        one = self._states(state, 1)
        image = np.zeros((self.camera.height, self.camera.width), dtype=bool)
        fixed = self._links, self._bodies, self._mesh, self._lens
        while not self._fits(kernel.paint(one, *fixed, self._contours[0], self._rows[0], image)):
            image[:] = False
        return image
