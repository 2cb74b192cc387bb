"""Reading records: one JSON file per tracker, unit and repeat, immutable once written."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray

RECORD_FORMAT = "surgbench-record-1"
SKIPPED = "skipped"  # the status of a run that the machine lacks something for
PER_ARM = ("jitter", "lag_ms", "start_lag_ms")  # errors that have one value for all frames together
_FORMAT_STEM = "surgbench-record-"

Number = float | None


class _Part(BaseModel):
    # Records hold more than a report reads (machine, versions, git state); the rest is not its business.
    model_config = ConfigDict(frozen=True, extra="ignore", arbitrary_types_allowed=True)


class DatasetRef(_Part):
    """Which dataset a run was made on."""

    name: str
    sha256: str


class Plug(_Part):
    """A plug-in and its effective options."""

    name: str
    options: dict[str, Any] = {}


class Spec(_Part):
    """What was run: everything that the estimates depend on."""

    task: str
    dataset: DatasetRef
    unit: str
    sequence: str
    arms: tuple[str, ...]
    mask_kind: str
    row_id: str
    tracker: Plug
    initialiser: Plug
    filter: Plug
    keypoints: Plug
    readings: str
    repeat: int
    views: int = 1
    view: str | None = None
    level: str | float | None = None


class Frames(_Part):
    """Per-frame results; all lists have the same length T, in the order the frames were tracked."""

    index: list[int] = []
    state: list[list[float]] = []
    confidence: list[Number] = []
    lost: list[bool] = []
    latency_ms: list[Number] = []
    latency_optimise_ms: list[Number] = []
    latency_keypoints_ms: list[Number] = []
    latency_masks_ms: list[Number] = []
    latency_filter_ms: list[Number] = []

    @model_validator(mode="after")
    def _same_length(self) -> Frames:
        for key in type(self).model_fields:
            found = len(getattr(self, key))
            if found not in (0, len(self.index)):
                raise ValueError(f"'{key}' has {found} entries but 'index' has {len(self.index)}")
        if self.state and {len(state) for state in self.state} not in ({9}, {18}):
            raise ValueError("'state' must hold 9 or 18 numbers per frame")
        return self

    @property
    def states(self) -> FloatArray:
        """``(T, 9 * arms)`` estimated states."""
        return np.array(self.state, dtype=np.float64)


class Record(_Part):
    """One run of one tracker on one unit.

    Attributes:
        path: The file it was read from.
        errors: Error name to ``(T,)`` or ``(T, arms)`` values, NaN where a frame has none; a missing truth
            leaves the name out. Those of ``PER_ARM`` are one number per arm.
        unit_frames: Frames that were asked for.
        dataset_frames: Frames of all units of the dataset; ``None`` in records of old versions.
        floor: The filter knew the truth.
    """

    path: Path
    spec_hash: str
    settings_hash: str
    spec: Spec
    variant: str = ""
    status: str
    error: str | None = None
    dataset_path: str | None = None
    unit_frames: int
    dataset_frames: int | None = None
    floor: bool = False
    frames: Frames
    errors: dict[str, FloatArray]

    @model_validator(mode="after")
    def _errors_match(self) -> Record:
        for key, values in self.errors.items():
            if key not in PER_ARM and len(values) != len(self.frames.index):
                raise ValueError(f"'errors.{key}' has {len(values)} entries but 'index' has {len(self.frames.index)}")
        return self


def read_record(path: Path) -> Record | None:
    """Read one file.

    Args:
        path: A JSON file.

    Returns:
        The record, or ``None`` when the file is sound but something else.

    Raises:
        DatasetError: The file is truncated, is not JSON, or is a record with a wrong or missing key.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DatasetError(f"{path}: truncated or not JSON ({error}); delete it and run again") from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    kind = content.get("format") if isinstance(content, dict) else None
    if not isinstance(kind, str) or not kind.startswith(_FORMAT_STEM):
        return None
    if kind != RECORD_FORMAT:
        raise DatasetError(f"{path}: record format '{kind}' is not known here (known: {RECORD_FORMAT})")
    try:
        content["frames"] = content.get("frames") or {}
        content["errors"] = _error_arrays(content.get("errors") or {})
        return Record.model_validate({**content, "path": path})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "record"
        message = first["msg"].removeprefix("Value error, ")
        raise DatasetError(f"{path}: '{key}': {message[:1].lower()}{message[1:]}") from None
    except ValueError as error:
        raise DatasetError(f"{path}: {error}") from None


def _error_arrays(errors: dict[str, Any]) -> dict[str, FloatArray]:
    arrays = {}
    for key, values in errors.items():
        if values is None:
            continue
        try:
            arrays[key] = np.atleast_1d(np.array(values, dtype=np.float64))
        except (TypeError, ValueError):
            raise ValueError(f"'errors.{key}' must be numbers, one row per frame") from None
    return arrays


def read_records(directories: Iterable[Path]) -> list[Record]:
    """All records below some folders, each run once, in a fixed order.

    A run that is there twice (the same ``spec_hash``) counts once: a sound record before a failed one, a failed one
    before a skipped one, then the one found first, folders in the order given.

    Raises:
        DatasetError: A folder is missing or has no record, or a file below it is damaged.
    """
    chosen: dict[str, Record] = {}
    for directory in directories:
        if not directory.is_dir():
            raise DatasetError(f"{directory}: no such folder of records (make one with: surgbench run … --out DIR)")
        found = [record for path in sorted(directory.rglob("*.json")) if (record := read_record(path)) is not None]
        if not found:
            raise DatasetError(f"{directory}: holds no records (*.json with format {RECORD_FORMAT})")
        for record in found:
            known = chosen.get(record.spec_hash)
            if known is None or _worth(record) < _worth(known):
                chosen[record.spec_hash] = record
    return sorted(chosen.values(), key=lambda r: (r.spec.row_id, r.spec.unit, r.spec.repeat, r.spec_hash))


def _worth(record: Record) -> int:
    return {"ok": 0, SKIPPED: 2}.get(record.status, 1)
