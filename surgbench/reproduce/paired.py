"""Rows held against others, sequence by sequence: mean differences with intervals.

Sequences differ more from each other than trackers do; what a pair of runs on the same one differs by does not see
that.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from surgbench.report.bootstrap import mean_interval
from surgbench.report.field import Field, keys, number, text
from surgbench.report.row import Row
from surgbench.report.sequence_means import differences as differences_of
from surgbench.report.sequence_means import line_means
from surgbench.reproduce.sheet import Sheet
from surgbench.reproduce.table import Table, TableRow
from surgbench.task import find_task

AGAINST, REGRET = "against", "regret"
ENDS = ("", "_low", "_high")


def difference_key(column: str) -> str:
    """What a column's mean difference is called."""
    return f"{column}_difference"


def paired_fields(columns: Iterable[str]) -> tuple[Field, ...]:
    """Columns of the leaderboard for differences of these columns, and for regret."""
    means = (*(difference_key(column) for column in columns), REGRET)
    return (*text(AGAINST), *number(*(f"{mean}{end}" for mean in means for end in ENDS)))


def with_differences(table: Table, rows: Sequence[Row], sequences: Sequence[Row], sheet: Sheet) -> list[Row]:
    """A table's rows with their differences from those that they are held against; as they are where there are none.

    Args:
        table: Says against which.
        rows: Of the leaderboard.
        sequences: Of ``sequences.csv``.
        sheet: Says which columns.
    """
    asked = {row.id: row for _, row in table.rows()}
    task = find_task(table.task)
    known = keys(paired_fields(sheet.paired))
    return [
        {**row, **{key: None for key in known if key in row}, **differences(asked[row["row_id"]], sequences, sheet)}
        if task.is_whole(row)
        else row
        for row in rows
    ]


def differences(row: TableRow, sequences: Sequence[Row], sheet: Sheet) -> Row:
    """Ours less the other's: of each paired column against ``row.against``, and as ``regret`` against ``row.floor``.

    Args:
        row: Of the table.
        sequences: Of all of its rows.
        sheet: Says which columns.

    Returns:
        Means over the sequences that both rows have done, every one weighing the same, and the ends of their 95 %
        intervals (:func:`surgbench.report.bootstrap.mean_interval`), ``None`` where there is nothing to take them of.
        Nothing where the row is held against none.
    """
    found: Row = {}
    if row.against is not None and sheet.paired:
        found[AGAINST] = row.against
        for column in sheet.paired:
            found |= _mean_difference(difference_key(column), column, row.id, row.against, sequences)
    if row.floor is not None and sheet.regretted is not None:
        found |= _mean_difference(REGRET, sheet.regretted, row.id, row.floor, sequences)
    return found


def _mean_difference(key: str, column: str, ours: str, other: str, sequences: Sequence[Row]) -> Row:
    values = differences_of(*(line_means(sequences, id_, column) for id_ in (ours, other)))
    interval = mean_interval(values) or (None, None)
    mean = float(np.mean(values)) if values else None
    return dict(zip((f"{key}{end}" for end in ENDS), (mean, *interval), strict=True))
