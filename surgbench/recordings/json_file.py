"""JSON as other programs write it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from surgbench.errors import DatasetError
from surgbench.leftovers import without_leftovers
from surgbench.syntax import parse_json


def find_json(source: Path, importer: str, name: str, *, folders: tuple[str, ...] = (".",)) -> Path:
    """The file that an importer reads: the source itself, the one of its name in it, or the only JSON file there.

    Args:
        source: A file or a folder.
        importer: For the message.
        name: What the file is called, unless it is the only one but for a camera's.
        folders: Of the source, that are looked into.

    Raises:
        DatasetError: There is none, or several; one line.
    """
    if not source.exists():
        raise DatasetError(f"{source}: no such file or folder; expected {name}")
    if not source.is_dir():
        return source
    every = [path for folder in folders for path in sorted(without_leftovers((source / folder).glob("*.json")))]
    found = [path for path in every if path.name != "camera.json"]
    named = [path for path in found if path.name == name]
    if len(named or found) != 1:
        raise DatasetError(f"{source}: holds {len(found)} JSON files; say which one: import {importer} FILE")
    return (named or found)[0]


def read_json(path: Path) -> Any:
    """What a JSON file holds; a byte order mark is passed over.

    Raises:
        DatasetError: It cannot be read, or is not JSON; one line.
    """
    try:
        return parse_json(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise DatasetError(f"{path}: not valid JSON ({error})") from None
