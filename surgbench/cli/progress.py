"""Progress bars on a terminal, plain lines otherwise; always on standard error."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PLAIN_INTERVAL_S = 10.0


@contextmanager
def progress(description: str, total: float) -> Iterator[Callable[[float], None]]:
    """Show how far long work has come.

    Args:
        description: What is being done, a few words.
        total: How much there is to do, in any unit.

    Yields:
        A function that takes how much more has been done.
    """
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True)) as bar:
            task = bar.add_task(description, total=total)
            yield lambda amount: bar.advance(task, amount)
        return
    done, next_line = 0.0, time.monotonic()

    def advance(amount: float) -> None:
        nonlocal done, next_line
        done += amount
        if time.monotonic() >= next_line or done >= total:
            next_line = time.monotonic() + PLAIN_INTERVAL_S
            print(f"{description}: {done:g}/{total:g}", file=sys.stderr, flush=True)

    yield advance
