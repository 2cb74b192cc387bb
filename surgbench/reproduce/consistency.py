"""Whether a table's files agree with each other: what a slip of the hand in one of them would break."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from surgbench.report.row import Row
from surgbench.reproduce.files import LEADERBOARD_CSV, LEADERBOARD_MD, RECORDS_JSON, SEQUENCES_CSV
from surgbench.reproduce.over_sequences import SUFFIX
from surgbench.reproduce.paired import REGRET, differences
from surgbench.reproduce.results import Results
from surgbench.reproduce.sheet import Sheet
from surgbench.reproduce.table import Definition
from surgbench.task import find_task

# Of a mean that was summed in another order, and of six digits.
_ROUNDING, _SIX_DIGITS = 1e-9, 1e-5


def inconsistencies(definition: Definition, results: Results, folder: Path) -> list[str]:
    """One line for each thing that does not fit.

    Args:
        definition: The table as it is defined now.
        results: As read from its files.
        folder: Where they lie.
    """
    wanted = [row.id for _, row in definition.table.rows()]
    sheet = find_task(definition.table.task).sheet
    rows = [row for row in results.rows if find_task(row["task"]).is_whole(row)]
    there = [row["row_id"] for row in rows]
    if wanted != there:
        missing = [id_ for id_ in wanted if id_ not in there] or [id_ for id_ in there if id_ not in wanted]
        return [f"{LEADERBOARD_CSV}: other rows than the table's definition ({', '.join(missing) or 'another order'})"]
    problems = []
    asked = {row.id: row for _, row in definition.table.rows()}
    for row in rows:
        own = [one for one in results.sequences if one["row_id"] == row["row_id"]]
        paired = differences(asked[row["row_id"]], results.sequences, sheet)
        problems += _row_problems(sheet, row, own, paired)
    for one in results.sequences:
        key = f"{one['row_id']}/{one['unit']}/r{one['repeat']}"
        problems += _record_problems(key, one, results.about["records"].get(key))
    page = folder / LEADERBOARD_MD
    if not page.is_file() or page.read_text(encoding="utf-8") != sheet.page(definition, results):
        problems.append(f"{LEADERBOARD_MD}: not what the other files and the table's definition give (see --render)")
    return problems


def _row_problems(sheet: Sheet, row: Row, sequences: list[Row], paired: Row) -> list[str]:
    """A leaderboard row is made of its sequences' rows, and of those of the row that it is held against."""
    expected: dict[str, float | None] = {
        # Not the ends of intervals: resamples are drawn by SciPy, whose versions may draw others.
        **{key: value for key, value in paired.items() if key.endswith(("_difference", REGRET))},
        "sequences": len({one["unit"] for one in sequences}),
        "frames": sum(one["frames"] for one in sequences),
        **{count: sum(one[count] for one in sequences) for count in sheet.counts},
        **{count: sum(one[count] or 0 for one in sequences) for count in sheet.further_counts if row.get(count)},
    }
    for error in (*sheet.errors, *(further for further in sheet.further_errors if further in row)):
        means = [
            float(np.mean(values))
            for unit in sorted({one["unit"] for one in sequences})
            if (values := [one[error] for one in sequences if one["unit"] == unit and one.get(error) is not None])
        ]
        expected[error] = float(np.mean(means)) if means else None
        if error not in sheet.spreadless:
            sem = float(np.std(means, ddof=1) / math.sqrt(len(means))) if len(means) > 1 else None
            expected[f"{error}_sem"] = sem
        if row.get(f"{error}{SUFFIX}") is not None:
            expected[f"{error}{SUFFIX}"] = float(np.std(means, ddof=1))
    return [
        f"{LEADERBOARD_CSV}: row '{row['row_id']}': {key} is {row.get(key)}, but {SEQUENCES_CSV} gives {value}"
        for key, value in expected.items()
        if not _same(row.get(key), value, _ROUNDING)
    ]


def _record_problems(key: str, sequence: Row, record: dict[str, Any] | None) -> list[str]:
    """A sequence's row is of a record; where that is no longer than what is kept of it, its errors are known."""
    if record is None:
        return [f"{RECORDS_JSON}: no record '{key}'"]
    problems = [
        f"{SEQUENCES_CSV}: {key}: {name} is {sequence[name]}, but {RECORDS_JSON} says {record[name]}"
        for name in ("status", "frames")
        if sequence[name] != record[name]
    ]
    if record["head"]["frames"] == record["frames"]:
        problems += [
            f"{SEQUENCES_CSV}: {key}: {error} is {sequence[error]}, but {RECORDS_JSON} says {mean}"
            for error, (mean, _) in record["head"]["errors"].items()
            if not _same(sequence[error], mean, _SIX_DIGITS)
        ]
    return problems


def _same(a: float | None, b: float | None, tolerance: float) -> bool:
    if a is None or b is None:
        return a is b
    return math.isclose(a, b, rel_tol=tolerance, abs_tol=1e-15)
