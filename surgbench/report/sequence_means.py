"""One value for each sequence: what rows are averaged from, and held against each other by."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from surgbench.records.format import Record
from surgbench.report.row import Row


def sequence_means(records: Iterable[Record], error: str) -> dict[str, float]:
    """Of each unit the mean over its repeats of the mean over frames (and arms), in the order of their names.

    Args:
        records: Of one row; what failed counts with the frames it has.
        error: Key of their errors. A run without a value of it does not count.
    """
    return _means((record.spec.unit, record_mean(record, error)) for record in records)


def line_means(lines: Iterable[Row], row_id: str, column: str) -> dict[str, float]:
    """The same of a row's sound lines of ``sequences.csv``."""
    return _means(
        (line["unit"], line.get(column)) for line in lines if line["row_id"] == row_id and line["status"] == "ok"
    )


def record_mean(record: Record, error: str) -> float | None:
    """Mean over the frames that have a value; ``None`` where none has."""
    values = record.errors.get(error, np.array([]))
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else None


def _means(values: Iterable[tuple[str, float | None]]) -> dict[str, float]:
    of_units: dict[str, list[float]] = {}
    for unit, value in values:
        if value is not None:
            of_units.setdefault(unit, []).append(value)
    return {unit: float(np.mean(of_units[unit])) for unit in sorted(of_units)}


def differences(ours: Mapping[str, float], theirs: Mapping[str, float]) -> list[float]:
    """Ours less theirs of the units that both have."""
    return [ours[unit] - theirs[unit] for unit in ours if unit in theirs]


def shared(means: Sequence[Mapping[str, float]]) -> list[str]:
    """The units that all have."""
    return [unit for unit in means[0] if all(unit in own for own in means[1:])] if means else []
