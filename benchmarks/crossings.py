"""How arms cross in a dataset that tells them apart: shares of the frames, and events in which one's jaws are hidden.

    surgbench generate occlusion --out data/occlusion
    python benchmarks/crossings.py data/occlusion [--sheet sheet.png] [--runs runs --tracked tracked.png]

An event is a run of frames in which at most a tenth of an arm's wrist and jaws is seen. The sheet shows the longest one
that begins and ends: a row for each of some frames, from before it to after it, with the union, the clean visible
masks, and the observed ones (left orange, right blue, what is neither's grey). The tracked picture has a row for each
tracker of some runs on pairs: what is seen of each arm, and the outlines of the whole arms as they are estimated.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgbench.dataset.masks import encode_image
from surgbench.dataset.open import open_as
from surgbench.geometry import FloatArray
from surgbench.pair_metrics import HIDDEN_SHARE, stretches
from surgbench.records.reader import read_records
from surgbench.report.drawing import below, beside, draw_contours, save_png, scaled, side_label, write_note
from surgbench.silhouette import VisibilityEvaluator
from surgbench.tasks.instrument.dataset import InstrumentDataset, Sequence
from surgbench.tasks.instrument.format import Arm
from surgbench.tasks.instrument.records import InstrumentRecord

LEFT, RIGHT, REST, BACKGROUND = (240, 160, 40), (40, 120, 255), (110, 110, 110), (20, 20, 20)
OUTLINES = (255, 255, 255), (250, 235, 80)
ROWS, AROUND_FRAMES = 5, 20


def events(sequence: Sequence, arm: Arm) -> list[tuple[int, int]]:
    """First frames of a sequence's events, and how many each has."""
    hidden = _shares(sequence, arm)["tool_visible"] <= HIDDEN_SHARE
    return [(first, last - first) for first, last in stretches(hidden)]


def _shares(sequence: Sequence, arm: Arm) -> dict[str, FloatArray]:
    shares = sequence.visibility(arm)
    if shares is None:
        raise SystemExit(f"sequence '{sequence.id}' does not tell its arms apart")
    return shares


def coloured(sequence: Sequence, frame: int, *, clean: bool) -> NDArray[np.uint8]:
    """What is seen of both arms, ``(height, width, 3)`` RGB."""
    read = sequence.clean_mask if clean else sequence.mask
    union = read("both", frame)
    picture = np.full((*union.shape, 3), BACKGROUND, dtype=np.uint8)
    for kind, colour in (("both", REST), ("visible_left", LEFT), ("visible_right", RIGHT)):
        picture[read(kind, frame)] = colour
    return picture


def sheet(sequence: Sequence, start: int, frames: int) -> NDArray[np.uint8]:
    """Rows of pictures, half as large, from before an event to after it."""
    rows = []
    for frame in _around(sequence, start, frames):
        union = np.repeat(sequence.clean_mask("both", frame)[..., None], 3, axis=2).astype(np.uint8) * 255
        cells = [union, coloured(sequence, frame, clean=True), coloured(sequence, frame, clean=False)]
        rows.append(np.concatenate([cell[::2, ::2] for cell in cells], axis=1))
    return np.concatenate(rows)


def tracked(dataset: InstrumentDataset, sequence: Sequence, runs: Path, start: int, frames: int) -> NDArray[np.uint8]:
    """Rows of pictures, half as large, of each tracker's estimates from before an event to after it."""
    instruments = [dataset.instrument(sequence.entry.instruments[arm]) for arm in sequence.arms]
    evaluator = VisibilityEvaluator(instruments, sequence.camera)
    rows = []
    for record in read_records([runs]):
        if not isinstance(record, InstrumentRecord) or record.spec.sequence != sequence.id:
            continue
        states = dict(zip(record.frames.index, record.frames.state, strict=False))
        cells = []
        for frame in _around(sequence, start, frames):
            cell = scaled(coloured(sequence, frame, clean=True), 0.5)
            for silhouette, colour in zip(evaluator.silhouettes(states[frame]), OUTLINES, strict=True):
                draw_contours(cell, silhouette, colour, 2, 0.5)
            write_note(cell, f"frame {frame}", 11)
            cells.append(cell)
        rows.append(beside([side_label(record.spec.row_id, cells[0].shape[0], 14), beside(cells, 3)]))
    if not rows:
        raise SystemExit(f"{runs}: no runs on sequence '{sequence.id}'")
    return below(rows, 3)


def _around(sequence: Sequence, start: int, frames: int) -> list[int]:
    ends = max(start - AROUND_FRAMES, 0), min(start + frames + AROUND_FRAMES, sequence.frames - 1)
    shown: list[int] = np.linspace(*ends, ROWS).round().astype(int).tolist()
    return shown


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--sheet", type=Path, help="PNG of the longest event")
    parser.add_argument("--runs", type=Path, help="runs on pairs of the dataset")
    parser.add_argument("--tracked", type=Path, help="PNG of the longest event, tracked")
    arguments = parser.parse_args()
    dataset = open_as(InstrumentDataset, arguments.dataset)
    found = [(s, arm, *event) for s in dataset.sequences for arm in s.arms for event in events(s, arm)]
    lengths = np.array([frames for *_, frames in found])
    overlap = np.concatenate([np.isfinite(_shares(s, "left")["front"]) for s in dataset.sequences])
    per = {arm: sum(one == arm for _, one, *_ in found) for arm in ("left", "right")}
    print(f"{len(dataset.sequences)} pairs, {len(overlap)} frames; overlapping in {overlap.mean():.3f}")
    print(f"{len(found)} events, {per['left']} of the left arm, {per['right']} of the right")
    if not found:
        return
    print(f"in {lengths.sum() / len(overlap):.3f} of the frames; median {np.median(lengths):.0f}, most {lengths.max()}")
    print("events of at least: " + ", ".join(f"{n} frames {(lengths >= n).sum()}" for n in (5, 15, 30, 45, 60)))
    whole = [event for event in found if event[2] > 0 and event[2] + event[3] < event[0].frames] or found
    sequence, arm, start, frames = max(whole, key=lambda event: event[3])
    print(f"the longest: sequence {sequence.id}, {arm} arm, frames {start} to {start + frames - 1}")
    if arguments.sheet is not None:
        arguments.sheet.write_bytes(encode_image(sheet(sequence, start, frames)))
    if arguments.tracked is not None and arguments.runs is not None:
        save_png(arguments.tracked, tracked(dataset, sequence, arguments.runs, start, frames))


if __name__ == "__main__":
    main()
