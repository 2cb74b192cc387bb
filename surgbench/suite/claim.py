"""Which of several calls at once makes a record: the one that holds its lock, which ends with its process."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from surgbench.errors import SurgbenchError

LOCK_SUFFIX = ".lock"


@contextmanager
def claim(record: Path) -> Iterator[bool]:
    """Claim the making of a record for the time of the block.

    Args:
        record: Its file; the lock is a file beside it, removed with the block. One that a killed process left behind
            is locked by nobody.

    Yields:
        Whether it is ours. If not, another process is at it.

    Raises:
        SurgbenchError: Nothing can be written there.
    """
    lock = record.with_name(record.name + LOCK_SUFFIX)
    try:
        lock.parent.mkdir(parents=True, exist_ok=True)
        descriptor = _locked(lock)
    except OSError as error:
        raise cannot_write(record, error) from None
    if descriptor is None:
        yield False
        return
    try:
        yield True
    finally:
        lock.unlink(missing_ok=True)  # while it is locked: whoever has opened it before sees that it is gone
        os.close(descriptor)


def _locked(lock: Path) -> int | None:
    """The open and locked file; ``None`` where another process has it."""
    while True:
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return None
        except OSError:  # a file system without locks: then calls at once do the work each
            return descriptor
        if _is_at(lock, descriptor):
            return descriptor
        os.close(descriptor)


def _is_at(lock: Path, descriptor: int) -> bool:
    """Whether the file that was opened is still the one of that name: its last owner may have removed it since."""
    try:
        return os.path.samestat(lock.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def cannot_write(path: Path, error: OSError) -> SurgbenchError:
    """What is to be said where a record cannot be written."""
    return SurgbenchError(f"{path}: cannot be written ({error.strerror}); mend that, then run the same command again")
