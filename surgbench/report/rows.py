"""Rows of the leaderboard, derived from records."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.metrics import POSE_ERRORS, summarise
from surgbench.report.records import PER_ARM, SKIPPED, AnyRecord, Record, Spec, ViewpointRecord, read_all_records

Row = dict[str, Any]

COMMON_COLUMNS = (
    "row_id", "task", "dataset", "tracker", "variant", "settings_hash", "status", "error", "sequences", "frames",
    "repeats", "coverage", "latency_ms", "latency_ms_p95", "latency_optimise_ms", "latency_keypoints_ms",
    "latency_masks_ms", "latency_filter_ms", "calibration_ratio",
)  # fmt: skip
SETTING_COLUMNS = ("arms", "iterations", "readings", "initialiser", "keypoints", "filter", "floor", "views", "level")
ERRORS = (*POSE_ERRORS[:-1], "mask_error", "mask_error_true", POSE_ERRORS[-1])
INSTRUMENT_COLUMNS = (
    *COMMON_COLUMNS,
    *SETTING_COLUMNS,
    *(f"{error}{suffix}" for error in ERRORS for suffix in ("", "_std", "_sem")),
    *PER_ARM,
    "lost_frames",
)


def read_rows(directories: Iterable[Path]) -> list[Row]:
    """Leaderboard rows of all records below some folders; see :func:`derive_rows`.

    Raises:
        DatasetError: A folder has no records, or one of them is damaged.
    """
    return derive_rows(read_all_records(directories))


def derive_rows(records: Sequence[AnyRecord]) -> list[Row]:
    """Rows per dataset, row id, settings and number of arms: one of instrument trackers, several of controllers.

    Args:
        records: In any order; it does not matter.

    Returns:
        Rows with the keys ``INSTRUMENT_COLUMNS`` or ``surgbench.viewpoint.rows.VIEWPOINT_COLUMNS``, ``None`` where
        there is no value; by dataset and arms, sound rows, then floors, then failed and skipped ones, each by mask
        error or viewing angle. Two datasets of one name get the start of their hash added to it.
    """
    groups: dict[tuple[str, str, str, int], list[AnyRecord]] = {}
    for record in sorted(records, key=lambda r: (r.spec.unit, r.spec.repeat, r.spec_hash)):
        spec = record.spec
        # The same settings may be run on single arms and on pairs; those are not one row.
        arms = len(spec.arms) if isinstance(spec, Spec) else 0
        groups.setdefault((spec.dataset.sha256, spec.row_id, record.settings_hash, arms), []).append(record)
    names = {record.spec.dataset.sha256: record.spec.dataset.name for record in records}
    rows = [(key, row) for key, group in groups.items() for row in _rows(group)]
    for (sha256, *_), row in rows:
        if list(names.values()).count(row["dataset"]) > 1:
            row["dataset"] = f"{names[sha256]}@{sha256[:8]}"
    rows.sort(key=lambda item: (_rank(item[1]), item[0]))
    return [row for _, row in rows]


def columns(rows: Sequence[Row]) -> tuple[str, ...]:
    """The columns that rows have: those of their task, or of both tasks."""
    from surgbench.viewpoint.rows import VIEWPOINT_COLUMNS

    of_task = {"instrument": INSTRUMENT_COLUMNS, "viewpoint": VIEWPOINT_COLUMNS}
    found = {row["task"] for row in rows} or {"instrument"}
    return tuple(dict.fromkeys(column for task, own in of_task.items() if task in found for column in own))


def _rows(records: list[AnyRecord]) -> list[Row]:
    """The rows of one row id and settings; all records are of one task."""
    from surgbench.viewpoint.rows import viewpoint_rows

    head = _head(records)
    instrument = [record for record in records if isinstance(record, Record)]
    viewpoint = [record for record in records if isinstance(record, ViewpointRecord)]
    return [_row(head, instrument)] if instrument else viewpoint_rows(head, viewpoint)


def _rank(row: Row) -> tuple[Any, ...]:
    error = row["mask_error"] if row["task"] == "instrument" else row["rank_error"]
    return (
        row["dataset"],
        row.get("arms") == "dual",
        row["status"] != "ok",
        row.get("floor"),
        error is None,
        0.0 if error is None else error,
        row["row_id"],
    )


def _head(records: Sequence[AnyRecord]) -> Row:
    """The columns that rows of every task have, without those of the latencies' parts."""
    spec = records[0].spec
    # What failed says more than what was skipped.
    unsound = sorted((r for r in records if r.status != "ok"), key=lambda r: r.status == SKIPPED)
    failed = unsound[0] if unsound else None
    done = sum(len(record.frames.index) for record in records)
    latency = pooled(records, "latency_ms")
    return {
        **dict.fromkeys(COMMON_COLUMNS),
        "row_id": spec.row_id,
        "task": spec.task,
        "dataset": spec.dataset.name,
        "tracker": spec.tracker.name,
        "variant": records[0].variant,
        "settings_hash": records[0].settings_hash,
        "status": failed.status if failed else "ok",
        "error": failed.error if failed else None,
        "sequences": len({record.spec.unit for record in records}),
        "frames": done,
        "repeats": len({record.spec.repeat for record in records}),
        "coverage": done / max(1, _asked(records)),
        "latency_ms": _median(latency),
        "latency_ms_p95": float(np.percentile(latency, 95)) if latency.size else None,
    }


def _row(head: Row, records: list[Record]) -> Row:
    spec = records[0].spec
    row = {
        **head,
        "latency_optimise_ms": _median(pooled(records, "latency_optimise_ms")),
        "latency_keypoints_ms": _median(pooled(records, "latency_keypoints_ms")),
        "latency_masks_ms": _median(pooled(records, "latency_masks_ms")),
        "latency_filter_ms": _median(pooled(records, "latency_filter_ms")),
        "arms": "single" if len(spec.arms) == 1 else "dual",
        "iterations": spec.tracker.options.get("iterations"),
        "readings": spec.readings,
        "initialiser": spec.initialiser.name,
        "keypoints": spec.keypoints.name,
        "filter": spec.filter.name,
        "floor": records[0].floor,
        "views": spec.views,
        "level": spec.level,
    }
    for error in ERRORS:
        summary = summarise(_by_sequence(records, error))
        row |= {error: summary.mean, f"{error}_std": summary.std, f"{error}_sem": summary.sem}
    row |= {name: summarise(_by_sequence(records, name)).mean for name in PER_ARM}
    row["lost_frames"] = sum(sum(record.frames.lost) for record in records)
    return row


def _asked(records: Sequence[AnyRecord]) -> int:
    """Frames of the whole dataset, each repeat counted; of the runs alone where their records are of old versions."""
    everything = [record.dataset_frames for record in records if record.dataset_frames is not None]
    if not everything:
        return sum(record.unit_frames for record in records)
    return max(everything) * len({record.spec.repeat for record in records})


def _by_sequence(records: list[Record], error: str) -> list[list[FloatArray]]:
    sequences: dict[str, list[FloatArray]] = {}
    for record in records:
        if error in record.errors:
            sequences.setdefault(record.spec.unit, []).append(record.errors[error])
    return list(sequences.values())


def pooled(records: Sequence[AnyRecord], key: str) -> FloatArray:
    """Values of all frames of some records, without NaN."""
    values = np.array([value for record in records for value in getattr(record.frames, key)], dtype=np.float64)
    return values[~np.isnan(values)]


def _median(values: FloatArray) -> float | None:
    return float(np.median(values)) if values.size else None
