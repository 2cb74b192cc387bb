"""Scores batches of candidate states of several arms, each arm by what is seen of it against a mask of its own.

What an arm covers alone is counted without an image. Only states whose arms overlap in the picture are looked at pixel
by pixel, and of those only the box in which they may: there, what an arm hides of another is counted and taken off.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgbench.camera import Camera
from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.silhouette.evaluator import Reference
from surgbench.silhouette.visibility import VisibilityEvaluator, nearest_surface_in
from surgbench.state import STATE_SIZE, split_arms


class VisibleScore(NamedTuple):
    """What is seen of each arm in a batch of states, pixels.

    Attributes:
        area: ``(N, arms)`` int64, of its part that no other arm hides.
        overlap: ``(N, arms)`` int64, of that part and the arm's own mask.
        silhouette: ``(N, arms)`` int64, area of the arm alone, hidden or not.
    """

    area: NDArray[np.int64]
    overlap: NDArray[np.int64]
    silhouette: NDArray[np.int64]


class VisibleScorer:
    """Counts what is seen of each of several arms, for many states at once.

    The counts are those of the masks that a :class:`VisibilityEvaluator` makes.

    Args:
        instruments: One per arm; states have ``9 * len(instruments)`` components.
        camera: The view.

    Example:
        Two shafts that lie level across the whole image, the right one nearer, and the left one in its shadow:

        >>> import numpy as np
        >>> from surgbench.camera import Camera
        >>> from surgbench.instrument import load_instrument
        >>> from surgbench.silhouette import Reference, VisibleScorer
        >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
        >>> scorer = VisibleScorer([load_instrument("large_needle_driver")] * 2, camera)
        >>> states = [[0, 0, np.pi / 2, 0.08, 0, 0.16, 0, 0, 0] + [0, 0, np.pi / 2, 0.08, 0, 0.13, 0, 0, 0]]
        >>> everywhere = Reference(np.ones((120, 160), dtype=bool))
        >>> score = scorer.score(states, [everywhere, everywhere])
        >>> score.area, score.silhouette
        (array([[   0, 2080]]), array([[1760, 2080]]))
    """

    def __init__(self, instruments: Sequence[Instrument], camera: Camera) -> None:
        self.instruments = tuple(instruments)
        self.camera = camera
        self.visibility = VisibilityEvaluator(instruments, camera)
        shape = (len(instruments), camera.height, camera.width)
        self._images = np.zeros(shape, dtype=bool)
        self._depths = np.empty(shape)
        self._wanted = np.zeros(shape[1:], dtype=bool)
        self._room = np.empty(shape[1:], dtype=np.int32)
        self._seen = [np.empty_like(arm.vertices_m) for arm in self.visibility.arms]

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), (self.instruments, self.camera)  # without the scratch

    def score(self, states: ArrayLike, references: Sequence[Reference]) -> VisibleScore:
        """Areas and overlaps of what is seen.

        Args:
            states: ``(N, 9 * arms)``; of a state that is not finite nothing is seen.
            references: Of each arm a mask of the camera's size.

        Raises:
            ValueError: Wrong shape of states or masks.
        """
        arms = self.visibility.arms
        batch = np.array(states, dtype=np.float64, order="C")
        if batch.ndim != 2 or batch.shape[1] != STATE_SIZE * len(arms):
            raise ValueError(f"states must have shape (N, {STATE_SIZE * len(arms)}); got {batch.shape}")
        batch[~np.isfinite(batch).all(axis=1)] = np.nan  # one broken arm leaves nothing
        parts = split_arms(batch)
        alone = [
            arm.evaluator.score(parts[:, place], reference)
            for place, (arm, reference) in enumerate(zip(arms, references, strict=True))
        ]
        silhouette = np.stack([score.area for score in alone], axis=1)
        overlap = np.stack([score.overlap for score in alone], axis=1)
        boxes = np.stack([score.box for score in alone])
        hidden = np.zeros((len(batch), len(arms), 2), dtype=np.int64)
        common = _common(boxes)
        close = np.flatnonzero((common[:, 0] < common[:, 1]) & (common[:, 2] < common[:, 3]))
        if len(close):
            masks = np.stack([reference.mask for reference in references])
            placed = [arm.instrument.link_transforms(parts[close, place]) for place, arm in enumerate(arms)]
            for index, number in enumerate(close):
                transforms = [links[index] for links in placed]
                self._count_hidden(parts[number], transforms, tuple(common[number]), masks, hidden[number])
        return VisibleScore(silhouette - hidden[..., 0], overlap - hidden[..., 1], silhouette)

    def _count_hidden(
        self, states: FloatArray, transforms: list[FloatArray], box: Any, masks: NDArray[np.bool_], hidden: Any
    ) -> None:
        """Pixels ``(arms, 2)`` of each arm that another hides, and those of them that are in the arm's mask."""
        for arm, state, image in zip(self.visibility.arms, states, self._images, strict=True):
            arm.evaluator.paint(state, image)
        found = _overlap_in(self._images, box, self._wanted)
        if found[0] < found[1]:
            scratch = zip(self._images, self._seen, self._depths, strict=True)
            for arm, links, (image, seen, depth) in zip(self.visibility.arms, transforms, scratch, strict=True):
                # Of two arms both cover all of these pixels; of more, not all do.
                own = self._wanted if len(self._images) == 2 else image & self._wanted
                points, lens = arm.points_of(links), self.visibility.lens
                nearest_surface_in(points, arm.faces, lens, own, found, self._room, seen, depth)
            _count(self._images, self._depths, self._wanted, masks, found, hidden)
        self._images[:] = False


