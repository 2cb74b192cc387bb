"""Ctrl-C, and processes that are not to hear of it."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_ctrl_c() -> Iterator[None]:
    """Hold Ctrl-C back until the end, from processes started meanwhile for good.

    To ignore it is not enough for a worker: Mitsuba's own handler would leave the image in hand unfinished.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
