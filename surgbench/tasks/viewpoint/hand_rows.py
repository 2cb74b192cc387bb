"""Columns of rows in which a simulated hand leads the ring."""

from __future__ import annotations

import numpy as np

from surgbench.report.field import count, flag, number, text
from surgbench.report.row import Row
from surgbench.report.summary import summarise
from surgbench.tasks.viewpoint.records import ViewpointRecord
from surgbench.viewpoint.hand.measures import PERFORMANCE

UNFINISHED = "unfinished"
# Means over trials of means over people; ``unfinished`` is counted.
HAND_MEASURES = tuple(name for name in PERFORMANCE if name != UNFINISHED)
HAND_COLUMNS = (
    *text("hand"),
    *flag("steady"),
    *number(*(f"{name}{suffix}" for name in HAND_MEASURES for suffix in ("", "_std", "_sem"))),
    *count(UNFINISHED),
)


def hand_values(records: list[ViewpointRecord]) -> Row:
    """Of one row id and settings; nothing where the trials' own hands led the ring."""
    spec = records[0].spec
    if spec.hand is None:
        return {}
    row: Row = {"hand": spec.hand, "steady": spec.steady, UNFINISHED: sum(unfinished(record) for record in records)}
    for name in HAND_MEASURES:
        trials: dict[str, list[np.ndarray]] = {}
        for record in records:
            trials.setdefault(record.spec.unit, []).append(record.errors.get(name, np.array([])))
        summary = summarise(list(trials.values()))
        row |= {name: summary.mean, f"{name}_std": summary.std, f"{name}_sem": summary.sem}
    return row


def unfinished(record: ViewpointRecord) -> int:
    """Whether the ring did not come back."""
    values = record.errors.get(UNFINISHED, np.array([]))
    return int(np.nansum(values))
