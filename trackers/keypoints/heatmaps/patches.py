"""What the network is trained on: squares cut from labelled masks, larger than needed, and random looks at them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.keypoints.accuracy import REFERENCE_WIDTH, is_asked
from surgbench.keypoints.labelled import LabelledMasks
from surgbench.processes.ending import end_worker_with_parent
from surgbench.processes.interruption import without_ctrl_c
from surgbench.trackers.keypoints.heatmaps.square import OUTSIDE, find_square

# A patch shows this much more than the square, at this many pixels to one of the network's picture, so that it can be
# looked at from a little to the side, turned or nearer.
GROWTH = 1.5
DETAIL = 4 / 3
CHUNK = 100


@dataclass(frozen=True)
class Patches:
    """``n`` patches.

    Attributes:
        pictures: ``(n, p, p)`` uint8.
        tips: ``(n, 2, 2)`` column and row of each tip in its patch, NaN outside the image. Tips that do not show are
            learnt too: where a mask says little of them the heat spreads and no peak stands out, and where it says
            enough the pair is worth having.
        asked: ``(n,)`` bool: both tips show and are apart, so that a pair is to be found.
        unit_px: ``(n,)`` pixels of an image 700 wide to one of the network's picture.
        size: Side of the network's picture.
    """

    pictures: NDArray[np.uint8]
    tips: FloatArray
    asked: NDArray[np.bool_]
    unit_px: FloatArray
    size: int

    def __len__(self) -> int:
        return len(self.pictures)

    def look(
        self, index: int, turn_rad: float, scale: float, mirror: bool, shift: FloatArray
    ) -> tuple[NDArray[np.uint8], FloatArray]:
        """One patch as the network's picture.

        Args:
            index: Which.
            turn_rad: By how much it is turned.
            scale: How much larger the instrument is than it would be.
            mirror: Left and right exchanged: another instrument turned by other joints, near enough.
            shift: ``(2,)`` by which share of the picture's side it is moved.

        Returns:
            ``(size, size)`` uint8, and ``(2, 2)`` column and row of the tips in it.
        """
        patch = self.pictures.shape[1]
        cos, sin = np.cos(turn_rad), np.sin(turn_rad)
        across = -1.0 if mirror else 1.0
        linear = scale * self.size * GROWTH / patch * np.array([[across * cos, -sin], [across * sin, cos]])
        offset = (self.size - 1) / 2 + self.size * shift - linear @ np.full(2, (patch - 1) / 2)
        affine = np.column_stack([linear, offset])
        whole = (self.size, self.size)
        picture = cv2.warpAffine(self.pictures[index], affine, whole, flags=cv2.INTER_LINEAR, borderValue=OUTSIDE)
        return np.asarray(picture, np.uint8), self.tips[index] @ linear.T + offset

    def looks(
        self, indices: NDArray[np.int64], rng: np.random.Generator | None
    ) -> tuple[NDArray[np.uint8], FloatArray]:
        """Several, each turned, moved and scaled at random; as they are where there is no generator.

        Returns:
            ``(k, size, size)`` uint8 and ``(k, 2, 2)``.
        """
        pictures = np.empty((len(indices), self.size, self.size), np.uint8)
        tips = np.empty((len(indices), 2, 2))
        for place, index in enumerate(indices):
            change = (0.0, 1.0, False, np.zeros(2)) if rng is None else _draw(rng)
            pictures[place], tips[place] = self.look(int(index), *change)
        return pictures, tips


def _draw(rng: np.random.Generator) -> tuple[float, float, bool, FloatArray]:
    return (
        rng.uniform(-0.35, 0.35),
        float(np.exp(rng.uniform(-0.12, 0.12))),
        bool(rng.random() < 0.5),
        rng.uniform(-0.06, 0.06, 2),
    )


def cut_patches(masks: LabelledMasks, size: int, jobs: int, progress: Callable[[float], None]) -> Patches:
    """Make masks and cut a patch from each.

    Args:
        masks: Of which those without an instrument are left out; must be picklable for more than one job.
        size: Side of the network's picture.
        jobs: Worker processes. The patches do not depend on it.
        progress: Told how many masks more are done.

    Raises:
        SurgbenchError: No mask shows an instrument.
    """
    chunks = [range(first, min(first + CHUNK, len(masks))) for first in range(0, len(masks), CHUNK)]
    patch = _patch_px(size)
    # The pictures go where they will stay: they are most of the memory.
    pictures = np.empty((len(masks), patch, patch), np.uint8)
    count, labels = 0, []
    for chunk, (cut, *others) in zip(chunks, _in_order(partial(_cut, masks, size), chunks, jobs), strict=True):
        pictures[count : count + len(cut)] = cut
        count += len(cut)
        labels.append(others)
        progress(len(chunk))
    tips, asked, unit_px = (np.concatenate(parts) for parts in zip(*labels, strict=True))
    if not count:
        raise SurgbenchError(f"no instrument is seen in any of {len(masks)} masks; see data in the training file")
    return Patches(pictures[:count], tips, asked, unit_px, size)


def _in_order(work: Callable[[range], _Cuts], chunks: list[range], jobs: int) -> Iterator[_Cuts]:
    if jobs == 1:
        yield from map(work, chunks)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=end_worker_with_parent) as pool:
        try:
            # Workers start in here, and keep the block.
            with without_ctrl_c():
                results = pool.map(work, chunks)
            yield from results
        except BrokenProcessPool:
            raise SurgbenchError(
                "a worker process was killed (out of memory?); run the same command again, with fewer --jobs"
            ) from None
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _patch_px(size: int) -> int:
    return round(size * GROWTH * DETAIL)


_Cuts = tuple[NDArray[np.uint8], FloatArray, NDArray[np.bool_], FloatArray]


def _cut(masks: LabelledMasks, size: int, indices: range) -> _Cuts:
    cv2.setNumThreads(1)
    patch = _patch_px(size)
    pictures, tips, asked, units = [], [], [], []
    for index in indices:
        example = masks[index]
        square = find_square(example.mask)
        if square is None:
            continue
        larger = square.grown(GROWTH)
        affine = larger.to_square(patch)
        inside = example.camera.contains(example.tips_px)
        pictures.append(larger.cut(example.mask, patch))
        tips.append(np.where(inside[:, None], example.tips_px @ affine[:, :2].T + affine[:, 2], np.nan))
        asked.append(is_asked(example))
        units.append(square.side_px / size * REFERENCE_WIDTH / example.mask.shape[1])
    return (
        np.array(pictures, np.uint8).reshape(-1, patch, patch),
        np.array(tips, np.float64).reshape(-1, 2, 2),
        np.array(asked, np.bool_),
        np.array(units, np.float64),
    )