def _common(boxes: NDArray[np.int64]) -> NDArray[np.int64]:
    """``(N, 4)`` first row, row after the last, first column and column after the last where two arms may overlap.

    Args:
        boxes: ``(arms, N, 4)`` first column, first row, and the column and row after the last.
    """
    arms, count = boxes.shape[:2]
    low, high = np.full((count, 2), np.iinfo(np.int64).max), np.zeros((count, 2), dtype=np.int64)
    for one in range(arms):
        for other in range(one):
            first = np.maximum(boxes[one, :, :2], boxes[other, :, :2])
            last = np.minimum(boxes[one, :, 2:], boxes[other, :, 2:])
            meet = (first < last).all(axis=1, keepdims=True)
            low, high = np.where(meet, np.minimum(low, first), low), np.where(meet, np.maximum(high, last), high)
    return np.stack([low[:, 1], high[:, 1], low[:, 0], high[:, 0]], axis=1)


@compiled
def _overlap_in(images: Any, box: Any, wanted: Any) -> Any:
    """Mark within a box the pixels that several of the images ``(arms, H, W)`` cover; returns the box of those."""
    top, bottom, left, right = box[1], box[0], box[3], box[2]
    for row in range(box[0], box[1]):
        line = wanted[row, box[2] : box[3]]
        line[:] = False
        for one in range(1, images.shape[0]):
            first = images[one, row, box[2] : box[3]]
            for other in range(one):
                second = images[other, row, box[2] : box[3]]
                for place in range(line.shape[0]):
                    line[place] |= first[place] & second[place]
        begin, end = 0, line.shape[0]
        while begin < end and not line[begin]:
            begin += 1
        while begin < end and not line[end - 1]:
            end -= 1
        if begin < end:
            top, bottom = min(top, row), max(bottom, row + 1)
            left, right = min(left, box[2] + begin), max(right, box[2] + end)
    return top, bottom, left, right


@compiled
def _count(images: Any, depths: Any, wanted: Any, masks: Any, box: Any, hidden: Any) -> None:
    """Add up what each arm has of the pixels that several cover and in which another one is nearer."""
    for row in range(box[0], box[1]):
        for column in range(box[2], box[3]):
            if not wanted[row, column]:
                continue
            front, nearest = -1, np.inf
            for arm in range(images.shape[0]):
                if images[arm, row, column] and depths[arm, row, column] < nearest:
                    front, nearest = arm, depths[arm, row, column]
            for arm in range(images.shape[0]):
                if images[arm, row, column] and arm != front:
                    hidden[arm, 0] += 1
                    hidden[arm, 1] += masks[arm, row, column]
