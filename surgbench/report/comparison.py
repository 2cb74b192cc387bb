"""Records compared: which rows stand against each other, by which error, and what comes out as a table of pairs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from surgbench.errors import ConfigError, unknown_name
from surgbench.records.format import Record
from surgbench.records.reader import read_records
from surgbench.report.column import Column
from surgbench.report.field import count, keys, number, text
from surgbench.report.frame import to_frame
from surgbench.report.paired_tests import Comparison, compare_rows
from surgbench.report.row import Row
from surgbench.report.rows import RowRuns, derive_runs
from surgbench.report.sequence_means import sequence_means
from surgbench.task import Task

if TYPE_CHECKING:
    from pandas import DataFrame

PAIR_COLUMNS = (
    *text("dataset", "group", "error", "row_a", "row_b"),
    *count("sequences"),
    *number("difference", "low", "high", "p", "p_holm"),
    *count("wins", "losses", "ties"),
)


def compare(*directories: str | Path, error: str | None = None) -> DataFrame:
    """Rows held against each other by pairs, sequence by sequence: what ``surgbench compare --format csv`` writes.

    Args:
        directories: Folders of records; several are compared as one leaderboard.
        error: Column that is compared, ``tip_error_m``; unless told, the one that the leaderboard is ranked by.

    Returns:
        A line for every two rows of a dataset and group, with the columns of ``docs/metrics.md``: the mean difference
        of ``row_a`` less ``row_b`` with its 95 % interval, p of Wilcoxon's signed ranks and after Holm's correction,
        and in how many sequences a is better, worse, or the same.

    Raises:
        DatasetError: A folder is missing or has no record, or a file below it is damaged.
        ConfigError: No row has an error of this name.
    """
    return to_frame(pair_rows(compare_records(read_records(map(Path, directories)), error)), PAIR_COLUMNS)


def compare_records(records: Sequence[Record], error: str | None = None) -> list[Comparison]:
    """One comparison for each dataset and group, as they stand in the leaderboard.

    Args:
        records: Of any rows. Of a row, the sequences count whose runs are all sound; floors are not compared.
        error: See :func:`compare`.

    Raises:
        ConfigError: No task of these records has an error of this name that is compared.
    """
    tables: dict[tuple[str, str], list[RowRuns]] = {}
    for run in derive_runs(records):
        tables.setdefault((run.whole["dataset"], run.task.title(run.whole)), []).append(run)
    if error is not None:
        known = {column.key for runs in tables.values() for column in comparable(runs[0].task)}
        if error not in known:
            raise ConfigError(unknown_name("error", error, known))
    found = [(key, runs, _column(runs[0].task, error)) for key, runs in tables.items()]
    return [_compare(*key, runs, column) for key, runs, column in found if column is not None]


def comparable(task: Task) -> tuple[Column, ...]:
    """The errors that rows of a task can be compared by: those that are shown, of which less is better."""
    return tuple(column for column in task.shown if column.best and column.key in task.record.error_names)


def pair_rows(comparisons: Iterable[Comparison]) -> list[Row]:
    """A row with ``PAIR_COLUMNS`` for each pair."""
    own = keys(PAIR_COLUMNS)[3:]
    return [
        {"dataset": one.dataset, "group": one.title, "error": one.error.key} | {key: getattr(pair, key) for key in own}
        for one in comparisons
        for pair in one.pairs
    ]


def _column(task: Task, error: str | None) -> Column | None:
    return next((column for column in comparable(task) if column.key == (error or task.ranked_by)), None)


def _compare(dataset: str, title: str, runs: Sequence[RowRuns], error: Column) -> Comparison:
    names = [run.whole["row_id"] for run in runs]
    means, left_out = {}, []
    for run in runs:
        row = run.whole
        name = row["row_id"] if names.count(row["row_id"]) == 1 else f"{row['row_id']} ({row['variant']})"
        own = sequence_means(_sound(run.records), error.key)
        if row.get("floor"):
            left_out.append(f"{name}: a floor")
        elif not own:
            left_out.append(f"{name}: no sound sequence with a value")
        else:
            means[name] = own
    return compare_rows(dataset, title, error, means, left_out)


def _sound(records: Sequence[Record]) -> list[Record]:
    """Without the sequences of which a run failed: what is left of such a one is its easier part."""
    failed = {record.spec.unit for record in records if record.status != "ok"}
    return [record for record in records if record.spec.unit not in failed]
