"""Which of several calls at once makes a record: the one that holds its lock, which ends with its process."""

from __future__ import annotations

import glob
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from surgbench.errors import SurgbenchError
from surgbench.files import PARTIAL_SUFFIX
from surgbench.locks import LOCK_SUFFIX, locked_beside


@contextmanager
def claim(record: Path) -> Iterator[bool]:
    """Claim the making of a record for the time of the block.

    Args:
        record: Its file.

    Yields:
        Whether it is ours. If not, another process is at it.

    Raises:
        SurgbenchError: Nothing can be written there.
    """
    with ExitStack() as held:
        try:
            ours = held.enter_context(locked_beside(record))
        except OSError as error:
            raise cannot_write(record, error) from None
        if ours:
            for left in record.parent.glob(f"{glob.escape(record.name)}.*{PARTIAL_SUFFIX}"):
                left.unlink(missing_ok=True)  # by a call that was killed: nobody else writes while we hold the lock
        yield ours


def tidy(record: Path) -> None:
    """Remove what a call that was killed has left beside a record that is there."""
    if record.with_name(record.name + LOCK_SUFFIX).exists():
        with suppress(OSError, SurgbenchError), claim(record):  # where nothing can be written, it stays
            pass


def cannot_write(path: Path, error: OSError) -> SurgbenchError:
    """What is to be said where a record cannot be written."""
    return SurgbenchError(f"{path}: cannot be written ({error.strerror}); mend that, then run the same command again")
