"""Rows compared by pairs, as tables of the page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from surgbench.records.format import Record
from surgbench.report.comparison import compare_records
from surgbench.report.comparison_tables import comparison_notes, comparison_tables, heading
from surgbench.report.page.content import Board, Cell, Head, Line, clipped


def statistics_boards(records: Sequence[Record]) -> Iterator[Board]:
    """The tables of :func:`surgbench.report.comparison_tables.comparison_tables`, notes below the first of each."""
    number = 0
    for comparison in compare_records(records):
        for place, table in enumerate(comparison_tables(comparison)):
            # The page's first column is that of names: numbers of rows stand behind it.
            name = table.columns.index("row")
            order = [name, *(one for one in range(len(table.columns)) if one != name)]
            heads = tuple(
                Head(clipped(table.columns[one] or "number", 80), is_text=one < table.text_columns) for one in order
            )
            lines = tuple(
                Line(f"pair-{number}-{at}", clipped(line[name]), tuple(Cell(clipped(line[one])) for one in order[1:]))
                for at, line in enumerate(table.lines)
            )
            notes = (table.note, *(comparison_notes(comparison) if not place else ()))
            title = clipped(f"{table.heading}: {heading(comparison)}")
            yield Board(f"pairs-{number}", title, heads, lines, " ".join(map(clipped, notes)))
            number += 1
