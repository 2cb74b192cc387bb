"""What writers of datasets share: file entries for the manifest, and one-line errors of the disk."""

from __future__ import annotations

import errno
import hashlib
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
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


@contextmanager
def new_folder(out: Path, work: str = "importing", option: str = "--out") -> Iterator[Path]:
    """A scratch folder beside another, whose place it takes when the block ends well, and else is gone.

    Args:
        out: The folder: new or empty.
        work: What goes on, for the scratch folder's name.
        option: That named the folder, for messages.

    Yields:
        The scratch folder, empty.

    Raises:
        DatasetError: ``out`` holds something.
        SurgbenchError: The disk is full, or nothing can be written there; one line.
    """
    check_new(out, option)
    scratch = out.absolute().with_name(f".{out.absolute().name}.{work}")
    try:
        if scratch.exists():
            shutil.rmtree(scratch)  # of a call that was killed
        scratch.mkdir(parents=True)
        yield scratch
        for leftover in out.iterdir() if out.exists() else ():
            leftover.rename(scratch / leftover.name)  # of the system's; nothing else is in there
        scratch.rename(out)
    except OSError as error:
        raise storage_error(error, out, "run the same command again") from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


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
