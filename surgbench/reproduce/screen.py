"""A reproduced table in the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from surgbench.report.fold import Head, print_folded
from surgbench.report.render import print_leaderboard
from surgbench.reproduce.compare import Comparison, Pair, compare
from surgbench.reproduce.results import Results
from surgbench.reproduce.table import Definition
from surgbench.task import find_task

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text


def print_table(definition: Definition, results: Results, console: Console) -> None:
    """Print every block, and its published figures beside ours."""
    from rich.text import Text

    console.print(Text(definition.table.title, style="bold"))
    for block in definition.table.blocks:
        console.print(Text(f"\n{block.heading}", style="bold"))
        # The table's file says which options make a row what it is.
        rows = [
            {**row, "variant": "not for ranking" if row.get("floor") else None}
            for row in results.rows
            if row["block"] == block.name
        ]
        print_leaderboard(rows, console)
        sheet = find_task(definition.table.task).sheet
        comparisons = compare(block, results.rows, definition.published, sheet.measures, sheet.instead)
        if comparisons and definition.published is not None:
            _print_comparisons(comparisons, definition.published.short, console)
    if results.about["quick"]:
        console.print("A quick run: a few frames of a few sequences, not to be quoted.")


def _print_comparisons(comparisons: list[Comparison], source: str, console: Console) -> None:
    from rich.text import Text

    measures = list(dict.fromkeys(pair.measure for one in comparisons for pair in one.pairs))
    title = f"beside {source}: theirs, ours, ± over sequences, ours / theirs (bold: no worse)"
    heads = [Head("row", is_text=True), Head("", is_text=True)]
    heads += [Head(f"{measure.name}\n{measure.unit}") for measure in measures]
    lines = []
    for one in comparisons:
        pairs = {pair.measure: pair for pair in one.pairs}
        cells = [_cell(pairs.get(measure)) for measure in measures]
        lines.append([Text(one.row.id), Text("theirs\nours\n±\nratio"), *cells])
    print_folded(title, heads, lines, console, kept=2)


def _cell(pair: Pair | None) -> Text:
    from rich.text import Text

    if pair is None:
        return Text("–")
    ratio = "–" if pair.ratio is None else f"{pair.ratio:.2f}"
    lines = (pair.measure.text(pair.published), pair.measure.text(pair.ours), pair.measure.text(pair.sem))
    return Text.assemble("\n".join(lines), "\n", (ratio, "bold" if pair.met else ""))
