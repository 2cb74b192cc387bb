"""Who of several processes at once may write in a place: the one that holds its lock, which ends with its process."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from surgbench.errors import DatasetError, SurgbenchError

LOCK_SUFFIX = ".lock"


@contextmanager
def sole_writer(out: Path, command: str, option: str = "--out") -> Iterator[None]:
    """Hold a folder against other commands for the time of the block.

    It is made where it is not there, and removed again where nothing has come of it.

    Args:
        out: The folder.
        command: Which of ours is at work, as the other is told: ``"generate"``.
        option: That named the folder, for messages.

    Raises:
        DatasetError: Another process is at work there, or it is a file.
        SurgbenchError: Nothing can be written there.
    """
    with contextlib.ExitStack() as held:
        try:
            made = _make(out)
            descriptor = lock(out, os.O_RDONLY | os.O_DIRECTORY)
        except (FileExistsError, NotADirectoryError):
            place = next(place for place in (out, *out.parents) if place.exists())
            raise DatasetError(f"{place}: is a file; {option} needs a folder") from None
        except OSError as error:
            raise SurgbenchError(f"{out}: cannot be written ({error.strerror})") from None
        if descriptor is None:
            raise in_use(out, command, option)
        held.callback(os.close, descriptor)
        if made:
            held.callback(_remove_empty, out)  # before the lock is let go
        yield


@contextmanager
def locked_beside(path: Path) -> Iterator[bool]:
    """Hold a file, which need not be there, against other commands for the time of the block.

    Args:
        path: The file. The lock is one beside it, removed with the block; one that a killed process left behind is
            locked by nobody.

    Yields:
        Whether it is ours. If not, another process is at it.

    Raises:
        OSError: Nothing can be written there.
    """
    if not path.name or path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "is a folder; name a file", str(path))
    beside = path.with_name(path.name + LOCK_SUFFIX)
    beside.parent.mkdir(parents=True, exist_ok=True)
    descriptor = lock(beside, os.O_RDWR | os.O_CREAT)
    if descriptor is None:
        yield False
        return
    try:
        yield True
    finally:
        beside.unlink(missing_ok=True)  # while it is locked: whoever has opened it before sees that it is gone
        os.close(descriptor)


def in_use(out: Path, command: str, option: str = "--out") -> DatasetError:
    """What is said to the second of two."""
    return DatasetError(
        f"{out}: another 'surgbench {command}' is at work here; wait for it, or choose another {option}"
    )


def lock(path: Path, flags: int) -> int | None:
    """The open and locked file or folder; ``None`` where another process has it.

    Raises:
        OSError: It cannot be opened.
    """
    while True:
        descriptor = os.open(path, flags, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return None
        except OSError:  # a file system without locks: then calls at once do the work each
            return descriptor
        if _is_at(path, descriptor):
            return descriptor
        os.close(descriptor)


def _is_at(path: Path, descriptor: int) -> bool:
    """Whether what was opened still is what has that name: its last owner may have removed or replaced it since."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _make(folder: Path) -> bool:
    """Make a folder; returns whether it was not there."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        folder.mkdir()
    except FileExistsError:
        return False
    return True


def _remove_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):  # something is in it, as is meant
        folder.rmdir()
