"""Rows as a terminal table, Markdown, CSV or JSON.

CSV and JSON hold every column and every digit. The table and the Markdown are for reading: chosen columns, rounded,
millimetres for lengths, the best value of a column in bold.
"""

from __future__ import annotations

import csv as csv_format
import io
import json as json_format
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from surgbench.report.records import SKIPPED
from surgbench.report.rows import Row
from surgbench.report.rows import columns as columns_of

if TYPE_CHECKING:
    from rich.console import Console

TABLE_WIDTH = 100
ROW_MIN_WIDTH = 8
NO_VALUE = "–"


@dataclass(frozen=True)
class Column:
    """One column for reading.

    Attributes:
        key: Key of the row.
        short: Heading in the terminal, with the unit on a line of its own.
        long: Heading in Markdown.
        decimals: ``None`` for text and counts.
        scale: Multiplies the value (1000 turns metres into millimetres).
        best: The smallest value of a sound row is marked.
        from_width: Terminals narrower than this go without it; Markdown shows all.
    """

    key: str
    short: str
    long: str
    decimals: int | None = None
    scale: float = 1.0
    best: bool = False
    from_width: int = 0

    def text(self, row: Row) -> str:
        """The value as shown."""
        value = row[self.key]
        if value is None:
            return NO_VALUE
        if self.decimals is None:
            return str(value)
        shown = value * self.scale
        if self.decimals == 0 and 0 < shown < 1:  # little is not nothing
            return f"{shown:.1g}"
        return f"{shown:.{self.decimals}f}"


ROW = Column("row_id", "row", "row")
VARIANT = Column("variant", "variant", "variant", from_width=120)
STATUS = Column("status", "status", "status")
COLUMNS = (
    ROW,
    VARIANT,
    Column("sequences", "seq.", "sequences"),
    Column("coverage", "done\n%", "done [%]", 0, 100.0),
    Column("mask_error", "mask\nerror", "mask error", 3, best=True),
    Column("mask_error_true", "true\nmask", "true mask error", 3, best=True, from_width=100),
    Column("rotation_error_rad", "rot.\nrad", "rotation [rad]", 3, best=True),
    Column("translation_error_m", "trans.\nmm", "translation [mm]", 2, 1000.0, best=True),
    Column("tip_error_m", "tips\nmm", "tips [mm]", 2, 1000.0, best=True, from_width=100),
    Column("q1_error_rad", "q1\nrad", "q1 [rad]", 3, best=True),
    Column("q2_error_rad", "q2\nrad", "q2 [rad]", 3, best=True),
    Column("q3_error_rad", "q3\nrad", "q3 [rad]", 3, best=True),
    Column("keypoint_error_px", "tips\npx", "keypoints [px]", 1, best=True),
    Column("start_lag_ms", "start\nlag ms", "start lag [ms]", 1, from_width=130),
    Column("latency_ms", "time\nms", "latency [ms]", 1, best=True),
    Column("latency_ms_p95", "p95\nms", "p95 [ms]", 1, from_width=100),
)


# Of viewpoint controllers; the page has every subset of the samples, the terminal all of them together.
VIEWPOINT = (
    ROW,
    VARIANT,
    Column("subset", "samples\nof", "samples"),
    Column("samples", "n", "n", from_width=110),
    Column("coverage", "done\n%", "done [%]", 0, 100.0),
    Column("vva_deg", "VVA\ndeg", "VVA [deg]", 2, best=True),
    Column("fd_mm", "FD\nmm", "FD [mm]", 2, best=True),
    Column("pf_deg", "PF\ndeg", "PF [deg]", 2, best=True),
    Column("an_deg", "AN\ndeg", "AN [deg]", 1, best=True),
    Column("pn_mm", "PN\nmm", "PN [mm]", 1, best=True),
    Column("vva_true_deg", "true\nVVA", "true VVA [deg]", 2, best=True, from_width=90),
    Column("constrained_percent", "bound\n%", "constrained [%]", 1),
    Column("visibility_any_percent", "seen\n%", "visible to a camera [%]", 2, from_width=90),
    Column("no_go_violations", "no-\ngo", "no-go violations"),
    Column("limit_violations", "limit", "limit violations", from_width=100),
    Column("latency_ms", "time\nms", "latency [ms]", 3, best=True),
    Column("latency_ms_p999", "p99.9\nms", "p99.9 [ms]", 3, from_width=90),
)


