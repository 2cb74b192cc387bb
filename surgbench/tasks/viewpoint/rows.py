"""Rows of the leaderboard for the viewpoint task: one for every subset of the samples.

The subsets are those of the naive pose, and so the same samples for all controllers: ``constrained`` where any rule
speaks against it, ``unconstrained`` where none does, ``solver`` where it is on the right side, but out of the arm's
reach or, moved out of the no-go zone, too near. ``optimised`` alone is the controller's own: the samples in which it
says that it optimised. Samples at which the feature was not measured belong to none. What is said of whole runs, rules
that were broken and whether the feature was seen, stands in the row of all samples alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.report.field import count, flag, keys, number, text
from surgbench.report.row import COMMON_COLUMNS, Row
from surgbench.report.summary import summarise
from surgbench.tasks.viewpoint.hand_rows import hand_values
from surgbench.tasks.viewpoint.picture_rows import (
    SOURCES,
    framed_row,
    lost_row,
    picture_fields,
    picture_rows,
    visibility_row,
)
from surgbench.tasks.viewpoint.records import ViewpointRecord
from surgbench.tasks.viewpoint.rule_rows import rule_fields, rule_row
from surgbench.viewpoint.disturbance import Disturbance
from surgbench.viewpoint.optics.centroids import ERRORS as PIXEL_ERRORS
from surgbench.viewpoint.placement import CONSTRAINTS
from surgbench.viewpoint.scores import POSE_ERRORS, SIGNED, TRUE_ERRORS

SUBSETS = ("all", "unconstrained", "constrained", "solver", "optimised")
ERRORS = (*POSE_ERRORS, SIGNED, *TRUE_ERRORS)
LATENCIES = ("latency_ms", "latency_ms_p95", "latency_ms_mean", "latency_ms_std", "latency_ms_p999")
CLIPPED = "clipped_commands"
VIEWPOINT_COLUMNS = (
    *COMMON_COLUMNS,
    *number("latency_ms_mean", "latency_ms_std", "latency_ms_p999"),
    *text("registration"),
    *flag("missing_face"),
    *text("disturbance"),
    *text("subset"),
    *count("samples"),
    *number(*(f"{error}{suffix}" for error in ERRORS for suffix in ("", "_std", "_sem"))),
    *number("constrained_percent", "solver_percent"),
    *count(CLIPPED),
    *rule_fields(),
    *text("camera", "pixels"),
    *number(
        *(f"{error}_error_{unit}{s}" for error in PIXEL_ERRORS for unit in ("px", "percent") for s in ("", "_std"))
    ),
    *picture_fields(),
)
_ORIENTATION_BIT = 1 << CONSTRAINTS.index("orientation")
_SOLVER_BITS = sum(1 << CONSTRAINTS.index(name) for name in ("proximity", "joint_limit"))


def subsets(record: ViewpointRecord) -> dict[str, NDArray[np.bool_]]:
    """Which samples of a record belong to each subset, ``(T,)``."""
    rules = np.array(record.frames.rules, dtype=int)
    # Also where a drop-out kept the measurement from the controller: there is an error wherever there was one.
    measured = np.isfinite(record.errors.get("vva_deg", np.empty(0)))
    return {
        "all": measured,
        "unconstrained": measured & (rules == 0),
        "constrained": measured & (rules != 0),
        "solver": measured & ((rules & _SOLVER_BITS) != 0) & ((rules & _ORIENTATION_BIT) == 0),
        "optimised": measured & np.array(record.frames.solver, dtype=bool),
    }


def viewpoint_rows(head: Row, records: list[ViewpointRecord]) -> list[Row]:
    """One row for every subset that has samples; the subset ``all`` is always there.

    Args:
        head: Columns that do not depend on the subset.
        records: Of one row id and settings.
    """
    common: Row = {
        **head,
        "registration": records[0].spec.registration,
        "missing_face": records[0].spec.missing_face,
        "disturbance": ", ".join(Disturbance(**records[0].spec.disturbance).words()) or None,
    }
    members = [subsets(record) for record in records]
    rows = [_row(common, name, records, [one[name] for one in members]) for name in SUBSETS]
    rows[0] |= {**rule_row(records), **visibility_row(records, "projected_px"), **framed_row(records)}
    rows[0] |= {**lost_row(records), **hand_values(records)}
    of_pictures = {**dict.fromkeys(keys(VIEWPOINT_COLUMNS)), **common, "subset": "all", **dict.fromkeys(LATENCIES)}
    rows += [{**of_pictures, **row} for source in SOURCES for row in picture_rows(records, source)]
    return [row for row in rows if row["subset"] == "all" or row["samples"]]


def _row(common: Row, subset: str, records: list[ViewpointRecord], chosen: list[NDArray[np.bool_]]) -> Row:
    row: Row = {
        **dict.fromkeys(keys(VIEWPOINT_COLUMNS)),
        **common,
        "subset": subset,
        "samples": int(sum(mask.sum() for mask in chosen)),
    }
    for error in ERRORS:
        summary = summarise(_by_trial(records, chosen, error))
        row |= {error: summary.mean, f"{error}_std": summary.std, f"{error}_sem": summary.sem}
    row |= _latencies(records, chosen)
    row["constrained_percent"] = _percent([np.array(r.frames.rules, dtype=int) != 0 for r in records], chosen)
    row["solver_percent"] = _percent([np.array(r.frames.solver, dtype=bool) for r in records], chosen)
    row[CLIPPED] = sum(clipped(record, mask) for record, mask in zip(records, chosen, strict=True))
    return row


def _latencies(records: list[ViewpointRecord], chosen: list[NDArray[np.bool_]]) -> Row:
    parts = [np.array(r.frames.latency_ms, dtype=np.float64)[m] for r, m in zip(records, chosen, strict=True) if len(m)]
    latency = np.concatenate([*parts, np.empty(0)])
    latency = latency[~np.isnan(latency)]
    if not latency.size:
        return dict.fromkeys(LATENCIES)
    return {
        "latency_ms": float(np.median(latency)),
        "latency_ms_p95": float(np.percentile(latency, 95)),
        "latency_ms_mean": float(latency.mean()),
        "latency_ms_std": float(latency.std(ddof=1)) if latency.size > 1 else None,
        "latency_ms_p999": float(np.percentile(latency, 99.9)),
    }


def _by_trial(records: list[ViewpointRecord], chosen: list[NDArray[np.bool_]], error: str) -> list[list[FloatArray]]:
    trials: dict[str, list[FloatArray]] = {}
    for record, mask in zip(records, chosen, strict=True):
        if error in record.errors:
            trials.setdefault(record.spec.unit, []).append(record.errors[error][mask])
    return list(trials.values())


def clipped(record: ViewpointRecord, chosen: NDArray[np.bool_]) -> int:
    """How many commands of a record's chosen samples (``(T,)``) lay outside the joints' limits."""
    values = np.array(record.frames.clipped, dtype=bool)
    return int(values[chosen].sum()) if len(values) else 0


def _percent(flags: list[Any], chosen: list[NDArray[np.bool_]]) -> float | None:
    total = sum(int(mask.sum()) for mask in chosen)
    counted = sum(int(values[mask].sum()) for values, mask in zip(flags, chosen, strict=True) if len(values))
    return 100.0 * counted / total if total else None
