"""Rows of the leaderboard for the viewpoint task: one for every subset of the samples.

The subsets are those of the naive pose, and so the same samples for all controllers: ``constrained`` where any rule
speaks against it, ``unconstrained`` where none does, ``solver`` where it is on the right side, but out of the arm's
reach or, moved out of the no-go zone, too near. ``optimised`` alone is the controller's own: the samples in which it
says that it optimised. Samples at which the feature was not measured belong to none.
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
from surgbench.tasks.viewpoint.records import ViewpointRecord
from surgbench.viewpoint.optics.centroids import ERRORS as PIXEL_ERRORS
from surgbench.viewpoint.optics.centroids import centroid_table, visibility
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO
from surgbench.viewpoint.placement import CONSTRAINTS
from surgbench.viewpoint.scores import NO_GO_TOLERANCE_M, POSE_ERRORS, SIGNED, TRUE_ERRORS

SUBSETS = ("all", "unconstrained", "constrained", "solver", "optimised")
ERRORS = (*POSE_ERRORS, SIGNED, *TRUE_ERRORS)
VISIBILITY = ("left", "right", "any", "both")
LATENCIES = ("latency_ms", "latency_ms_p95", "latency_ms_mean", "latency_ms_std", "latency_ms_p999")
COUNTS = ("limit_violations", "clipped_commands", "no_go_violations", "floor_violations", "proximity_violations")
VIEWPOINT_COLUMNS = (
    *COMMON_COLUMNS,
    *number("latency_ms_mean", "latency_ms_std", "latency_ms_p999"),
    *text("registration"),
    *flag("missing_face"),
    *text("subset"),
    *count("samples"),
    *number(*(f"{error}{suffix}" for error in ERRORS for suffix in ("", "_std", "_sem"))),
    *number("constrained_percent", "solver_percent"),
    *count(*COUNTS),
    *text("camera", "pixels"),
    *number(
        *(f"{error}_error_{unit}{s}" for error in PIXEL_ERRORS for unit in ("px", "percent") for s in ("", "_std"))
    ),
    *number(*(f"visibility_{which}_percent" for which in VISIBILITY)),
)
_ORIENTATION_BIT = 1 << CONSTRAINTS.index("orientation")
_SOLVER_BITS = sum(1 << CONSTRAINTS.index(name) for name in ("proximity", "joint_limit"))


def subsets(record: ViewpointRecord) -> dict[str, NDArray[np.bool_]]:
    """Which samples of a record belong to each subset, ``(T,)``."""
    rules, asked = np.array(record.frames.rules, dtype=int), np.array(record.frames.asked, dtype=bool)
    return {
        "all": asked,
        "unconstrained": asked & (rules == 0),
        "constrained": asked & (rules != 0),
        "solver": asked & ((rules & _SOLVER_BITS) != 0) & ((rules & _ORIENTATION_BIT) == 0),
        "optimised": asked & np.array(record.frames.solver, dtype=bool),
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
    }
    members = [subsets(record) for record in records]
    rows = [_row(common, name, records, [one[name] for one in members]) for name in SUBSETS]
    rows[0] |= _visibility(*stacked_pixels(records, "projected_px")) | hand_values(records)
    rows += [row for source in ("projected_px", "tags_px") for row in _pixel_rows(common, records, source)]
    return [row for row in rows if row["subset"] == "all" or row["samples"]]


def stacked_pixels(records: list[ViewpointRecord], source: str) -> tuple[FloatArray, FloatArray]:
    """Pixels ``(n, 2)`` of the left and the right camera of all samples, NaN where the feature was not seen.

    Args:
        records: Their steps are put in a row.
        source: ``projected_px`` or ``tags_px``; samples without a picture are left out.
    """
    lists = [one for record in records for one in getattr(record.frames, source) if one is not None]
    pixels = np.array(lists, dtype=np.float64).reshape(-1, 2, 2)
    return pixels[:, 0], pixels[:, 1]


def _visibility(left: FloatArray, right: FloatArray) -> Row:
    return {
        f"visibility_{which}_percent": None if np.isnan(share) else share
        for which, share in visibility(left, right).items()
    }


def _pixel_rows(common: Row, records: list[ViewpointRecord], source: str) -> list[Row]:
    """How far the feature was from the middle of the left picture, the right one, and any; trimmed as published."""
    left, right = stacked_pixels(records, source)
    if not len(left):
        return []
    table = centroid_table(left, right, (AUTOCAM_STEREO.left, AUTOCAM_STEREO.right))
    rows = []
    for camera in ("left", "right", "any"):
        row: Row = {**dict.fromkeys(keys(VIEWPOINT_COLUMNS)), **common, "subset": "all", "samples": len(left)}
        row |= dict.fromkeys(LATENCIES)
        row |= {"camera": camera, "pixels": source.removesuffix("_px"), **_visibility(left, right)}
        eye = {"left": table.left, "right": table.right}.get(camera)
        for error in PIXEL_ERRORS:
            spreads = {"percent": table.combined[error]} if eye is None else {}
            if eye is not None:
                spreads = {"px": eye.pixels[error], "percent": eye.percent[error]}
            for unit, spread in spreads.items():
                for suffix, value in (("", spread.mean), ("_std", spread.deviation)):
                    row[f"{error}_error_{unit}{suffix}"] = None if np.isnan(value) else value
        rows.append(row)
    return rows


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
    counts = [counted(record, mask) for record, mask in zip(records, chosen, strict=True)]
    row |= {name: sum(count[name] for count in counts) for name in COUNTS}
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


def counted(record: ViewpointRecord, chosen: NDArray[np.bool_]) -> dict[str, int]:
    """How many of a record's chosen samples (``(T,)``) break each rule; keys are ``COUNTS``."""
    frames = record.frames
    flags = {
        "limit_violations": np.array(frames.limit_violation, dtype=bool),
        "clipped_commands": np.array(frames.clipped, dtype=bool),
        "no_go_violations": np.array(frames.no_go_depth_m) > NO_GO_TOLERANCE_M,
        "floor_violations": np.array(frames.floor_depth_m) > NO_GO_TOLERANCE_M,
        "proximity_violations": np.array(frames.proximity_m) > NO_GO_TOLERANCE_M,
    }
    return {name: int(values[chosen].sum()) if len(values) else 0 for name, values in flags.items()}


def _percent(flags: list[Any], chosen: list[NDArray[np.bool_]]) -> float | None:
    total = sum(int(mask.sum()) for mask in chosen)
    counted = sum(int(values[mask].sum()) for values, mask in zip(flags, chosen, strict=True) if len(values))
    return 100.0 * counted / total if total else None
