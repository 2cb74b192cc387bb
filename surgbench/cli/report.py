"""``surgbench report``: records to a leaderboard."""

from __future__ import annotations

import sys
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer


class TableFormat(str, Enum):
    """How to write the rows."""

    table = "table"
    csv = "csv"
    markdown = "markdown"
    json = "json"


def report(
    directories: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Folders of records; several become one leaderboard.")
    ],
    table_format: Annotated[
        TableFormat, typer.Option("--format", help="csv and json hold every column and digit.")
    ] = TableFormat.table,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write here, not to standard output.")] = None,
) -> None:
    """Print the leaderboard of the records below one or more folders.

    Example: surgbench report runs --format markdown --out leaderboard.md
    """
    from surgbench.errors import SurgbenchError
    from surgbench.files import write_atomic
    from surgbench.locks import in_use, locked_beside
    from surgbench.report import render
    from surgbench.report.rows import read_rows

    rows = read_rows(directories)
    if table_format is TableFormat.table and out is None:
        from rich.console import Console

        render.print_leaderboard(rows, Console())
        return
    text: str = getattr(render, table_format.value)(rows)
    if out is None:
        sys.stdout.write(text)
        return
    try:
        with locked_beside(out) as ours:
            if not ours:
                raise in_use(out, "report")
            write_atomic(out, text.encode())
    except OSError as error:
        raise SurgbenchError(f"{out}: cannot be written ({error.strerror})") from None
