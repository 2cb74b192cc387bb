"""Rows of the leaderboard, derived from records."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surgbench.processes.reference import REFERENCE_MS
from surgbench.records.format import SKIPPED, Record
from surgbench.records.reader import read_records
from surgbench.report.field import Field, filled, keys, number
from surgbench.report.row import (
    COMMON_COLUMNS,
    MACHINE_COLUMNS,
    PROCESSOR,
    REFERENCE_LATENCY,
    Row,
    interval_keys,
    median,
    pooled,
)
from surgbench.report.sequence_means import sequence_means
from surgbench.report.telling import telling_variants
from surgbench.task import Task, default_task, find_task


def read_rows(directories: Iterable[Path]) -> list[Row]:
    """Leaderboard rows of all records below some folders; see :func:`derive_rows`.

    Raises:
        DatasetError: A folder has no records, or one of them is damaged.
    """
    return derive_rows(read_records(directories), reported=True)


def derive_rows(records: Sequence[Record], reported: bool = False) -> list[Row]:
    """Rows per dataset, row id, settings and group (:meth:`surgbench.task.Task.group`), one or several each.

    Args:
        records: In any order; it does not matter.
        reported: With what reports have and reproduced tables have not: the 95 % interval of the error that a task
            ranks by, over sequences, in the row of a whole run; the processor, and latencies as the reference machine
            would have them, in all.

    Returns:
        Rows with the columns of their tasks, ``None`` where there is no value; by dataset and group, sound rows, then
        floors, then failed and skipped ones, each by what its task ranks by. Two datasets of one name get the start of
        their hash added to it; two rows of one name that their variants do not tell apart, to their variants
        (:func:`~surgbench.report.telling.telling_variants`).
    """
    return [row for run in derive_runs(records, reported) for row in run.rows]


@dataclass(frozen=True)
class RowRuns:
    """What :func:`derive_rows` makes of the runs of one row.

    Attributes:
        task: Whose.
        rows: As its task has them.
        records: By unit and repeat.
    """

    task: Task
    rows: list[Row]
    records: list[Record]

    @property
    def whole(self) -> Row:
        """The row that stands for all of it."""
        return next(row for row in self.rows if self.task.is_whole(row))


def derive_runs(records: Sequence[Record], reported: bool = False) -> list[RowRuns]:
    """The rows of :func:`derive_rows` with the records that each is made of, in the same order."""
    groups: dict[tuple[str, str, str, str], list[Record]] = {}
    for record in sorted(records, key=lambda r: (r.spec.unit, r.spec.repeat, r.spec_hash)):
        spec = record.spec
        group = find_task(spec.task).group(record)
        groups.setdefault((spec.dataset.sha256, spec.row_id, record.settings_hash, group), []).append(record)
    namesakes: dict[tuple[str, str, str], list[Record]] = {}
    for (sha256, row_id, _, group), members in groups.items():
        namesakes.setdefault((sha256, row_id, group), []).append(members[0])
    variants = {key: telling_variants(members) for key, members in namesakes.items()}
    names = {record.spec.dataset.sha256: record.spec.dataset.name for record in records}
    ranked: list[tuple[Any, RowRuns]] = []
    for (sha256, row_id, settings_hash, group), members in groups.items():
        task = find_task(members[0].spec.task)
        variant = variants[sha256, row_id, group][settings_hash]
        run = RowRuns(task, task.rows({**_head(members), "variant": variant}, members), members)
        for row in run.rows:
            if list(names.values()).count(row["dataset"]) > 1:
                row["dataset"] = f"{names[sha256]}@{sha256[:8]}"
        if reported:
            _add_machine(run.rows, members)
        if reported and task.ranked_by is not None:
            run.whole.update(_interval(members, task.ranked_by))
        ranked.append(((*_place(task, run.whole, group), sha256, row_id, settings_hash), run))
    ranked.sort(key=lambda item: item[0])
    return [run for _, run in ranked]


def hints(records: Sequence[Record]) -> list[str]:
    """One line for each record that says that something is odd."""
    return [f"{one.spec.row_id} {one.spec.unit}: {one.hint}" for one in records if one.hint is not None]


def columns(rows: Sequence[Row]) -> tuple[Field, ...]:
    """The columns that rows have: those of their task, or of all of their tasks, and further ones that a row fills."""
    tasks = [find_task(name) for name in sorted({row["task"] for row in rows})] or [default_task()]
    return tuple(dict.fromkeys(column for task in tasks for column in (*task.columns, *filled(_further(task), rows))))


def _further(task: Task) -> tuple[Field, ...]:
    ends = () if task.ranked_by is None else number(*interval_keys(task.ranked_by))
    return (*task.further_columns, *ends, *MACHINE_COLUMNS)


def _place(task: Task, row: Row, group: str) -> tuple[Any, ...]:
    error = task.rank(row)
    return (
        row["dataset"],
        group,
        row["status"] != "ok",
        bool(row.get("floor")),
        error is None,
        0.0 if error is None else error,
        row["row_id"],
    )


def _head(records: Sequence[Record]) -> Row:
    """The columns that rows of every task have, without those of the latencies' parts."""
    spec = records[0].spec
    # What failed says more than what was skipped.
    unsound = sorted((r for r in records if r.status != "ok"), key=lambda r: r.status == SKIPPED)
    failed = unsound[0] if unsound else None
    done = sum(len(record.frames.index) for record in records)
    latency = pooled(records, "latency_ms")
    return {
        **dict.fromkeys(keys(COMMON_COLUMNS)),
        "row_id": spec.row_id,
        "task": spec.task,
        "dataset": spec.dataset.name,
        "tracker": spec.tracker.name,
        "settings_hash": records[0].settings_hash,
        "status": failed.status if failed else "ok",
        "error": failed.error if failed else None,
        "sequences": len({record.spec.unit for record in records}),
        "frames": done,
        "repeats": len({record.spec.repeat for record in records}),
        "coverage": done / max(1, _asked(records)),
        "latency_ms": median(latency),
        "latency_ms_p95": float(np.percentile(latency, 95)) if latency.size else None,
        "calibration_ratio": _calibration_ratio(records),
    }


def _interval(records: Sequence[Record], error: str) -> Row:
    """Where the mean over sequences lies, of a task's main error."""
    from surgbench.report.bootstrap import mean_interval  # loads SciPy

    ends = mean_interval([*sequence_means(records, error).values()]) or (None, None)
    return dict(zip(interval_keys(error), ends, strict=True))


def _add_machine(rows: Iterable[Row], records: Sequence[Record]) -> None:
    """Where rows were made, and what their latencies would be on the reference machine, as far as it is known."""
    processors = sorted({record.processor for record in records if record.processor is not None})
    for row in rows:
        if processors:
            row[PROCESSOR] = " and ".join(processors)
        if row["latency_ms"] is not None and row["calibration_ratio"]:
            row[REFERENCE_LATENCY] = row["latency_ms"] / row["calibration_ratio"]


def _calibration_ratio(records: Sequence[Record]) -> float | None:
    """How many times as long as on the reference machine everything takes."""
    times = np.array([record.calibration_ms for record in records if record.calibration_ms is not None])
    middle = median(times)
    return None if middle is None else middle / REFERENCE_MS


def _asked(records: Sequence[Record]) -> int:
    """Frames of the whole dataset, each repeat counted; of the runs alone where their records are of old versions."""
    everything = [record.dataset_frames for record in records if record.dataset_frames is not None]
    if not everything:
        return sum(record.unit_frames for record in records)
    return max(everything) * len({record.spec.repeat for record in records})
