"""Rows as a terminal table, Markdown, CSV or JSON.

CSV and JSON hold every column and every digit. The table and the Markdown are for reading: chosen columns, rounded,
millimetres for lengths, the best value of a column in bold.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from surgbench.records.format import SKIPPED
from surgbench.report.column import ROW, STATUS, VARIANT, Column
from surgbench.report.field import keys
from surgbench.report.frame import csv_text, json_list, to_frame, to_rows
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
    for title, group in _groups([row for row in rows if find_task(row["task"]).on_page(row)]):
        columns, best = _shown(group), _best(group)
        unsound = _unsound(group)
        if unsound:
            columns.append(STATUS)
        lines = [[column.heading for column in columns]]
        for row in group:
            cells = [escape(column.text(row.get(column.key))) for column in columns]
            lines.append(
                [
                    f"**{cell}**" if _is_best(column, row, best) else cell
                    for column, cell in zip(columns, cells, strict=True)
                ]
            )
        body = markdown_table(lines, [column.decimals is None for column in columns])
        failures = [f"- {escape(_reason(row))}" for row in unsound]
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

    for title, group in _groups([row for row in rows if find_task(row["task"]).is_whole(row)]):
        columns, best = _shown(group, console.width), _best(group)
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
                Text(column.text(row.get(column.key)), style="bold" if _is_best(column, row, best) else "")
                for column in columns
            ]
            sheet.add_row(*cells, style=_style(row))
        console.print(sheet)
        for row in _unsound(group):
            console.print(Text(_reason(row), style=_style(row) or ""), soft_wrap=True)


def _groups(rows: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["dataset"], find_task(row["task"]).title(row)), []).append(row)
    for (dataset, title), group in groups.items():
        yield f"{dataset}, {title}", group


def _columns(rows: list[Row]) -> tuple[Column, ...]:
    return find_task(rows[0]["task"]).shown


def _shown(rows: list[Row], width: int | None = None) -> list[Column]:
    """Columns worth their room in ``width`` characters (``None``: any): not those without a value."""
    ids = [(row["row_id"], _part(row)) for row in rows]
    # Rows of one name can be told apart by their variant alone, and a floor must be known for what it is.
    telling = len(set(ids)) < len(ids) or any(row.get("floor") for row in rows)
    return [
        column
        for column in _columns(rows)
        if (width is None or width >= column.from_width or (column is VARIANT and telling))
        and (column is ROW or any(row.get(column.key) is not None for row in rows))
        and (column.key != "coverage" or any(row["coverage"] < 1 for row in rows))
        and (column.key not in find_task(rows[0]["task"]).parts or len({row[column.key] for row in rows}) > 1)
    ]


def _best(rows: list[Row]) -> dict[Any, Any]:
    """Of each part and column the smallest value."""
    sound = [row for row in rows if _ranks(row)]
    best: dict[Any, Any] = {}
    for part in dict.fromkeys(map(_part, sound)):
        own = [row for row in sound if _part(row) == part]
        for column in _columns(rows) if len(own) > 1 else ():
            values = [row[column.key] for row in own if row.get(column.key) is not None]
            if values:
                best[part, column.key] = min(values)
    return best


def _is_best(column: Column, row: Row, best: dict[Any, Any]) -> bool:
    value = row.get(column.key)
    return column.best and _ranks(row) and value is not None and value == best.get((_part(row), column.key))


def _part(row: Row) -> tuple[Any, ...]:
    """Which part of a run's samples the row is about."""
    return tuple(row.get(column) for column in find_task(row["task"]).parts)


def _ranks(row: Row) -> bool:
    return row["status"] == "ok" and not row.get("floor")


def _unsound(rows: list[Row]) -> list[Row]:
    return [row for row in rows if row["status"] != "ok" and find_task(row["task"]).is_whole(row)]


def _reason(row: Row) -> str:
    return f"{row['row_id']}: {row['status']}: {row['error'] or 'no message'}"


def _style(row: Row) -> str | None:
    return {"ok": None, SKIPPED: "dim"}.get(row["status"], "red")
