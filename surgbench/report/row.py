"""One row of the leaderboard, whatever the task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.records.format import Record
from surgbench.report.field import count, number, text

Row = dict[str, Any]

COMMON_COLUMNS = (
    *text("row_id", "task", "dataset", "tracker", "variant", "settings_hash", "status", "error"),
    *count("sequences", "frames", "repeats"),
    *number("coverage", "latency_ms", "latency_ms_p95", "latency_optimise_ms", "latency_keypoints_ms"),
    *number("latency_masks_ms", "latency_filter_ms", "calibration_ratio"),
)

# Of reports, where they are known: latencies of other machines beside each other.
REFERENCE_LATENCY, PROCESSOR = "latency_reference_ms", "processor"
MACHINE_COLUMNS = (*number(REFERENCE_LATENCY), *text(PROCESSOR))


def median(values: FloatArray) -> float | None:
    """The median; ``None`` of nothing."""
    return float(np.median(values)) if values.size else None


def pooled(records: Sequence[Record], key: str) -> FloatArray:
    """Values of all frames of some records, without NaN."""
    values = np.array([value for record in records for value in getattr(record.frames, key)], dtype=np.float64)
    return values[~np.isnan(values)]


def interval_keys(error: str) -> tuple[str, str]:
    """What the ends of an error's interval are called."""
    return f"{error}_low", f"{error}_high"
