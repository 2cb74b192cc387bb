"""What a tracker prints: passed on to standard error, up to a bound, and never kept."""

from __future__ import annotations

import contextlib
import os
import threading

# Of one process. A tracker that prints a line per frame of a long sequence stays far below.
MOST_PRINTED_BYTES = 1 << 20
_CHUNK_BYTES = 1 << 16


class Printed:
    """A pipe that is read as long as anybody writes to it, so that nobody who prints has to wait.

    Args:
        most: Bytes that are passed on; what comes after is thrown away.
    """

    def __init__(self, most: int = MOST_PRINTED_BYTES) -> None:
        self._ours, self.theirs = os.pipe()
        self._left = most
        self._reader = threading.Thread(target=self._pass_on, daemon=True)

    def begin(self) -> None:
        """Read; whoever writes has :attr:`theirs` by now."""
        os.close(self.theirs)
        self._reader.start()

    def end(self) -> None:
        """Wait for the last words, of who has ended."""
        self._reader.join(1.0)  # longer only where somebody who has got away still writes

    def _pass_on(self) -> None:
        while data := os.read(self._ours, _CHUNK_BYTES):
            if self._left > 0:
                told = data[: self._left]
                self._left -= len(told)
                if not self._left:
                    told += b"\n(it prints more, which is left out)\n"
                with contextlib.suppress(OSError):  # nobody reads, or the disk is full
                    os.write(2, told)
        os.close(self._ours)
