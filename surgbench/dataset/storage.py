"""What writers of datasets share: file entries for the manifest, and one-line errors of the disk."""

from __future__ import annotations

import errno
import hashlib
from pathlib import Path

from surgbench.dataset.manifest import FileEntry
from surgbench.errors import DatasetError, SurgbenchError
from surgbench.leftovers import without_leftovers


def file_entry(data: bytes) -> FileEntry:
    """Size and hash of a file's bytes."""
    return FileEntry(bytes=len(data), sha256=hashlib.sha256(data).hexdigest())


def check_new(out: Path, option: str = "--out") -> None:
    """See that nothing lies where something is to be made; what the system leaves does not count.

    Args:
        out: The folder.
        option: That named it, for the message.

    Raises:
        DatasetError: Something does.
    """
    if out.exists() and (not out.is_dir() or any(without_leftovers(out.iterdir()))):
        raise DatasetError(f"{out}: holds something already; {option} needs a new or empty folder")


def storage_error(error: OSError, folder: Path, advice: str) -> SurgbenchError:
    """One line for a failed write.

    Args:
        error: What the system said.
        folder: What was being written.
        advice: What to do after making room.
    """
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return SurgbenchError(f"{folder}: the disk is full; make room, then {advice}")
    return SurgbenchError(f"{error.filename or folder}: cannot be written ({error.strerror or error})")
