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
    html = "html"


def report(
    directories: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Folders of records; several become one leaderboard.")
    ],
    table_format: Annotated[
        TableFormat,
        typer.Option("--format", help="csv and json hold every column and digit; latex is for papers; html is a page."),
    ] = TableFormat.table,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write here, not to standard output.")] = None,
    plots: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Also draw errors, rules and latencies of camera runs over time in here."),
    ] = None,
    dataset: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Where the dataset is, if it moved; for --plots and html.")
    ] = None,
    pictures: Annotated[
        int | None,
        typer.Option(
            min=0, max=100, metavar="N", help="html: draw moments of the N best rows of each table; default 3."
        ),
    ] = None,
    published: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="html: also quote these published figures; may be repeated."),
    ] = None,
) -> None:
    """Print the leaderboard of the records below one or more folders.

    Example: surgbench report runs --format markdown --out leaderboard.md

    Example: surgbench report runs --plots plots

    Example: surgbench report runs --format html --out report.html
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
    elif dataset is not None and table_format is not TableFormat.html:
        raise ConfigError("--dataset: is for --plots and --format html; a leaderboard needs no dataset")
    if table_format is TableFormat.html:
        _write_page(directories, out, pictures, dataset, published or [])
        return
    for option, value in (("--pictures", pictures), ("--published", published)):
        if value:
            raise ConfigError(f"{option}: is for --format html")
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


def _write_page(
    directories: list[Path], out: Path | None, pictures: int | None, dataset: Path | None, published: list[str]
) -> None:
    """The page; what it has no pictures of goes to standard error."""
    from surgbench.cli.progress import progress
    from surgbench.cli.written import write_text
    from surgbench.errors import ConfigError
    from surgbench.records.reader import read_records
    from surgbench.report.page.build import PICTURED_ROWS, build_page

    if out is None and sys.stdout.isatty():
        raise ConfigError("--format html: a page is not for the terminal; say where it goes: --out page.html")
    page = build_page(
        read_records(directories),
        progress,
        pictures=PICTURED_ROWS if pictures is None else pictures,
        dataset=dataset,
        published=published,
        tell=lambda problem: print(problem, file=sys.stderr),
    )
    write_text(page, out, "report")


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
