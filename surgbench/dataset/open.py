"""Opening a dataset, of whichever task it is."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from surgbench.dataset.base import Dataset
from surgbench.dataset.manifest import FORMAT, MANIFEST_NAME, MARKER_NAME, Manifest
from surgbench.errors import DatasetError, unknown_name
from surgbench.files import MOST_JSON_BYTES, read_whole
from surgbench.syntax import parse_json
from surgbench.task import default_task, find_task, task_names

D = TypeVar("D", bound=Dataset[Any])


def open_dataset(path: Path | str) -> Dataset[Any]:
    """Open a dataset's folder; only the manifest is read.

    Raises:
        DatasetError: There is no complete dataset here, or its manifest is wrong; one line.
    """
    folder = Path(path)
    manifest, data = read_manifest(folder)
    return find_task(manifest.task).open(folder, manifest, hashlib.sha256(data).hexdigest())


def open_as(kind: type[D], path: Path | str) -> D:
    """Open a dataset that has to be of one task.

    Raises:
        DatasetError: It is of another one, or as for :func:`open_dataset`.
    """
    dataset = open_dataset(path)
    if not isinstance(dataset, kind):
        raise DatasetError(f"{path}: a dataset of the {dataset.task} task; expected one of the {kind.task} task")
    return dataset


def read_manifest(folder: Path) -> tuple[Manifest, bytes]:
    """Read a dataset's manifest, that of its task, and its bytes.

    Raises:
        DatasetError: There is no dataset here, it is not complete, or its manifest is wrong; one line.
    """
    path = folder / MANIFEST_NAME
    try:
        data = read_whole(path, MOST_JSON_BYTES)
    except (FileNotFoundError, NotADirectoryError):
        if (folder / MARKER_NAME).exists():
            raise DatasetError(
                f"{folder}: not complete; run the same 'surgbench generate' again to finish it"
            ) from None
        if not folder.is_dir():
            raise DatasetError(
                f"{folder}: no such folder; expected a dataset (a folder with {MANIFEST_NAME})"
            ) from None
        raise DatasetError(
            f"{path}: missing; expected a dataset from 'surgbench generate' or 'surgbench import'"
        ) from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        raw = parse_json(data)
    except ValueError as error:
        raise DatasetError(f"{path}: not valid JSON ({error}); the file was truncated or altered") from None
    found = raw.get("format") if isinstance(raw, dict) else None
    if found != FORMAT:
        raise DatasetError(f"{path}: 'format' is {found!r}; this version of surgbench reads '{FORMAT}'")
    task = raw.get("task", default_task().name)
    if task not in task_names():
        raise DatasetError(f"{path}: 'task': {unknown_name('task', str(task), task_names())}")
    try:
        return find_task(task).manifest.model_validate(raw), data
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        raise DatasetError(f"{path}: {f'{chr(39)}{key}{chr(39)}: ' if key else ''}{message}") from None
