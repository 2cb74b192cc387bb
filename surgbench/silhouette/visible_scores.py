"""Scores batches of candidate states of several arms, each arm by what is seen of it against a mask of its own."""

from __future__ import annotations

import operator
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgbench.camera import NEAR_M, Camera
from surgbench.instrument import Instrument
from surgbench.silhouette.evaluator import Reference, most_of
from surgbench.silhouette.layout import assemble, lens
from surgbench.silhouette.overlaps import Arm, arm_scratch, pair_scratch, score_pairs
from surgbench.silhouette.visibility import VisibilityEvaluator
from surgbench.state import STATE_SIZE

PAIR = 2


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

    The counts are those of the masks that a :class:`VisibilityEvaluator` makes; of two arms without making them
    (:mod:`surgbench.silhouette.overlaps`). Calls from several threads wait for one another.

    Args:
        instruments: One per arm; states have ``9 * len(instruments)`` components.
        camera: The view.
        threads: How many threads share a batch, of two arms. The counts are the same for any number.

    Attributes:
        visibility: Makes the masks.

    Raises:
        ValueError: A link's mesh is not closed, or there is no thread.

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

    def __init__(self, instruments: Sequence[Instrument], camera: Camera, threads: int = 1) -> None:
        if operator.index(threads) < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self.instruments = tuple(instruments)
        self.camera = camera
        self.threads = threads
        self.visibility = VisibilityEvaluator(instruments, camera)
        self._lens = lens(camera, NEAR_M)
        self._lock = threading.Lock()
        if len(self.instruments) == PAIR:
            left, right = self.instruments
            one = Arm(*assemble([left]))
            self._arms = one, one if right is left else Arm(*assemble([right]))
            self._make_room(None)

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), (self.instruments, self.camera, self.threads)  # without the scratch

    def _make_room(self, layers: int | None) -> None:
        self._own = [tuple(arm_scratch(arm, self._lens, layers) for arm in self._arms) for _ in range(self.threads)]
        self._layers = [len(one.rows.merged) for one in self._own[0]]
        self._both = [pair_scratch(self._lens, sum(self._layers)) for _ in range(self.threads)]

    def score(self, states: ArrayLike, references: Sequence[Reference]) -> VisibleScore:
        """Areas and overlaps of what is seen.

        Args:
            states: ``(N, 9 * arms)``; of a state that is not finite nothing is seen.
            references: Of each arm a mask of the camera's size.

        Raises:
            ValueError: Wrong shape of states or masks.
        """
        batch = np.array(states, dtype=np.float64, order="C")
        if batch.ndim != 2 or batch.shape[1] != STATE_SIZE * len(self.instruments):
            raise ValueError(f"states must have shape (N, {STATE_SIZE * len(self.instruments)}); got {batch.shape}")
        shapes = [reference.mask.shape for reference in references]
        if shapes != [(self.camera.height, self.camera.width)] * len(self.instruments):
            raise ValueError(
                f"each of {len(self.instruments)} arms needs a mask (H, W) of the camera's "
                f"({self.camera.height}, {self.camera.width}); got {shapes}"
            )
        batch[~np.isfinite(batch).all(axis=1)] = np.nan  # one broken arm leaves nothing
        return self._score_pairs(batch, references) if len(self.instruments) == PAIR else self._paint(batch, references)

    def _score_pairs(self, batch: NDArray[np.float64], references: Sequence[Reference]) -> VisibleScore:
        counts, hidden = np.empty((2, 6, len(batch)), np.int64), np.empty((2, 2, len(batch)), np.int64)
        prefixes = references[0].prefix, references[1].prefix
        with self._lock:
            while not self._fits(self._count_in_threads(batch, prefixes, counts, hidden)):
                pass
        left = counts[:, :2] - hidden
        return VisibleScore(left[:, 0].T, left[:, 1].T, counts[:, 0].T)

    def _count_in_threads(self, batch: Any, prefixes: Any, counts: Any, hidden: Any) -> int:
        taken = np.zeros(len(batch), bool)

        def work(thread: int) -> int:
            scratch = self._own[thread], self._both[thread]
            fixed = self._arms, self._lens
            return int(score_pairs(batch, *fixed, *scratch, prefixes, counts, hidden, taken, thread, self.threads))

        return most_of(work, self.threads)

    def _fits(self, layers: int) -> bool:
        """Whether there was room for so many spans in a row; if not, makes room for twice as many."""
        if layers < min(self._layers) - 1:
            return True
        self._make_room(2 * max(self._layers))
        return False

    def _paint(self, batch: NDArray[np.float64], references: Sequence[Reference]) -> VisibleScore:
        """Of any number of arms, by their masks."""
        masks = np.stack([reference.mask for reference in references])
        alone = np.array([self.visibility.silhouettes(state).sum(axis=(1, 2)) for state in batch])
        seen = [self.visibility.visible_masks(state) for state in batch]
        area = np.array([one.sum(axis=(1, 2)) for one in seen])
        overlap = np.array([(one & masks).sum(axis=(1, 2)) for one in seen])
        shape = len(batch), len(masks)
        return VisibleScore(area.reshape(shape), overlap.reshape(shape), alone.reshape(shape))
