"""How far a row's sequences are from each other, where a table asks for it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surgbench.records.format import Record
from surgbench.report.row import Row
from surgbench.report.sequence_means import sequence_means

FRAMES_PER_SECOND = "frames_per_second"
SUFFIX = "_std_sequences"


def spread_over_sequences(columns: Sequence[str], records: Sequence[Record], timing: Sequence[Record]) -> Row:
    """Of each column the standard deviation of sequences' means, and of ``frames_per_second`` the mean too.

    Args:
        columns: Errors, or ``frames_per_second``: a sequence's frames by the time that they took, all of it.
        records: A row's runs.
        timing: Those that its times are from.

    Returns:
        Sample standard deviations under ``<column>_std_sequences``, ``None`` where there are less than two sequences;
        every sequence weighs the same, however long it is.
    """
    row: Row = {}
    for column in columns:
        if column == FRAMES_PER_SECOND:
            means = _rates(timing)
            row[column] = float(np.mean(means)) if means else None
        else:
            means = list(sequence_means(records, column).values())
        row[column + SUFFIX] = float(np.std(means, ddof=1)) if len(means) > 1 else None
    return row


def _rates(records: Sequence[Record]) -> list[float]:
    """Frames per second of each unit: the mean over its repeats."""
    of_units: dict[str, list[float]] = {}
    for record in records:
        times = np.array([time for time in getattr(record.frames, "latency_ms", []) if time is not None])
        if times.size:
            of_units.setdefault(record.spec.unit, []).append(float(1e3 / times.mean()))
    return [float(np.mean(values)) for values in of_units.values()]
