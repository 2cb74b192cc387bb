"""Rows of the leaderboard for the instrument task."""

from __future__ import annotations

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.metrics import POSE_ERRORS, RECOVERED_M
from surgbench.pair_metrics import FAR_OFF_M
from surgbench.report.field import count, flag, number, text
from surgbench.report.losses import LOSS_COLUMNS, loss_row, losses
from surgbench.report.row import COMMON_COLUMNS, Row, median, pooled
from surgbench.report.summary import summarise
from surgbench.reproduce.over_sequences import FRAMES_PER_SECOND, SUFFIX
from surgbench.tasks.instrument.format import ARMS
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

SETTING_COLUMNS = (
    *text("arms"),
    *count("iterations"),
    *text("readings", "initialiser", "keypoints", "filter", "scored"),
    *flag("floor"),
    *count("views"),
    *text("level"),
)
ERRORS = (*POSE_ERRORS[:-1], "mask_error", "mask_error_true", POSE_ERRORS[-1])
INSTRUMENT_COLUMNS = (
    *COMMON_COLUMNS,
    *SETTING_COLUMNS,
    *number(*(f"{error}{suffix}" for error in ERRORS for suffix in ("", "_std", "_sem")), *PER_ARM),
    *count("lost_frames"),
    *number(*SHARES),
)
# Of two arms alone: each arm's own errors are beside those of both.
ARM_ERRORS = tuple((f"{error}_{arm}", error, place) for error in POSE_ERRORS for place, arm in enumerate(ARMS))
PAIR_COLUMNS = (
    *text("masks"),
    *count(*PAIR_COUNTS),
    *number(*PAIR_ERRORS, *(name for name, _, _ in ARM_ERRORS)),
)
# Of recordings alone: rows on datasets with truth have none of these.
RECORDING_COLUMNS = (
    *count("absent_frames"),
    *number(*(f"{error}{suffix}" for error in REFERENCE_ERRORS for suffix in ("", "_std", "_sem"))),
)

# Of rows alone whose masks were made.
SOURCE_COLUMNS = (*text("mask_source"), *number(*(f"{SOURCE_ERROR}{suffix}" for suffix in ("", "_std", "_sem"))))

# Where a table asks for it: of an article that gives them.
SPREAD_COLUMNS = number(
    f"mask_error{SUFFIX}", f"mask_error_true{SUFFIX}", FRAMES_PER_SECOND, FRAMES_PER_SECOND + SUFFIX
)

FURTHER_COLUMNS = (
    *(*RECORDING_COLUMNS, *number(*JUDGED), *PAIR_COLUMNS, *SOURCE_COLUMNS, *SPREAD_COLUMNS),
    *LOSS_COLUMNS,
)


def instrument_row(head: Row, records: list[InstrumentRecord]) -> Row:
    """The row of one row id, settings and number of arms.

    Args:
        head: Columns that rows of every task have.
        records: All of them.
    """
    spec = records[0].spec
    iterations = spec.tracker.options.get("iterations")  # of a stranger's tracker it may be anything
    row = {
        **head,
        "latency_optimise_ms": median(pooled(records, "latency_optimise_ms")),
        "latency_keypoints_ms": median(pooled(records, "latency_keypoints_ms")),
        "latency_masks_ms": median(pooled(records, "latency_masks_ms")),
        "latency_filter_ms": median(pooled(records, "latency_filter_ms")),
        "arms": "single" if len(spec.arms) == 1 else "dual",
        "iterations": iterations if isinstance(iterations, int) else None,
        "readings": spec.readings,
        "initialiser": spec.initialiser.name,
        "keypoints": spec.keypoints.name,
        "filter": spec.filter.name,
        "scored": spec.scored,
        "floor": records[0].floor,
        "views": spec.views,
        "level": spec.level,
    }
    if len(spec.arms) > 1:
        row |= {"masks": spec.masks} | _pair_columns(records)
    if spec.mask_source is not None:
        row |= {"mask_source": spec.mask_source.name} | _spread(records, SOURCE_ERROR)
    for error in ERRORS:
        row |= _spread(records, error)
    row |= {name: summarise(_by_sequence(records, name)).mean for name in PER_ARM}
    row["lost_frames"] = sum(sum(record.frames.lost) for record in records)
    row |= {name: summarise(_by_sequence(records, name)).mean for name in SHARES}
    row |= _losses(records)
    if any(ABSENT in record.errors for record in records):
        row |= _recording_columns(records)
    judged = {name: summarise(_by_sequence(records, name)).mean for name in JUDGED}
    return row | {name: mean for name, mean in judged.items() if mean is not None}


def _pair_columns(records: list[InstrumentRecord]) -> Row:
    """What a row of two arms has besides, as far as it is known."""
    row: Row = {
        name: int(sum(record.errors[name].sum() for record in records if name in record.errors))
        for name in PAIR_COUNTS
        if any(name in record.errors for record in records)
    }
    values = {name: summarise(_by_sequence(records, name)).mean for name in PAIR_ERRORS}
    for name, error, place in ARM_ERRORS:
        # What failed before its first frame has no errors, and no axis of arms.
        own = [[errors.reshape(-1, len(ARMS))[:, place] for errors in one] for one in _by_sequence(records, error)]
        values[name] = summarise(own).mean
    return row | {name: mean for name, mean in values.items() if mean is not None}


def _recording_columns(records: list[InstrumentRecord]) -> Row:
    """What a row on a recording has besides."""
    absent = [record.errors[ABSENT] for record in records if ABSENT in record.errors]
    row: Row = {"absent_frames": int(sum(values.sum() for values in absent))}
    for error in REFERENCE_ERRORS:
        row |= _spread(records, error)
    return row


def _losses(records: list[InstrumentRecord]) -> Row:
    """Of each arm, from its tips far off to its tips right again."""
    return loss_row(
        [losses(arm, FAR_OFF_M, RECOVERED_M) for run in own for arm in np.atleast_2d(run.T)]
        for own in _by_sequence(records, "tip_error_m")
    )


def _spread(records: list[InstrumentRecord], error: str) -> Row:
    summary = summarise(_by_sequence(records, error))
    return {error: summary.mean, f"{error}_std": summary.std, f"{error}_sem": summary.sem}


def _by_sequence(records: list[InstrumentRecord], error: str) -> list[list[FloatArray]]:
    sequences: dict[str, list[FloatArray]] = {}
    for record in records:
        if error in record.errors:
            sequences.setdefault(record.spec.unit, []).append(record.errors[error])
    return list(sequences.values())
