"""Tables of the instrument task."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from surgbench.report.figures import FIGURE_PNG
from surgbench.report.row import Row
from surgbench.reproduce.results import BlockWork, Results
from surgbench.reproduce.sheet import Sheet
from surgbench.reproduce.table import Definition
from surgbench.tasks.instrument.columns import ABSENT_FRAMES, IN_RECORDINGS, PUBLISHED
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.difficulty import difficulty
from surgbench.tasks.instrument.figure import draw
from surgbench.tasks.instrument.fingerprint import sequence_head_sha256
from surgbench.tasks.instrument.levels import LEVELS_PNG, draw_levels
from surgbench.tasks.instrument.page import markdown
from surgbench.tasks.instrument.records import (
    ABSENT,
    JUDGED,
    PAIR_COUNTS,
    PAIR_ERRORS,
    PER_ARM,
    REFERENCE_ERRORS,
    SHARES,
    SOURCE_ERROR,
    InstrumentRecord,
)
from surgbench.tasks.instrument.rows import ERRORS, FURTHER_COLUMNS, INSTRUMENT_COLUMNS
from surgbench.tasks.instrument.worst import WORST_PNG, draw_worst


def _describe(dataset: InstrumentDataset, frames: int) -> dict[str, Any]:
    return {
        "sequences": len(dataset.sequences),
        "frames": sum(sequence.frames for sequence in dataset.sequences),
        "difficulty": difficulty(dataset),
        "first_sha256": {
            sequence.id: sequence_head_sha256(dataset, sequence.id, min(frames, sequence.frames))
            for sequence in dataset.sequences
        },
    }


def _traits(dataset: InstrumentDataset, sequence: str) -> Row:
    return {"speed": dataset.sequence(sequence).speed}


def _count(record: InstrumentRecord) -> Row:
    counts: Row = {"lost_frames": sum(record.frames.lost)}
    if ABSENT in record.errors:
        counts[ABSENT_FRAMES.key] = int(record.errors[ABSENT].sum())
    return counts | {name: int(record.errors[name].sum()) for name in PAIR_COUNTS if name in record.errors}


def _draw(definition: Definition, blocks: Sequence[BlockWork], results: Results, folder: Path) -> list[str]:
    table = definition.table
    drawn = []
    if table.figure is not None and draw(table, blocks, folder, folder / FIGURE_PNG):
        drawn.append(FIGURE_PNG)
    if draw_levels(table, results.rows, folder / LEVELS_PNG):
        drawn.append(LEVELS_PNG)
    if table.worst is not None and draw_worst(table, blocks, folder, folder / WORST_PNG):
        drawn.append(WORST_PNG)
    return drawn


INSTRUMENT_SHEET = Sheet(
    columns=INSTRUMENT_COLUMNS,
    errors=(*ERRORS, *PER_ARM, *SHARES),
    spreadless=(*PER_ARM, *SHARES, *JUDGED, *PAIR_ERRORS),
    counts=("lost_frames",),
    traits=("speed",),
    no_difference={
        "rotation_error_rad": 1e-3,
        "translation_error_m": 5e-5,
        "tip_error_m": 5e-5,
        "q1_error_rad": 1e-3,
        "q2_error_rad": 1e-3,
        "q3_error_rad": 1e-3,
        "keypoint_error_px": 0.2,
        "mask_error": 1e-3,
        "mask_error_true": 1e-3,
    },
    traits_of=_traits,
    count=_count,
    describe=_describe,
    page=markdown,
    draw=_draw,
    estimates="state",
    measures=PUBLISHED,
    instead=IN_RECORDINGS,
    further_columns=FURTHER_COLUMNS,
    further_errors=(*REFERENCE_ERRORS, *JUDGED, *PAIR_ERRORS, SOURCE_ERROR),
    further_counts=(ABSENT_FRAMES.key, *PAIR_COUNTS),
)
