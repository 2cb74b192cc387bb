"""Which of several calls at once makes a record: the one that holds its lock, which ends with its process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from surgbench.errors import SurgbenchError
from surgbench.locks import locked_beside


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
        yield ours


def cannot_write(path: Path, error: OSError) -> SurgbenchError:
    """What is to be said where a record cannot be written."""
    return SurgbenchError(f"{path}: cannot be written ({error.strerror}); mend that, then run the same command again")
