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
    settings, errors, latencies = ([take(record) for record in records] for take in (_settings, _errors, _latencies))
    parts = zip(map(_common, records), settings, errors, latencies, strict=True)
    rows = [{key: value for part in own for key, value in part.items()} for own in parts]
    fields = [
        *RECORD_COLUMNS,
        *(_field(key, [one.get(key) for one in settings]) for key in _keys(settings)),
        *number(*_keys(errors), *_keys(latencies)),
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


def _keys(parts: list[dict[str, Any]]) -> tuple[str, ...]:
    """Of all records, in the order in which they are met."""
    return tuple(dict.fromkeys(key for part in parts for key in part))


def _common(record: Record) -> dict[str, Any]:
    spec = record.spec
    return {
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
        "path": record.path,
    }


def _settings(record: Record) -> dict[str, Any]:
    """What the task's specification says besides, and the tracker's options."""
    spec = record.spec
    settings: dict[str, Any] = {}
    for key in type(spec).model_fields:
        if key not in RecordSpec.model_fields:
            settings |= _setting(key, getattr(spec, key))
    return settings | {f"option.{key}": value for key, value in _flat(spec.tracker.options)}


def _errors(record: Record) -> dict[str, float | None]:
    finite = {key: values[~np.isnan(values)] for key, values in record.errors.items()}
    return {key: float(values.mean()) if values.size else None for key, values in finite.items()}


def _latencies(record: Record) -> dict[str, float | None]:
    keys = [key for key in type(record.frames).model_fields if key.startswith("latency_")]
    return {key: median(pooled([record], key)) for key in keys}


def _setting(key: str, value: Any) -> dict[str, Any]:
    if isinstance(value, Plug):
        return {key: value.name, **{f"{key}.{name}": option for name, option in _flat(value.options)}}
    return {key: "+".join(map(str, value)) if isinstance(value, tuple) else value}


def _flat(options: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Nested options with dots."""
    for name, value in options.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _field(key: str, values: list[Any]) -> Field:
    """A column of the narrowest type that holds all values."""
    there = [value for value in values if value is not None]
    if there and all(isinstance(value, bool) for value in there):
        return Field(key, "flag")
    if there and all(type(value) is int and abs(value) < 2**63 for value in there):
        return Field(key, "count")
    if there and all(isinstance(value, int | float) and not isinstance(value, bool) for value in there):
        return Field(key, "number")
    return Field(key, "text")