def csv(rows: Sequence[Row]) -> str:
    """All columns; floats with all their digits, empty cells for missing values."""
    out = io.StringIO()
    writer = csv_format.DictWriter(out, columns_of(rows), lineterminator="\n")
    writer.writeheader()
    writer.writerows([{key: value for key, value in row.items() if key in columns_of([row])} for row in rows])
    return out.getvalue()


def json(rows: Sequence[Row]) -> str:
    """A list of rows; floats with all their digits, null for missing values."""
    rows = [{key: row[key] for key in columns_of([row])} for row in rows]
    return json_format.dumps(rows, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def markdown(rows: Sequence[Row]) -> str:
    """One table per dataset and number of arms, and a line for every failure."""
    parts = []
    for title, group in _groups([row for row in rows if row.get("camera") is None]):
        columns, best = _shown(group), _best(group)
        unsound = _unsound(group)
        if unsound:
            columns.append(STATUS)
        lines = [
            f"### {_escape(title)}",
            "",
            _markdown_line([column.long for column in columns]),
            _markdown_line(["---" if column.decimals is None else "---:" for column in columns]),
        ]
        for row in group:
            cells = [_escape(column.text(row)) for column in columns]
            marked = [
                f"**{cell}**" if _is_best(column, row, best) else cell
                for column, cell in zip(columns, cells, strict=True)
            ]
            lines.append(_markdown_line(marked))
        failures = [f"- {_escape(_reason(row))}" for row in unsound]
        parts.append("\n".join([*lines, *([""] if failures else []), *failures]) + "\n")
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

    for title, group in _groups(
        [row for row in rows if row.get("subset", "all") == "all" and row.get("camera") is None]
    ):
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
            cells = [Text(column.text(row), style="bold" if _is_best(column, row, best) else "") for column in columns]
            sheet.add_row(*cells, style=_style(row))
        console.print(sheet)
        for row in _unsound(group):
            console.print(Text(_reason(row), style=_style(row) or ""), soft_wrap=True)


def _groups(rows: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        arms = {"single": "single arms", "dual": "both arms together"}.get(row.get("arms", ""), "viewpoint")
        groups.setdefault((row["dataset"], arms), []).append(row)
    for (dataset, arms), group in groups.items():
        yield f"{dataset}, {arms}", group


def _columns(rows: list[Row]) -> tuple[Column, ...]:
    return COLUMNS if rows[0]["task"] == "instrument" else VIEWPOINT


def _shown(rows: list[Row], width: int | None = None) -> list[Column]:
    """Columns worth their room in ``width`` characters (``None``: any): not those without a value."""
    ids = [(row["row_id"], row.get("subset")) for row in rows]
    # Rows of one name can be told apart by their variant alone, and a floor must be known for what it is.
    telling = len(set(ids)) < len(ids) or any(row.get("floor") for row in rows)
    return [
        column
        for column in _columns(rows)
        if (width is None or width >= column.from_width or (column is VARIANT and telling))
        and (column is ROW or any(row[column.key] is not None for row in rows))
        and (column.key != "coverage" or any(row["coverage"] < 1 for row in rows))
        and (column.key != "subset" or len({row["subset"] for row in rows}) > 1)
    ]


def _best(rows: list[Row]) -> dict[Any, Any]:
    """Of each subset and column the smallest value."""
    sound = [row for row in rows if _ranks(row)]
    best: dict[Any, Any] = {}
    for subset in dict.fromkeys(row.get("subset") for row in sound):
        own = [row for row in sound if row.get("subset") == subset]
        for column in _columns(rows) if len(own) > 1 else ():
            values = [row[column.key] for row in own if row[column.key] is not None]
            if values:
                best[subset, column.key] = min(values)
    return best


def _is_best(column: Column, row: Row, best: dict[Any, Any]) -> bool:
    value = row[column.key]
    return column.best and _ranks(row) and value is not None and value == best.get((row.get("subset"), column.key))


def _ranks(row: Row) -> bool:
    return row["status"] == "ok" and not row.get("floor")


def _unsound(rows: list[Row]) -> list[Row]:
    return [
        row for row in rows if row["status"] != "ok" and row.get("subset", "all") == "all" and not row.get("camera")
    ]


def _reason(row: Row) -> str:
    return f"{row['row_id']}: {row['status']}: {row['error'] or 'no message'}"


def _style(row: Row) -> str | None:
    return {"ok": None, SKIPPED: "dim"}.get(row["status"], "red")


def _markdown_line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _escape(text: str) -> str:
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("\n", " ")
