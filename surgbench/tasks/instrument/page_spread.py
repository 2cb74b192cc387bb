"""The part of a page that stands beside an article's mean ± standard deviation over sequences."""

from __future__ import annotations

from collections.abc import Sequence

from surgbench.report.column import NO_VALUE, Column
from surgbench.report.markdown import escape, markdown_table
from surgbench.report.row import Row
from surgbench.reproduce.over_sequences import SUFFIX
from surgbench.reproduce.published import Figure, Published
from surgbench.reproduce.table import Block
from surgbench.tasks.instrument.columns import PAGE_RATE, PAGE_TRUE_MASK

SPREAD_NOTE = (
    "Means over sequences, here single arms, ± their standard deviation. Masks are held against the clean ones. Frames "
    "per second are of everything that a user waits for: making masks or finding markers, predicting, searching; they "
    "are of the runs that times were measured on, one at a time."
)


def spread_table(block: Block, rows: Sequence[Row], published: Published | None) -> str:
    """Of rows with a spread over sequences, a line each, and the published one of those that have one; else nothing."""
    columns = (PAGE_TRUE_MASK, PAGE_RATE)
    told = {row["row_id"]: row for row in rows if row.get(PAGE_RATE.key) is not None}
    if not told:
        return ""
    lines = [["method", "row id", *(column.heading for column in columns)]]
    shown: set[str] = set()
    for row in block.rows:
        if row.id not in told:
            continue
        name = row.published or row.beside
        if published is not None and name is not None and name not in shown:
            shown.add(name)
            theirs = published.rows[name].data.get(str(block.published_on), {})
            figures = [_published(column, theirs.get(column.key)) for column in columns]
            lines.append([f"*{escape(published.rows[name].label)}*", f"*{published.short}*", *figures])
        own = told[row.id]
        cells = [column.with_spread(own[column.key], own.get(column.key + SUFFIX)) for column in columns]
        lines.append([escape(row.label), f"`{row.id}`", *cells])
    return markdown_table(lines, text_columns=2)


def _published(column: Column, figure: float | Figure | None) -> str:
    if figure is None:
        return NO_VALUE
    return column.with_spread(figure.mean, figure.std) if isinstance(figure, Figure) else column.text(figure)
