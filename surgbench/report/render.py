"""Rows as a terminal table, Markdown, CSV or JSON.

CSV and JSON hold every column and every digit. The table and the Markdown are for reading: chosen columns, rounded,
millimetres for lengths, the best value of a column in bold.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from surgbench.records.format import DEFAULT, SKIPPED
from surgbench.report.column import ROW, STATUS, VARIANT
from surgbench.report.field import keys
from surgbench.report.fold import TABLE_WIDTH, Head, plain, print_folded
from surgbench.report.frame import csv_text, json_list, to_frame, to_rows
from surgbench.report.leaderboard import Ranking, groups, reason, set_columns, unsound, variant_tells
from surgbench.report.markdown import escape, markdown_table
from surgbench.report.row import PROCESSOR, Row
from surgbench.report.rows import columns as columns_of
from surgbench.task import find_task

if TYPE_CHECKING:
    from rich.console import Console


def csv(rows: Sequence[Row]) -> str:
    """All columns; floats with all their digits, empty cells for missing values."""
    return csv_text(to_frame(_own(rows), columns_of(rows)))


def json(rows: Sequence[Row]) -> str:
    """A list of rows; floats with all their digits, null for missing values."""
    typed = to_rows(to_frame(_own(rows), columns_of(rows)))
    return json_list([{key: one[key] for key in own} for own, one in zip(_own(rows), typed, strict=True)])


def _own(rows: Sequence[Row]) -> list[Row]:
    """Each with the columns of its own task only."""
    own = {name: keys(columns_of([row for row in rows if row["task"] == name])) for name in {r["task"] for r in rows}}
    return [{key: row.get(key) for key in own[row["task"]]} for row in rows]


def markdown(rows: Sequence[Row]) -> str:
    """One table per dataset and number of arms, and a line for every failure."""
    parts = []
    for title, group in groups([row for row in rows if find_task(row["task"]).on_page(row)]):
        columns, ranking = set_columns(group), Ranking(group)
        failed = unsound(group)
        if failed:
            columns.append(STATUS)
        lines = [[column.heading for column in columns]]
        for row in group:
            cells = [escape(column.cell(row)) for column in columns]
            lines.append(
                [
                    f"**{cell}**" if ranking.place(column, row) == 1 else cell
                    for column, cell in zip(columns, cells, strict=True)
                ]
            )
        body = markdown_table(lines, [column.decimals is None for column in columns])
        failures = [f"- {escape(reason(row))}" for row in failed]
        parts.append("\n".join([f"### {escape(title)}", "", body, *([""] if failures else []), *failures]) + "\n")
    return "\n".join(parts)


def table(rows: Sequence[Row], width: int = TABLE_WIDTH) -> str:
    """The terminal table as plain text, at most ``width`` characters wide."""
    return plain(lambda console: print_leaderboard(rows, console), width)


def print_leaderboard(rows: Sequence[Row], console: Console) -> None:
    """Print the leaderboard, folded where the console is narrow.

    Args:
        rows: From :func:`surgbench.report.rows.derive_rows`.
        console: Where to.
    """
    from rich.text import Text

    for title, group in groups([row for row in rows if find_task(row["task"]).is_whole(row)]):
        columns, ranking = set_columns(group), Ranking(group)
        if VARIANT in columns and not variant_tells(group):  # it is long, and the least that is looked for
            columns = [*(column for column in columns if column is not VARIANT), VARIANT]
        if all(row["variant"] == DEFAULT for row in group):
            columns = [column for column in columns if column is not VARIANT]
        heads = [Head(column.short, is_text=column in (ROW, VARIANT) or column.key == PROCESSOR) for column in columns]
        lines = [
            [Text(column.cell(row), style="bold" if ranking.place(column, row) == 1 else "") for column in columns]
            for row in group
        ]
        print_folded(title, heads, lines, console, styles=[_style(row) for row in group])
        for row in unsound(group):
            console.print(Text(reason(row), style=_style(row) or ""), soft_wrap=True)


def _style(row: Row) -> str | None:
    return {"ok": None, SKIPPED: "dim"}.get(row["status"], "red")
