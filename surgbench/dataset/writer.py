"""Writes a dataset's files so that the manifest says what was meant, and an interrupted work knows what is done.

Hashes are taken of the bytes in hand, never of what is read back: a file that is damaged after it was written is found
by ``surgbench validate``, not blessed by the manifest. A :class:`DatasetWriter` notes them in the ledger of its part,
lines of JSON beside the dataset that are gone when it is complete, so that they need no memory and outlive the process.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from surgbench.config import Section
from surgbench.dataset.integrity import difference
from surgbench.dataset.manifest import FileEntry
from surgbench.dataset.storage import file_entry
from surgbench.errors import DatasetError
from surgbench.files import canonical_json, write_atomic

# Holds the ledgers while a dataset is being written.
SCRATCH_NAME: Final = "generating"
LEDGER_SUFFIX = ".jsonl"


class Written(Section):
    """A line of a ledger: files that were written together.

    Attributes:
        key: What they are, within their part.
        files: Path below the dataset's folder to what was meant to be in it.
        about: What else the manifest will say of them.
    """

    key: str
    files: dict[str, FileEntry]
    about: dict[str, Any] | None = None


class DatasetWriter:
    """Writes one part of a dataset; a part has one writer at a time, in whichever process.

    Args:
        root: The dataset's folder.
        part: Name of the part, fit for a file.
    """

    def __init__(self, root: Path, part: str) -> None:
        self._root, self._ledger = root, _ledger(root, part)
        self._written = read_part(root, part)

    def done(self, key: str) -> Written | None:
        """What was written under a key; ``None`` unless all files of it are there, with the very bytes."""
        written = self._written.get(key)
        if written is None:
            return None
        for file, listed in written.files.items():
            path = self._root / file
            try:
                if difference(path, path.read_bytes(), listed) is not None:
                    return None
            except OSError:
                return None
        return written

    def write(self, key: str, files: Mapping[str, bytes], about: dict[str, Any] | None = None) -> None:
        """Write files that belong together, each whole or not at all, and then note that they are there.

        Args:
            key: What they are, within the part; a key that was written before is written anew.
            files: Path below the dataset's folder to its bytes.
            about: What else the manifest will say of them; goes through JSON.
        """
        written = Written(key=key, files=write_files(self._root, files), about=about)
        line = canonical_json(written.model_dump(mode="json")).encode() + b"\n"
        self._ledger.parent.mkdir(parents=True, exist_ok=True)
        with self._ledger.open("a+b") as ledger:
            if ledger.tell():
                ledger.seek(-1, 2)
                # Else what a killed process left of its last line would spoil this one too.
                line = line if ledger.read(1) == b"\n" else b"\n" + line
            ledger.write(line)
        self._written[key] = written


def write_files(root: Path, files: Mapping[str, bytes]) -> dict[str, FileEntry]:
    """Write files below ``root``, each whole or not at all; returns what the manifest says of them."""
    for file, data in files.items():
        write_atomic(root / file, data)
    return {file: file_entry(data) for file, data in files.items()}


def read_part(root: Path, part: str) -> dict[str, Written]:
    """What was written of a part, by key, whatever became of the files since."""
    try:
        lines = _ledger(root, part).read_bytes().split(b"\n")
    except FileNotFoundError:
        return {}
    written = {}
    for line in lines:
        try:
            one = Written.model_validate(json.loads(line))
        except ValueError:  # half written: by a kill, on a full disk, or before a power cut
            continue
        written[one.key] = one
    return written


def collect(root: Path, parts: Iterable[str], paths: Iterable[str]) -> dict[str, FileEntry]:
    """The manifest's ``files``, as they were meant when they were written.

    Args:
        root: The dataset's folder.
        parts: All of them. By name, and not whatever lies there: a ledger of another version may mean other bytes.
        paths: Every file but the manifest.

    Raises:
        DatasetError: No part says that it wrote one of the files; one line.
    """
    written: dict[str, FileEntry] = {}
    for part in parts:
        for one in read_part(root, part).values():
            written |= one.files
    files = {}
    for path in paths:
        if path not in written:
            raise DatasetError(
                f"{root / path}: not in the ledgers in {root / SCRATCH_NAME}; "
                "run the same command again, and if that says the same, delete the folder first"
            )
        files[path] = written[path]
    return files


def remove_ledgers(root: Path) -> None:
    """Remove what was noted, once the dataset is complete."""
    shutil.rmtree(root / SCRATCH_NAME, ignore_errors=True)


def _ledger(root: Path, part: str) -> Path:
    return root / SCRATCH_NAME / f"{part}{LEDGER_SUFFIX}"
