"""What ``--dry-run`` tells of time and disk."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surgbench.cli.progress import progress

if TYPE_CHECKING:
    from surgbench.dataset.base import Dataset
    from surgbench.suite.settings import Job


def tell_forecast(todo: list[Job], dataset: Dataset[Any], out: Path, jobs: int) -> None:
    """Say on standard error what runs will take, row by row.

    Args:
        todo: What is to be run.
        dataset: What all of it is about.
        out: Folder of records.
        jobs: Runs at a time.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from surgbench.report.column import NO_VALUE
    from surgbench.suite.forecast import by_row, forecasts, seconds_in_all

    rows = by_row(todo)
    found = []
    with progress("rows measured", len(rows)) as bar:
        for row in forecasts(rows, dataset, out):
            found.append(row)
            bar(1)
    sheet = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    for name in ("row", "runs", "frames", "time", "MB", "known from"):
        sheet.add_column(name, justify="right" if name in ("runs", "frames", "time", "MB") else "left", overflow="fold")
    for row in found:
        known = (duration(row.seconds), f"{row.size_bytes / 1e6:.1f}", row.rate.known_from)
        shown = known if row.rate.problem is None else (NO_VALUE,) * len(known)
        sheet.add_row(Text(row.row_id), str(row.runs), str(row.frames), *shown)
    Console(stderr=True).print(sheet)
    for row in found:
        if row.rate.problem is not None:
            print(f"{row.row_id}: {row.rate.problem}", file=sys.stderr)
    place = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.is_dir())
    free, need = shutil.disk_usage(place).free, sum(row.size_bytes for row in found)
    print(
        f"about {duration(seconds_in_all(found, jobs))} with --jobs {jobs}; records of {need / 1e6:.1f} MB, "
        f"{free / 1e6:.0f} MB free",
        file=sys.stderr,
    )


def duration(seconds: float) -> str:
    """Time for people: seconds, minutes, or hours and minutes.

    Example:
        >>> from surgbench.cli.forecast import duration
        >>> [duration(value) for value in (0.2, 45.0, 600.0, 9000.0)]
        ['1 s', '45 s', '10 min', '2 h 30 min']
    """
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
