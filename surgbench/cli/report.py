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
    latex = "latex"


def report(
    directories: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Folders of records; several become one leaderboard.")
    ],
    table_format: Annotated[
        TableFormat, typer.Option("--format", help="csv and json hold every column and digit; latex is for papers.")
    ] = TableFormat.table,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write here, not to standard output.")] = None,
    plots: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Also draw errors, rules and latencies of camera runs over time in here."),
    ] = None,
    dataset: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Where the dataset is, if it moved since the run; for --plots.")
    ] = None,
) -> None:
    """Print the leaderboard of the records below one or more folders.

    Example: surgbench report runs --format markdown --out leaderboard.md

    Example: surgbench report runs --plots plots
    """
    from surgbench.cli.written import write_text
    from surgbench.errors import ConfigError
    from surgbench.records.reader import read_records
    from surgbench.report import comparison_tables, render
    from surgbench.report.comparison import compare_records
    from surgbench.report.latex import latex
    from surgbench.report.rows import derive_rows

    if plots is not None:
        _draw_plots(directories, plots, dataset)
    elif dataset is not None:
        raise ConfigError("--dataset: is for --plots; a leaderboard needs no dataset")
    records = read_records(directories)
    rows = derive_rows(records, reported=True)
    if table_format is TableFormat.table and out is None:
        from surgbench.report.fold import terminal

        render.print_leaderboard(rows, terminal())
        return
    text: str = latex(rows) if table_format is TableFormat.latex else getattr(render, table_format.value)(rows)
    if table_format is TableFormat.markdown:
        compared = comparison_tables.markdown(compare_records(records))
        text += f"\n{compared}" if compared else ""
    write_text(text, out, "report")


def _draw_plots(directories: list[Path], folder: Path, dataset: Path | None) -> None:
    """A picture for each unit, whose paths go to standard error: standard output is the table's."""
    from surgbench.cli.progress import progress
    from surgbench.locks import sole_writer
    from surgbench.records.reader import only_task, read_records

    records = read_records(directories)
    task = only_task(records, directories[0])
    with sole_writer(folder, "report", "--plots"):
        for path in task.plots(records, dataset, folder, progress):
            print(path, file=sys.stderr)
