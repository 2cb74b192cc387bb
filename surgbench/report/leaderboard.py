"""What stands in a leaderboard that is read: which rows together, which columns, and which values are the best."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from surgbench.report.column import LATENCY, ROW, Column, Interval
from surgbench.report.row import PROCESSOR, REFERENCE_LATENCY, Row, interval_keys
from surgbench.task import find_task


def groups(rows: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
    """Rows that stand in one table, and its title: those of one dataset and number of arms."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row["dataset"], find_task(row["task"]).title(row)), []).append(row)
    for (dataset, title), group in found.items():
        yield f"{dataset}, {title}", group


def variant_tells(rows: list[Row]) -> bool:
    """Whether rows of one name can be told apart by their variant alone, or a floor be known for what it is."""
    ids = [(row["row_id"], _part(row)) for row in rows]
    return len(set(ids)) < len(ids) or any(row.get("floor") for row in rows)


def shown(rows: list[Row]) -> list[Column]:
    """Columns worth their room: not those without a value."""
    return [
        column
        for column in find_task(rows[0]["task"]).shown
        if (column is ROW or any(row.get(column.key) not in (None, "") for row in rows))
        and (not column.unless_zero or any(row.get(column.key) for row in rows))
        and (column.key != "coverage" or any(row["coverage"] < 1 for row in rows))
        and (column.key not in find_task(rows[0]["task"]).parts or len({row[column.key] for row in rows}) > 1)
    ]


def set_columns(rows: list[Row]) -> list[Column]:
    """The same as tables are set: with where the mean of the error lies that a task ranks by, where a row says that.

    Rows of several processors have what their latencies would be on the reference machine, too.
    """
    several = len({row.get(PROCESSOR) for row in rows} - {None}) > 1
    error = find_task(rows[0]["task"]).ranked_by
    columns: list[Column] = []
    for column in shown(rows):
        columns.append(column)
        low, high = interval_keys(column.key)
        if column.key == error and any(row.get(low) is not None for row in rows):
            columns.append(_interval(column, low, high))
        if column.key == LATENCY.key and several:
            columns += [_REFERENCE, _PROCESSOR]
    return columns


_REFERENCE = Column(REFERENCE_LATENCY, "latency on the reference machine", "ms", 1, short="on ref.\nmachine")
_PROCESSOR = Column(PROCESSOR, "processor", short="processor")


def _interval(column: Column, low: str, high: str) -> Interval:
    short = f"{column.short.partition(chr(10))[0]}\n95 %"
    return Interval(low, f"{column.name}, 95 % interval", column.unit, column.decimals, column.scale, short, upper=high)


class Ranking:
    """Which values of a table's rows are the smallest ones, part by part.

    Args:
        rows: Of one table. Floors and rows that are not sound are not ranked.
    """

    def __init__(self, rows: list[Row]) -> None:
        self._values: dict[Any, list[Any]] = {}
        sound = [row for row in rows if _ranks(row)]
        for part in dict.fromkeys(map(_part, sound)):
            own = [row for row in sound if _part(row) == part]
            for column in find_task(rows[0]["task"]).shown if len(own) > 1 else ():
                values = {row[column.key] for row in own if row.get(column.key) is not None}
                if column.best and values:
                    self._values[part, column.key] = sorted(values)[:2]

    def place(self, column: Column, row: Row) -> int | None:
        """1 of the best value of a column, 2 of the second; else ``None``."""
        values = self._values.get((_part(row), column.key), []) if _ranks(row) else []
        value = row.get(column.key)
        return values.index(value) + 1 if value in values else None


def unsound(rows: Sequence[Row]) -> list[Row]:
    """Rows of runs that failed or were skipped."""
    return [row for row in rows if row["status"] != "ok" and find_task(row["task"]).is_whole(row)]


def reason(row: Row) -> str:
    """Why, one line."""
    return f"{row['row_id']}: {row['status']}: {row['error'] or 'no message'}"


def _part(row: Row) -> tuple[Any, ...]:
    """Which part of a run's samples the row is about."""
    return tuple(row.get(column) for column in find_task(row["task"]).parts)


def _ranks(row: Row) -> bool:
    return row["status"] == "ok" and not row.get("floor")
