"""Keypoint sources on the same labelled masks: what they find, how far off, how long it takes, and where they fail."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.contract import KeypointSource, Observation, Scene, View
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.keypoints.accuracy import REFERENCE_WIDTH, Accuracy, Outcome, accuracy, outcome
from surgbench.keypoints.found import BOTH
from surgbench.keypoints.labelled import LabelledMask, LabelledMasks
from surgbench.state import STATE_SIZE

# So many masks are made before the source is asked for their tips: making a mask would leave its own code and data in
# the processor's caches, and its threads waiting for more.
BLOCK = 50
# Jaw openings that are told apart, radians: closed, as in the datasets, and wider.
OPENINGS_RAD = (0.0, 0.1, 0.35, 0.7, np.inf)
TILE_PX, TILES_ACROSS = 190, 6
# What a tile shows, pixels of an image 700 wide.
TILE_VIEW_PX = 240


@dataclass(frozen=True)
class Seen:
    """One mask and what a source made of it.

    Attributes:
        index: Number of the mask.
        pair: ``(2, 2)`` pixels, or ``None``.
        outcome: Compared with the truth.
        latency_ms: What it took.
        corruption: How the mask was corrupted.
        opening_rad: How far the jaws are open.
    """

    index: int
    pair: FloatArray | None
    outcome: Outcome
    latency_ms: float
    corruption: str
    opening_rad: float


def measure(
    source: KeypointSource, masks: LabelledMasks, instrument: Instrument, progress: Callable[[float], None]
) -> list[Seen]:
    """Ask a source for the tips of every mask; OpenCV is kept to one thread meanwhile.

    Args:
        source: Asked one mask at a time, each as a sequence of one frame.
        masks: With their tips.
        instrument: What the scene says they show.
        progress: Told how many masks more are done.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        seen = []
        for first in range(0, len(masks), BLOCK):
            block = [(index, masks[index]) for index in range(first, min(first + BLOCK, len(masks)))]
            seen += [_see(source, index, example, instrument, progress) for index, example in block]
        return seen
    finally:
        cv2.setNumThreads(before)


def _see(
    source: KeypointSource,
    index: int,
    example: LabelledMask,
    instrument: Instrument,
    progress: Callable[[float], None],
) -> Seen:
    view = View(example.camera, np.eye(4), example.mask, keypoints=(None,))
    source.reset(Scene((instrument,), (view,), (instrument.search_limits,), dt_s=1 / 30, arms=1))
    frame = Observation(0, 0.0, (view,), start=np.zeros(STATE_SIZE))
    begin = time.perf_counter()
    (tips,) = source.detect(frame, view)
    latency_ms = 1e3 * (time.perf_counter() - begin)
    pair = tips if tips is not None and len(tips) == BOTH else None
    progress(1)
    return Seen(index, pair, outcome(example, pair), latency_ms, example.corruption, example.opening_rad)


@dataclass(frozen=True)
class Group:
    """Some of the masks.

    Attributes:
        source: Whose answers.
        by: ``all``, ``corruption`` or ``opening``.
        value: Which of them.
        found: Accuracy on them.
        latency_ms: Median.
    """

    source: str
    by: str
    value: str
    found: Accuracy
    latency_ms: float

    def row(self) -> dict[str, Any]:
        """A row of the table."""
        row = {"keypoints": self.source, "by": self.by, "value": self.value, **self.found.as_dict()}
        return {**row, "latency_ms": round(self.latency_ms, 3)}


def groups(source: str, seen: Sequence[Seen]) -> list[Group]:
    """All masks, and by corruption and jaw opening."""
    result = [_group(source, "all", "all", seen)]
    for name in sorted({one.corruption for one in seen}):
        result.append(_group(source, "corruption", name, [one for one in seen if one.corruption == name]))
    for low, high in pairwise(OPENINGS_RAD):
        part = [one for one in seen if low <= one.opening_rad < high]
        if part:
            name = f"{low:g} to {high:g} rad" if np.isfinite(high) else f"above {low:g} rad"
            result.append(_group(source, "opening", name, part))
    return result


def _group(source: str, by: str, value: str, seen: Sequence[Seen]) -> Group:
    found = accuracy([one.outcome for one in seen])
    return Group(source, by, value, found, float(np.median([one.latency_ms for one in seen])))


def worst(seen: Sequence[Seen], count: int) -> list[Seen]:
    """The worst answers: false pairs, the farthest off first, then missing pairs, then the least exact."""

    def badness(one: Seen) -> tuple[int, float]:
        errors = one.outcome.errors_px
        if errors is None:
            return (1 if one.outcome.asked else -1), 0.0
        return (2 if one.outcome.false else 0), float(np.minimum(errors.max(), 1e6))

    return sorted(seen, key=badness, reverse=True)[:count]


def picture(masks: LabelledMasks, seen: Sequence[Seen]) -> NDArray[np.uint8]:
    """Tiles around the tips: green rings are tips that show, red rings tips that do not, blue crosses what was found.

    Returns:
        ``(H, W, 3)`` uint8, BGR.
    """
    tiles = [_tile(masks[one.index], one) for one in seen]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % TILES_ACROSS)
    rows = [np.hstack(tiles[first : first + TILES_ACROSS]) for first in range(0, len(tiles), TILES_ACROSS)]
    return np.asarray(np.vstack(rows), np.uint8)


def _tile(example: LabelledMask, one: Seen) -> NDArray[np.uint8]:
    scale = TILE_PX / TILE_VIEW_PX * REFERENCE_WIDTH / example.mask.shape[1]
    points = example.tips_px[np.isfinite(example.tips_px).all(axis=1)]
    height, width = example.mask.shape
    centre = np.clip(points.mean(axis=0) if len(points) else [0.0, 0.0], 0.0, [width - 1.0, height - 1.0])
    affine = np.column_stack([scale * np.eye(2), np.full(2, (TILE_PX - 1) / 2) - scale * centre])
    # Outside the image it is grey.
    shade = np.where(example.mask, np.uint8(235), np.uint8(40))
    flat = cv2.warpAffine(shade, affine, (TILE_PX, TILE_PX), flags=cv2.INTER_AREA, borderValue=(110, 110, 110))
    tile = cv2.cvtColor(flat, cv2.COLOR_GRAY2BGR)

    def place(pixel: FloatArray) -> tuple[int, int]:
        u, v = affine[:, :2] @ pixel + affine[:, 2]
        return round(float(u)), round(float(v))

    for tip, shows in zip(example.tips_px, example.shows, strict=True):
        if np.isfinite(tip).all():
            cv2.circle(tile, place(tip), 6, (0, 170, 0) if shows else (40, 40, 230), 2, cv2.LINE_AA)
    for point in () if one.pair is None else one.pair:
        cv2.drawMarker(tile, place(point), (230, 90, 0), cv2.MARKER_TILTED_CROSS, 9, 2, cv2.LINE_AA)
    words = f"#{one.index} {example.corruption}"
    cv2.putText(tile, words, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 210, 255), 1, cv2.LINE_AA)
    tile[:, -1] = tile[-1] = 255
    return np.asarray(tile, np.uint8)
