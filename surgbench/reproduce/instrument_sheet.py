"""Tables of the instrument task."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from surgbench.dataset.reader import Dataset
from surgbench.report.records import PER_ARM, Record
from surgbench.report.rows import ERRORS, INSTRUMENT_COLUMNS, SETTING_COLUMNS, Row
from surgbench.reproduce.difficulty import difficulty
from surgbench.reproduce.figure import FIGURE_PNG, draw
from surgbench.reproduce.fingerprint import sequence_head_sha256
from surgbench.reproduce.markdown import markdown
from surgbench.reproduce.sheet import Sheet
from surgbench.reproduce.table import Definition
from surgbench.reproduce.work import BlockWork


def _describe(dataset: Dataset, frames: int) -> dict[str, Any]:
    return {
        "sequences": len(dataset.sequences),
        "frames": sum(sequence.frames for sequence in dataset.sequences),
        "difficulty": difficulty(dataset),
        "first_sha256": {
            sequence.id: sequence_head_sha256(dataset, sequence.id, min(frames, sequence.frames))
            for sequence in dataset.sequences
        },
    }


def _traits(dataset: Dataset, sequence: str) -> Row:
    return {"speed": dataset.sequence(sequence).speed}


def _count(record: Record) -> Row:
    return {"lost_frames": sum(record.frames.lost)}


def _draw(definition: Definition, blocks: Sequence[BlockWork], folder: Path) -> list[str]:
    return [FIGURE_PNG] if draw(definition.table, blocks, folder, folder / FIGURE_PNG) else []


INSTRUMENT_SHEET = Sheet(
    columns=INSTRUMENT_COLUMNS,
    settings=frozenset(SETTING_COLUMNS) - {"iterations", "views", "floor"},
    errors=(*ERRORS, *PER_ARM),
    whole=PER_ARM,
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
)
