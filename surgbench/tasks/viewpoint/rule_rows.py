"""Columns of the rules that were broken: events over whole runs, on reported poses and on true ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.report.field import Field, count, number
from surgbench.report.row import Row
from surgbench.tasks.viewpoint.records import ViewpointRecord
from surgbench.viewpoint.placement import CONSTRAINTS
from surgbench.viewpoint.rules import RULE_UNITS, TWINS, broken, depth_name, find_events

UNAVOIDABLE = "unavoidable_samples"
# By the names' ends: of reported poses, and of true ones, which a recording has not.
EVENT_COUNTS = {
    twin: tuple(f"{rule}_{what}{twin}" for rule in CONSTRAINTS for what in ("events", "samples")) for twin in TWINS
}
DEEPEST = {twin: tuple(f"{rule}_deepest_{RULE_UNITS[rule]}{twin}" for rule in CONSTRAINTS) for twin in TWINS}
LONGEST = {twin: tuple(f"{rule}_longest_s{twin}" for rule in CONSTRAINTS) for twin in TWINS}


def rule_fields() -> tuple[Field, ...]:
    """All of them."""
    fields: list[Field] = []
    for twin in TWINS:
        fields += [*count(*EVENT_COUNTS[twin]), *number(*LONGEST[twin], *DEEPEST[twin])]
    return (*fields, *count(UNAVOIDABLE))


def rule_row(records: Sequence[ViewpointRecord]) -> Row:
    """The columns of some runs together: sums of events and samples, and of all events the longest and the deepest.

    All steps count, also those at which the feature was not measured: an arm that waits may be in the way as well.
    Events end with their run. ``None`` where no run has what a column is made of; of counts as reported, 0 where a run
    has done a step.
    """
    row: Row = dict.fromkeys(field.key for field in rule_fields())
    if any(record.frames.index for record in records):
        row |= dict.fromkeys(EVENT_COUNTS[""], 0)
    for twin in TWINS:
        for rule, longest, deepest in zip(CONSTRAINTS, LONGEST[twin], DEEPEST[twin], strict=True):
            depths = [(depth_of(record, rule, twin), record.dt_s) for record in records]
            events = [(find_events(depth, rule), dt_s) for depth, dt_s in depths if len(depth)]
            if not events:
                continue
            row[f"{rule}_events{twin}"] = sum(one.count for one, _ in events)
            row[f"{rule}_samples{twin}"] = sum(one.samples for one, _ in events)
            row[longest] = max(one.longest * (dt_s or 0.0) for one, dt_s in events)
            row[deepest] = max(one.deepest for one, _ in events)
    looked = [record for record in records if record.frames.unavoidable]
    if looked:
        row[UNAVOIDABLE] = sum(_unavoidable(record) for record in looked)
    return row


def depth_of(record: ViewpointRecord, rule: str, twin: str) -> FloatArray:
    """A record's depths ``(T,)`` beyond a rule, NaN where not known; empty where the record has none."""
    return np.array(getattr(record.frames, depth_name(rule, twin)), dtype=np.float64)


def _unavoidable(record: ViewpointRecord) -> int:
    """In how many samples a rule was broken, as reported, that could not have been kept."""
    bits = np.array(record.frames.unavoidable, dtype=int)
    excused = [
        broken(depth_of(record, rule, ""), rule) & ((bits >> bit) & 1).astype(bool)
        for bit, rule in enumerate(CONSTRAINTS)
    ]
    return int(np.any(excused, axis=0).sum())
