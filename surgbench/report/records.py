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


class AnySpec(_Part):
    """What was run, whatever the task."""

    task: str
    dataset: DatasetRef
    unit: str
    sequence: str
    row_id: str
    tracker: Plug
    repeat: int
    level: str | float | None = None


class Spec(AnySpec):
    """Everything that the estimates of an instrument depend on."""

    arms: tuple[str, ...]
    mask_kind: str
    initialiser: Plug
    filter: Plug
    keypoints: Plug
    readings: str
    views: int = 1
    view: str | None = None


class ViewpointSpec(AnySpec):
    """Everything that a camera's course depends on."""

    registration: str
    missing_face: bool = False


class AnyFrames(_Part):
    """Per-frame results; all lists have the same length T, in the order the frames were run."""

    index: list[int] = []

    @model_validator(mode="after")
    def _same_length(self) -> AnyFrames:
        for key in type(self).model_fields:
            found = len(getattr(self, key))
            if found not in (0, len(self.index)):
                raise ValueError(f"'{key}' has {found} entries but 'index' has {len(self.index)}")
        return self


class Frames(AnyFrames):
    """Per-frame results of an instrument tracker."""

    state: list[list[float]] = []
    confidence: list[Number] = []
    lost: list[bool] = []
    latency_ms: list[Number] = []
    latency_optimise_ms: list[Number] = []
    latency_keypoints_ms: list[Number] = []
    latency_masks_ms: list[Number] = []
    latency_filter_ms: list[Number] = []

    @model_validator(mode="after")
    def _state_size(self) -> Frames:
        if self.state and {len(state) for state in self.state} not in ({9}, {18}):
            raise ValueError("'state' must hold 9 or 18 numbers per frame")
        return self

    @property
    def states(self) -> FloatArray:
        """``(T, 9 * arms)`` estimated states."""
        return np.array(self.state, dtype=np.float64)


class ViewpointFrames(AnyFrames):
    """Per-step results of a viewpoint controller (:func:`surgbench.viewpoint.execute.measure`).

    Attributes:
        joints: Of the camera arm, after each step.
        setpoint: What they were told.
        asked: Whether the controller was asked.
        clipped: Whether its command lay outside the joint limits.
        solver: Whether it optimised.
        active: The rules active in the controller's own view, one bit each.
        rules: Those that speak against the naive pose, the same for all controllers.
        limit_violation: Whether the set point lay outside the joint limits.
        no_go_depth_m: How deep in the no-go zone the commanded camera was; negative outside.
        floor_depth_m: How far below the floor; negative above.
        proximity_m: How much too near the feature; negative where it was not.
        latency_ms: What the step took.
        projected_px: u and v of the feature in the left and the right picture, ``None`` where it is outside.
        tags_px: The same as found by the tags in rendered pictures; ``None`` where no picture was taken.
    """

    joints: list[list[float]] = []
    setpoint: list[list[float]] = []
    asked: list[bool] = []
    clipped: list[bool] = []
    solver: list[bool] = []
    active: list[int] = []
    rules: list[int] = []
    limit_violation: list[bool] = []
    no_go_depth_m: list[float] = []
    floor_depth_m: list[float] = []
    proximity_m: list[float] = []
    projected_px: list[list[Number]] = []
    tags_px: list[list[Number] | None] = []
    latency_ms: list[Number] = []


class AnyRecord(_Part):
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
    spec: AnySpec
    variant: str = ""
    status: str
    error: str | None = None
    dataset_path: str | None = None
    unit_frames: int
    dataset_frames: int | None = None
    floor: bool = False
    frames: AnyFrames
    errors: dict[str, FloatArray]

    @model_validator(mode="after")
    def _errors_match(self) -> AnyRecord:
        for key, values in self.errors.items():
            if key not in PER_ARM and len(values) != len(self.frames.index):
                raise ValueError(f"'errors.{key}' has {len(values)} entries but 'index' has {len(self.frames.index)}")
        return self


class Record(AnyRecord):
    """One run of an instrument tracker."""

    spec: Spec
    frames: Frames


class ViewpointRecord(AnyRecord):
    """One run of a viewpoint controller."""

    spec: ViewpointSpec
    frames: ViewpointFrames


KINDS: dict[str, type[AnyRecord]] = {"instrument": Record, "viewpoint": ViewpointRecord}


def read_record(path: Path) -> AnyRecord | None:
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
    found = content.get("format") if isinstance(content, dict) else None
    if not isinstance(found, str) or not found.startswith(_FORMAT_STEM):
        return None
    if found != RECORD_FORMAT:
        raise DatasetError(f"{path}: record format '{found}' is not known here (known: {RECORD_FORMAT})")
    try:
        content["frames"] = content.get("frames") or {}
        content["errors"] = _error_arrays(content.get("errors") or {})
        spec = content.get("spec")
        kind = KINDS.get(str(spec.get("task")) if isinstance(spec, dict) else "", Record)
        return kind.model_validate({**content, "path": path})
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
    """All records of instrument trackers below some folders; see :func:`read_all_records`.

    Raises:
        DatasetError: As there, or a record is of another task.
    """
    records = []
    for record in read_all_records(directories):
        if not isinstance(record, Record):
            raise DatasetError(f"{record.path}: of the {record.spec.task} task; only instrument trackers' runs will do")
        records.append(record)
    return records


def read_all_records(directories: Iterable[Path]) -> list[AnyRecord]:
    """All records below some folders, each run once, in a fixed order.

    A run that is there twice (the same ``spec_hash``) counts once: a sound record before a failed one, a failed one
    before a skipped one, then the one found first, folders in the order given.

    Raises:
        DatasetError: A folder is missing or has no record, or a file below it is damaged.
    """
    chosen: dict[str, AnyRecord] = {}
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


def _worth(record: AnyRecord) -> int:
    return {"ok": 0, SKIPPED: 2}.get(record.status, 1)
