"""Records as DataFrames: what a notebook works on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surgbench.records.format import Plug, Record, RecordSpec
from surgbench.records.reader import read_records
from surgbench.report.field import Field, count, number, text
from surgbench.report.frame import to_frame
from surgbench.report.row import median, pooled
from surgbench.report.rows import columns, read_rows

if TYPE_CHECKING:
    from pandas import DataFrame

RECORD_COLUMNS = (
    *text("row_id", "task", "dataset", "tracker", "unit"),
    *count("repeat"),
    *text("status", "error"),
    *count("frames"),
    *text("variant", "settings_hash", "spec_hash", "sequence", "level"),
)
# What of a task's specification is said by other columns.
_COMMON = frozenset(RecordSpec.model_fields)
_LATENCY = "latency_"


def load_records(*directories: str | Path) -> DataFrame:
    """Every run below some folders, a line each.

    Args:
        directories: Folders of records, as ``surgbench run --out`` fills them.

    Returns:
        ``RECORD_COLUMNS``; what else the task's specification says (a plug-in by its name); the tracker's options as
        ``option.<name>`` and those of other plug-ins as ``<kind>.<name>``; the mean over frames of each error; the
        median over frames of each ``latency_…``, milliseconds; and ``path``, the record's file. Missing values are
        ``NA`` or ``NaN``. A run that is there twice is one line, the sound one.

    Raises:
        DatasetError: A folder is missing or has no record, or a file below it is damaged.
    """
    records = read_records(map(Path, directories))
    rows = [_row(record) for record in records]
    known = {field.key: field for field in RECORD_COLUMNS}
    found: dict[str, list[Any]] = {}
    for row in rows:
        for key, value in row.items():
            found.setdefault(key, []).append(value)
    others = [key for key in found if key not in known and key != "path"]
    settings, errors, latencies = ([key for key in others if _rank(key, records) == rank] for rank in range(3))
    fields = [
        *RECORD_COLUMNS,
        *(_field(key, found[key]) for key in settings),
        *number(*errors, *latencies),
        *text("path"),
    ]
    return to_frame(rows, fields)


def leaderboard(*directories: str | Path) -> DataFrame:
    """The leaderboard of the records below some folders: what ``surgbench report --format csv`` writes.

    Args:
        directories: Folders of records; several become one leaderboard.

    Returns:
        A line a row, in the leaderboard's order, with the columns of ``docs/metrics.md``.

    Raises:
        DatasetError: A folder is missing or has no record, or a file below it is damaged.
    """
    rows = read_rows(map(Path, directories))
    return to_frame(rows, columns(rows))


def _row(record: Record) -> dict[str, Any]:
    spec = record.spec
    row: dict[str, Any] = {
        "row_id": spec.row_id,
        "task": spec.task,
        "dataset": spec.dataset.name,
        "tracker": spec.tracker.name,
        "unit": spec.unit,
        "repeat": spec.repeat,
        "status": record.status,
        "error": record.error,
        "frames": len(record.frames.index),
        "variant": record.variant,
        "settings_hash": record.settings_hash,
        "spec_hash": record.spec_hash,
        "sequence": spec.sequence,
        "level": spec.level,
    }
    for key in type(spec).model_fields:
        if key not in _COMMON:
            row |= _setting(key, getattr(spec, key))
    row |= {f"option.{key}": value for key, value in _flat(spec.tracker.options)}
    for error, values in record.errors.items():
        finite = values[~np.isnan(values)]
        row[error] = float(finite.mean()) if finite.size else None
    for key in type(record.frames).model_fields:
        if key.startswith(_LATENCY):
            row[key] = median(pooled([record], key))
    return {**row, "path": str(record.path)}


def _setting(key: str, value: Any) -> dict[str, Any]:
    if isinstance(value, Plug):
        return {key: value.name, **{f"{key}.{name}": option for name, option in _flat(value.options)}}
    return {key: "+".join(map(str, value)) if isinstance(value, tuple) else value}


def _flat(options: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Nested options with dots, lists as text."""
    for name, value in options.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _rank(key: str, records: list[Record]) -> int:
    """0: a setting; 1: an error; 2: a latency."""
    return 2 if key.startswith(_LATENCY) else int(any(key in record.errors for record in records))


def _field(key: str, values: list[Any]) -> Field:
    """A column of the narrowest type that holds all values."""
    there = [value for value in values if value is not None]
    if there and all(isinstance(value, bool) for value in there):
        return Field(key, "flag")
    if there and all(type(value) is int for value in there):
        return Field(key, "count")
    if there and all(isinstance(value, int | float) and not isinstance(value, bool) for value in there):
        return Field(key, "number")
    return Field(key, "text")
