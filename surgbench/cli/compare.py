"""``surgbench compare``: rows held against each other, sequence by sequence."""

from __future__ import annotations

import sys
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer


class ComparisonFormat(str, Enum):
    """How to write a comparison."""

    table = "table"
    csv = "csv"
    markdown = "markdown"
    json = "json"
    latex = "latex"


def compare(
    directories: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Folders of records; several are compared as one.")
    ],
    error: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Column to compare; unless told, what rows are ranked by."),
    ] = None,
    comparison_format: Annotated[
        ComparisonFormat, typer.Option("--format", help="csv and json have a line for each pair; latex is for papers.")
    ] = ComparisonFormat.table,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write here, not to standard output.")] = None,
    diagram: Annotated[
        Path | None,
        typer.Option(metavar="FILE.png|svg", help="Also draw mean ranks and their critical difference (extra plots)."),
    ] = None,
) -> None:
    """Hold the rows of a leaderboard against each other by pairs, sequence by sequence.

    Example: surgbench compare runs --error tip_error_m

    Example: surgbench compare runs --format latex --out compared.tex --diagram ranks.svg

    Who wins on how many sequences, mean differences with 95 % intervals, Wilcoxon's signed ranks with Holm's correction
    for the number of pairs, and mean ranks with their critical difference: docs/metrics.md.
    """
    from surgbench.cli.written import write_text
    from surgbench.records.reader import read_records
    from surgbench.report import comparison_tables
    from surgbench.report.comparison import PAIR_COLUMNS, compare_records, pair_rows
    from surgbench.report.frame import csv_text, json_text, to_frame

    comparisons = compare_records(read_records(directories), error)
    if diagram is not None:
        from surgbench.report.rank_diagram import draw_ranks

        draw_ranks(comparisons, diagram)
        print(diagram, file=sys.stderr)
    if comparison_format is ComparisonFormat.table and out is None:
        from surgbench.report.fold import terminal

        comparison_tables.print_comparisons(comparisons, terminal())
        return
    if comparison_format in (ComparisonFormat.csv, ComparisonFormat.json):
        frame = to_frame(pair_rows(comparisons), PAIR_COLUMNS)
        text = csv_text(frame) if comparison_format is ComparisonFormat.csv else json_text(frame)
    else:
        text = getattr(comparison_tables, comparison_format.value)(comparisons)
    write_text(text, out, "compare")
