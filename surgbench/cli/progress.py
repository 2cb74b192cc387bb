"""Progress bars on a terminal, plain lines otherwise; always on standard error."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Protocol

PLAIN_INTERVAL_S = 10.0


class Bar(Protocol):
    """Shows how far long work has come. Safe to call from several threads."""

    def __call__(self, amount: float) -> None:
        """So much more of the total has been done."""

    def stage(self, description: str, fraction: float) -> None:
        """A part of the work that the total does not count has come to ``fraction``; 1 ends it."""


class _PlainBar:
    def __init__(self, description: str, total: float) -> None:
        self._description, self._total = description, total
        self._done, self._next_line = 0.0, time.monotonic()
        self._stages: dict[str, float] = {}
        self._lock = Lock()

    def __call__(self, amount: float) -> None:
        with self._lock:
            self._done += amount
            if amount and (time.monotonic() >= self._next_line or self._done >= self._total):
                self._next_line = time.monotonic() + PLAIN_INTERVAL_S
                print(f"{self._description}: {self._done:g}/{self._total:g}", file=sys.stderr, flush=True)

    def stage(self, description: str, fraction: float) -> None:
        with self._lock:
            if time.monotonic() >= self._stages.get(description, 0.0) and fraction < 1:
                self._stages[description] = time.monotonic() + PLAIN_INTERVAL_S
                print(f"{description}: {100 * fraction:.0f} %", file=sys.stderr, flush=True)


@contextmanager
def progress(description: str, total: float) -> Iterator[Bar]:
    """Show how far long work has come.

    Args:
        description: What is being done, a few words.
        total: How much there is to do, in any unit.

    Yields:
        A function that takes how much more has been done.
    """
    if not sys.stderr.isatty():
        yield _PlainBar(description, total)
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TaskID,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as bars:
        main = bars.add_task(description, total=total)
        stages: dict[str, TaskID] = {}
        lock = Lock()

        class RichBar:
            def __call__(self, amount: float) -> None:
                bars.advance(main, amount)

            def stage(self, description: str, fraction: float) -> None:
                with lock:
                    if description not in stages:
                        stages[description] = bars.add_task(description, total=100)
                    bars.update(stages[description], completed=round(100 * fraction), visible=fraction < 1)

        yield RichBar()
