"""Parts of pages in Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from surgbench.report.row import Row


def markdown_table(lines: Sequence[Sequence[str]], text_columns: int | Sequence[bool]) -> str:
    """A table of cells; the first line holds the headings.

    Args:
        lines: Equally long.
        text_columns: How many columns, the first ones, hold text, or of each whether it does; the others hold numbers,
            which stand on the right.
    """
    if isinstance(text_columns, int):
        text_columns = [column < text_columns for column in range(len(lines[0]))]
    rule = ["---" if is_text else "---:" for is_text in text_columns]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in [lines[0], rule, *lines[1:]])


def failure_lines(rows: Sequence[Row]) -> list[str]:
    """A list of the rows that failed or were skipped and why, as one text; empty where there are none."""
    lines = [
        f"- `{row['row_id']}` {row['status']}: {escape(row['error'] or 'no message')}"
        for row in rows
        if row["status"] != "ok"
    ]
    return ["\n".join(lines)] if lines else []


def escape(text: str) -> str:
    """A text as it may stand in a cell."""
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("\n", " ")


QUICK_WARNING = "A quick run: a few frames of a few sequences, **not to be quoted**."
