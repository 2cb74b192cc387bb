"""Reading records: one JSON file per tracker, unit and repeat, immutable once written."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from surgbench.errors import DatasetError, NotFoundError, SurgbenchError
from surgbench.files import MOST_JSON_BYTES, read_whole
from surgbench.geometry import FloatArray
from surgbench.leftovers import without_leftovers
from surgbench.records.format import FORMAT_STEM, FORMATS, RECORD_FORMAT, SKIPPED, Record
from surgbench.records.seal import SEAL, check_seal
from surgbench.syntax import parse_json
from surgbench.task import Task, find_task

R = TypeVar("R", bound=Record)

# As a run calls them: what else is broken beside them is somebody else's.
_RECORD_NAME = re.compile(r"-r\d+\.json$")
# Frame by frame, or of no interest to a reader; the rest of a record says what was run, and where.
_MEASURED = ("frames", "errors", "traceback")


def read_record(path: Path) -> Record | None:
    """Read one file.

    Args:
        path: A JSON file.

    Returns:
        The record, as its task has it, or ``None`` when the file is sound but something else.

    Raises:
        DatasetError: The file is truncated, is not JSON, or is a record that was altered, with a wrong or missing key,
            or of a task that is not known here.
    """
    try:
        content = parse_json(read_whole(path, MOST_JSON_BYTES))
    except ValueError as error:
        advice = "; delete it and run again" if _RECORD_NAME.search(path.name) else ""
        raise DatasetError(f"{path}: truncated or not JSON ({error}){advice}") from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    found = content.get("format") if isinstance(content, dict) else None
    if not isinstance(found, str) or not found.startswith(FORMAT_STEM):
        if isinstance(content, dict) and {"spec_hash", SEAL} & content.keys():
            raise DatasetError(f"{path}: a record with the format {found!r}; delete it and run again")
        return None
    if found not in FORMATS:
        raise DatasetError(f"{path}: record format '{found}' is not known here (known: {', '.join(FORMATS)})")
    check_seal(content, path)
    return parse_record(content, path)


def parse_record(content: dict[str, Any], path: Path) -> Record:
    """A record's content, checked against what its task declares.

    Raises:
        DatasetError: A key is wrong or missing, or the task is not known here; one line.
    """
    spec = content.get("spec")
    if not isinstance(spec, dict) or not isinstance(spec.get("task"), str):
        raise DatasetError(f"{path}: 'spec.task' is missing")
    try:
        model = find_task(spec["task"]).record
    except NotFoundError as error:
        raise DatasetError(f"{path}: {error}") from None
    try:
        errors = _error_arrays(content.get("errors") or {})
        about = {key: value for key, value in content.items() if key not in _MEASURED}
        known = {"frames": content.get("frames") or {}, "errors": errors, "path": path, "about": about}
        return model.model_validate({**content, **known})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "record"
        message = first["msg"].removeprefix("Value error, ")
        raise DatasetError(f"{path}: '{key}': {message[:1].lower()}{message[1:]}") from None
    except ValueError as error:
        raise DatasetError(f"{path}: {error}") from None


def check_written(content: dict[str, Any], path: Path) -> None:
    """See that a record that is to be written can be read again, whole.

    Raises:
        DatasetError: A key is wrong or missing, or a column of ``frames`` or ``errors`` is not declared by its task's
            record, which would not be read; one line.
    """
    record = parse_record(content, path)
    declared = {"frames": tuple(type(record.frames).model_fields), "errors": record.error_names}
    for part, names in declared.items():
        for name in content[part] or {}:
            if name not in names:
                raise DatasetError(f"{path}: '{part}.{name}' is not declared by {type(record).__name__}")


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
        paths = sorted(without_leftovers(directory.rglob("*.json"), directory))
        found = [record for path in paths if (record := read_record(path)) is not None]
        if not found:
            raise DatasetError(f"{directory}: holds no records (*.json with format {RECORD_FORMAT})")
        for record in found:
            known = chosen.get(record.spec_hash)
            if known is None or _worth(record) < _worth(known):
                chosen[record.spec_hash] = record
    return sorted(chosen.values(), key=lambda r: (r.spec.row_id, r.spec.unit, r.spec.repeat, r.spec_hash))


def read_runs(places: Iterable[Path]) -> list[Record]:
    """The records of files and of all below folders, each run once; see :func:`read_records`.

    Raises:
        DatasetError: As there, or a file is no record.
    """
    folders, records = [], []
    for place in places:
        if place.is_file():
            record = read_record(place)
            if record is None:
                raise DatasetError(f"{place}: not a record (*.json with format {RECORD_FORMAT})")
            records.append(record)
        else:
            folders.append(place)
    records += read_records(folders)
    return list({record.spec_hash: record for record in records}.values())


def read_records_of(kind: type[R], directories: Iterable[Path]) -> list[R]:
    """All records below some folders, which have to be of one task; see :func:`read_records`.

    Raises:
        DatasetError: As there, or a record is of another task.
    """
    records = []
    for record in read_records(directories):
        if not isinstance(record, kind):
            raise DatasetError(f"{record.path}: a record of the {record.spec.task} task; expected another one's")
        records.append(record)
    return records


def _worth(record: Record) -> int:
    return {"ok": 0, SKIPPED: 2}.get(record.status, 1)


def only_task(records: Iterable[Record], place: Path) -> Task:
    """The task that all of some records are of.

    Args:
        records: At least one.
        place: What to name where they are of several.

    Raises:
        SurgbenchError: They are of several; one line.
    """
    tasks = sorted({record.spec.task for record in records})
    if len(tasks) > 1:
        raise SurgbenchError(f"{place}: runs of several tasks ({', '.join(tasks)}); give folders of one")
    return find_task(tasks[0])
