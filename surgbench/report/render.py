"""Rows as a terminal table, Markdown, CSV or JSON.

CSV and JSON hold every column and every digit. The table and the Markdown are for reading: chosen columns, rounded,
millimetres for lengths, the best value of a column in bold.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

from surgbench.records.format import SKIPPED
from surgbench.report.column import ROW, STATUS, VARIANT
from surgbench.report.field import keys
from surgbench.report.frame import csv_text, json_list, to_frame, to_rows
from surgbench.report.leaderboard import Ranking, groups, reason, shown, unsound
from surgbench.report.markdown import escape, markdown_table
from surgbench.report.row import Row
from surgbench.report.rows import columns as columns_of
from surgbench.task import find_task

if TYPE_CHECKING:
    from rich.console import Console

TABLE_WIDTH = 100
ROW_MIN_WIDTH = 8


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
        columns, ranking = shown(group), Ranking(group)
        failed = unsound(group)
        if failed:
            columns.append(STATUS)
        lines = [[column.heading for column in columns]]
        for row in group:
            cells = [escape(column.text(row.get(column.key))) for column in columns]
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
    """The terminal table as plain text, ``width`` characters wide."""
    from rich.console import Console

    out = io.StringIO()
    print_leaderboard(rows, Console(file=out, width=width, color_system=None))
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines()) + "\n"


def print_leaderboard(rows: Sequence[Row], console: Console) -> None:
    """Print the leaderboard, fitted to the console's width (80 is enough).

    Args:
        rows: From :func:`surgbench.report.rows.derive_rows`.
        console: Where to.
    """
    from rich import box
    from rich.table import Table
    from rich.text import Text

    for title, group in groups([row for row in rows if find_task(row["task"]).is_whole(row)]):
        columns, ranking = shown(group, console.width), Ranking(group)
        sheet = Table(title=Text(title), title_justify="left", box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
        for column in columns:
            is_text = column in (ROW, VARIANT)
            sheet.add_column(
                Text(column.short),
                justify="left" if is_text else "right",
                no_wrap=not is_text,
                overflow="fold",
                min_width=ROW_MIN_WIDTH if is_text else None,
            )
        for row in group:
            cells = [
                Text(column.text(row.get(column.key)), style="bold" if ranking.place(column, row) == 1 else "")
                for column in columns
            ]
            sheet.add_row(*cells, style=_style(row))
        console.print(sheet)
        for row in unsound(group):
            console.print(Text(reason(row), style=_style(row) or ""), soft_wrap=True)


def _style(row: Row) -> str | None:
    return {"ok": None, SKIPPED: "dim"}.get(row["status"], "red")
