"""Rows of the leaderboard for the viewpoint task: one for every subset of the samples.

The subsets are those of the naive pose, and so the same samples for all controllers: ``constrained`` where any rule
speaks against it, ``unconstrained`` where none does, ``solver`` where it is out of the arm's reach or, moved out of the
no-go zone, too near. Samples at which the feature was not measured belong to none.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.metrics import summarise
from surgbench.report.records import ViewpointRecord
from surgbench.report.rows import COMMON_COLUMNS, Row, pooled
from surgbench.viewpoint.placement import CONSTRAINTS
from surgbench.viewpoint.scores import NO_GO_TOLERANCE_M, POSE_ERRORS, SIGNED, TRUE_ERRORS

SUBSETS = ("all", "unconstrained", "constrained", "solver")
ERRORS = (*POSE_ERRORS, SIGNED, *TRUE_ERRORS)
COUNTS = ("limit_violations", "clipped_commands", "no_go_violations")
VIEWPOINT_COLUMNS = (
    *COMMON_COLUMNS,
    "latency_ms_mean", "latency_ms_std", "latency_ms_p999",
    "registration", "missing_face", "subset", "samples",
    *(f"{error}{suffix}" for error in ERRORS for suffix in ("", "_std", "_sem")),
    "constrained_percent", "solver_percent", *COUNTS,
)  # fmt: skip
_SOLVER_BITS = sum(1 << CONSTRAINTS.index(name) for name in ("proximity", "joint_limit"))


def subsets(record: ViewpointRecord) -> dict[str, NDArray[np.bool_]]:
    """Which samples of a record belong to each subset, ``(T,)``."""
    rules, asked = np.array(record.frames.rules, dtype=int), np.array(record.frames.asked, dtype=bool)
    return {
        "all": asked,
        "unconstrained": asked & (rules == 0),
        "constrained": asked & (rules != 0),
        "solver": asked & ((rules & _SOLVER_BITS) != 0),
    }


def viewpoint_rows(head: Row, records: list[ViewpointRecord]) -> list[Row]:
    """One row for every subset that has samples; the subset ``all`` is always there.

    Args:
        head: Columns that do not depend on the subset.
        records: Of one row id and settings.
    """
    latency = pooled(records, "latency_ms")
    common: Row = {
        **head,
        "latency_ms_mean": float(latency.mean()) if latency.size else None,
        "latency_ms_std": float(latency.std(ddof=1)) if latency.size > 1 else None,
        "latency_ms_p999": float(np.percentile(latency, 99.9)) if latency.size else None,
        "registration": records[0].spec.registration,
        "missing_face": records[0].spec.missing_face,
    }
    members = [subsets(record) for record in records]
    rows = [_row(common, name, records, [one[name] for one in members]) for name in SUBSETS]
    for row in rows:
        row["rank_error"] = rows[0]["vva_deg"]
    return [row for row in rows if row["subset"] == "all" or row["samples"]]


def _row(common: Row, subset: str, records: list[ViewpointRecord], chosen: list[NDArray[np.bool_]]) -> Row:
    row: Row = {**common, "subset": subset, "samples": int(sum(mask.sum() for mask in chosen))}
    for error in ERRORS:
        summary = summarise(_by_trial(records, chosen, error))
        row |= {error: summary.mean, f"{error}_std": summary.std, f"{error}_sem": summary.sem}
    row["constrained_percent"] = _percent([np.array(r.frames.rules, dtype=int) != 0 for r in records], chosen)
    row["solver_percent"] = _percent([np.array(r.frames.solver, dtype=bool) for r in records], chosen)
    row["limit_violations"] = _count([np.array(r.frames.limit_violation, dtype=bool) for r in records], chosen)
    row["clipped_commands"] = _count([np.array(r.frames.clipped, dtype=bool) for r in records], chosen)
    row["no_go_violations"] = _count([np.array(r.frames.no_go_depth_m) > NO_GO_TOLERANCE_M for r in records], chosen)
    return row


def _by_trial(records: list[ViewpointRecord], chosen: list[NDArray[np.bool_]], error: str) -> list[list[FloatArray]]:
    trials: dict[str, list[FloatArray]] = {}
    for record, mask in zip(records, chosen, strict=True):
        if error in record.errors:
            trials.setdefault(record.spec.unit, []).append(record.errors[error][mask])
    return list(trials.values())


def _count(flags: list[Any], chosen: list[NDArray[np.bool_]]) -> int:
    return int(sum(values[mask].sum() for values, mask in zip(flags, chosen, strict=True) if len(values)))


def _percent(flags: list[Any], chosen: list[NDArray[np.bool_]]) -> float | None:
    total = sum(int(mask.sum()) for mask in chosen)
    return 100.0 * _count(flags, chosen) / total if total else None
