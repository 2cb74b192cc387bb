"""The leaderboard's tables: the columns of the Markdown page with the same digits, and all others besides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from surgbench.records.format import Record
from surgbench.report.column import NO_VALUE, STATUS, Column
from surgbench.report.leaderboard import Ranking, groups, set_columns, unsound
from surgbench.report.page.content import Board, Cell, Head, Line, clipped
from surgbench.report.row import Row
from surgbench.report.rows import columns, derive_runs
from surgbench.task import Task, find_task

DIGITS = 6  # of numbers in columns that nobody has said how to show


@dataclass(frozen=True)
class Group:
    """The rows of one table, and the records that each is of.

    Attributes:
        number: Of the table, from 0.
        title: What stands over it.
        rows: By rank.
        records: Of each row.
        anchors: Of each row.
        abouts: Anchors of where each row is from; rows of one run have the same.
    """

    number: int
    title: str
    rows: tuple[Row, ...]
    records: tuple[tuple[Record, ...], ...]
    anchors: tuple[str, ...]
    abouts: tuple[str, ...]

    @property
    def task(self) -> Task:
        """What its rows did."""
        return find_task(self.rows[0]["task"])

    @property
    def whole(self) -> list[int]:
        """Places of the rows that stand for whole runs."""
        return [place for place, row in enumerate(self.rows) if self.task.is_whole(row)]


def grouped(records: Sequence[Record]) -> list[Group]:
    """The leaderboard's tables, as :func:`surgbench.report.leaderboard.groups` has them."""
    pairs = [(row, run.records) for run in derive_runs(records, reported=True) for row in run.rows]
    members_of = {id(row): members for row, members in pairs if find_task(row["task"]).on_page(row)}
    runs: dict[tuple[Any, ...], str] = {}
    found, count = [], 0
    for number, (title, rows) in enumerate(groups([row for row, _ in pairs if id(row) in members_of])):
        keys = [(number, row["row_id"], row["settings_hash"]) for row in rows]
        abouts = tuple(runs.setdefault(key, f"about-{len(runs)}") for key in keys)
        anchors = tuple(f"row-{count + place}" for place in range(len(rows)))
        count += len(rows)
        members = tuple(tuple(members_of[id(row)]) for row in rows)
        found.append(Group(number, clipped(title), tuple(rows), members, anchors, abouts))
    return found


def board(group: Group) -> Board:
    """A table of the page."""
    rows = list(group.rows)
    main, ranking = set_columns(rows), Ranking(rows)
    if unsound(rows):
        main.append(STATUS)
    present = {key for row in rows for key, value in row.items() if value is not None}
    known = {column.key for column in main}
    further = [one for one in columns(rows) if one.key in present and one.key not in known]
    heads = [
        Head(column.name, column.unit, is_text=column.decimals is None and _is_text(rows, column)) for column in main
    ]
    heads += [Head(one.key, main=False, is_text=one.type in ("text", "flag")) for one in further]
    lines = []
    for row, anchor, about in zip(rows, group.anchors, group.abouts, strict=True):
        cells = [_shown(column, row, ranking) for column in main[1:]] + [_plain(row.get(one.key)) for one in further]
        badges = ("floor: not ranked",) if row.get("floor") else ()
        reason = clipped(row["error"] or "no message") if unsound([row]) else None
        name, status = clipped(row["row_id"]), clipped(row["status"], 40)
        lines.append(Line(anchor, name, tuple(cells), status, reason, badges, about))
    return Board(f"board-{group.number}", group.title, tuple(heads), tuple(lines))


def _is_text(rows: Sequence[Row], column: Column) -> bool:
    return any(isinstance(row.get(column.key), str) for row in rows)


def _shown(column: Column, row: Row, ranking: Ranking) -> Cell:
    value = row.get(column.key)
    return Cell(clipped(column.cell(row)), _number(value), ranking.place(column, row))


def _plain(value: Any) -> Cell:
    if isinstance(value, bool) or not isinstance(value, float):
        return Cell(NO_VALUE if value is None else clipped(str(value)), _number(value))
    return Cell(f"{value:.{DIGITS}g}", _number(value))


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    number = float(value)
    return number if math.isfinite(number) else None
