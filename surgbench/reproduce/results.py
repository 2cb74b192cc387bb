"""A table's results: rows, per-sequence rows and fingerprints, derived from records, written and read back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from surgbench.dataset.base import Dataset
from surgbench.report.row import Row
from surgbench.reproduce.table import Block, TableRow
from surgbench.suite.settings import Job

RECORDS, TIMING = "records", "timing"


@dataclass(frozen=True)
class Results:
    """What is known of a table.

    Attributes:
        rows: With the columns of the task's :class:`~surgbench.reproduce.sheet.Sheet`, in the table's order.
        sequences: Likewise: each row's arms, pairs or trials.
        about: Datasets, environments, and per record what is kept of it: the content of ``records.json``.
    """

    rows: list[Row]
    sequences: list[Row]
    about: dict[str, Any]


@dataclass(frozen=True)
class RowWork:
    """One row's runs.

    Attributes:
        row: The row.
        settings_hash: Of its settings.
        jobs: Runs that its errors come from.
        timing: Runs that its latencies come from; none in a quick run, where the others have to do.
    """

    row: TableRow
    settings_hash: str
    jobs: tuple[Job, ...]
    timing: tuple[Job, ...]


@dataclass(frozen=True)
class BlockWork:
    """One block's runs, on its dataset."""

    block: Block
    dataset: Dataset[Any]
    rows: tuple[RowWork, ...]
