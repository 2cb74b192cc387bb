"""Some rows of a finished table run again: what comes of them takes the place of what stood there."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from surgbench.errors import ConfigError, DatasetError, unknown_name
from surgbench.report.row import Row
from surgbench.reproduce.check import first_sha256
from surgbench.reproduce.paired import with_differences
from surgbench.reproduce.results import Results
from surgbench.reproduce.table import Definition, Table
from surgbench.task import find_task


def narrowed(table: Table, rows: Collection[str]) -> Table:
    """The table with some of its rows alone.

    Raises:
        ConfigError: It has no such row.
    """
    known = [row.id for _, row in table.rows()]
    for id_ in rows:
        if id_ not in known:
            raise ConfigError(f"--row: {unknown_name('row', id_, known)}")
    blocks = []
    for block in table.blocks:
        kept = tuple(row for row in block.rows if row.id in rows)
        if kept:
            blocks.append(block.model_copy(update={"rows": kept}))
    return table.model_copy(update={"blocks": tuple(blocks)})


def merged(definition: Definition, before: Results, again: Results) -> Results:
    """A table's results, those of some rows replaced.

    Args:
        definition: The whole table.
        before: As they stand in its files. Rows that the table has not any more are dropped.
        again: Of the rows that were run again.

    Raises:
        DatasetError: A block's data are not those that its other rows were run on; a row is new, and was not run.
    """
    for folder, dataset in again.about["datasets"].items():
        there = before.about["datasets"].get(folder, dataset)
        # Another processor rounds the numbers of a table otherwise, and makes the same masks.
        if there["sha256"] != dataset["sha256"] and first_sha256(there) != first_sha256(dataset):
            raise DatasetError(
                f"dataset {folder} is not the one that the table's other rows were run on; run the whole table again"
            )
    rows: list[Row] = []
    sequences: list[Row] = []
    records: dict[str, Any] = {}
    for block, row in definition.table.rows():
        source = again if any(one["row_id"] == row.id for one in again.rows) else before
        own = [one for one in source.rows if one["row_id"] == row.id]
        if not own:
            raise DatasetError(f"row '{row.id}' is not in the table's files; run it too (--row {row.id})")
        rows += [{**one, "block": block.name, "label": row.label} for one in own]
        sequences += [one for one in source.sequences if one["row_id"] == row.id]
        records |= {key: one for key, one in source.about["records"].items() if key.partition("/")[0] == row.id}
    folders = {block.dataset.folder for block in definition.table.blocks}
    datasets = {**again.about["datasets"], **before.about["datasets"]}
    about = {
        **before.about,
        "table_sha256": definition.sha256,
        "datasets": {folder: one for folder, one in datasets.items() if folder in folders},
        # Counts of earlier environments are those of when they ran.
        "environments": [*before.about["environments"], *again.about["environments"]],
        "timing_environments": [*before.about["timing_environments"], *again.about["timing_environments"]],
        "records": records,
    }
    # A row that stays may be held against one that was run again.
    sheet = find_task(definition.table.task).sheet
    return Results(with_differences(definition.table, rows, sequences, sheet), sequences, about)
