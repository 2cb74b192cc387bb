"""What of a reproduced table depends on its task: columns, what is said of datasets, page and figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surgbench.records.format import Record
from surgbench.report.field import Field, count, filled, keys, number, text
from surgbench.report.row import Row

if TYPE_CHECKING:
    from surgbench.dataset.base import Dataset
    from surgbench.report.column import Column
    from surgbench.reproduce.results import BlockWork, Results
    from surgbench.reproduce.table import Definition


@dataclass(frozen=True)
class Sheet:
    """One task's part in tables.

    Attributes:
        columns: Of the leaderboard, without block and label.
        errors: Whose means over a sequence are kept, and of them a row's.
        spreadless: Those of them of which no spread is kept: shares, and what is one value for all frames.
        counts: Counted over a sequence.
        further_columns: Of the leaderboard, those that stand only where a row has a value of them.
        further_errors: The same of a sequence's means.
        further_counts: And of what is counted over a sequence.
        further_numbers: And of a sequence's other numbers: shares, and the largest of something.
        paired: Columns of sequences whose mean difference from the row that a row is held against is kept.
        regretted: The one of which a row's regret is, held against its floor.
        traits: Of a sequence, text.
        no_difference: Error to what nobody would call a difference in its mean.
        traits_of: A dataset's sequence to its traits.
        count: A record to its counts, and to its ``further_numbers``.
        describe: A dataset, and how many frames of each sequence are meant by first, to what is kept of it: at least
            ``sequences`` and ``frames``, how many there are, and ``first_sha256``, sequence to a hash of these frames.
        page: The Markdown page.
        draw: The figures that go into the table's folder (a definition with some, its work, its results, the folder);
            their names, none where nothing can be drawn.
        estimates: Column of a record's frames that a rerun is held against.
        further_estimates: More of them, where a record has them.
        measures: What is shown beside published figures in the terminal.
        instead: Of these, column to the one that stands in its place where a row has that.
    """

    columns: tuple[Field, ...]
    errors: tuple[str, ...]
    spreadless: tuple[str, ...]
    counts: tuple[str, ...]
    traits: tuple[str, ...]
    no_difference: dict[str, float]
    traits_of: Callable[[Any, str], Row]
    count: Callable[[Any], Row]
    describe: Callable[[Any, int], dict[str, Any]]
    page: Callable[[Definition, Results], str]
    draw: Callable[[Definition, Sequence[BlockWork], Results, Path], list[str]]
    estimates: str
    measures: tuple[Column, ...] = ()
    instead: Mapping[str, str] = field(default_factory=dict)
    further_estimates: tuple[str, ...] = ()
    further_columns: tuple[Field, ...] = ()
    further_errors: tuple[str, ...] = ()
    further_counts: tuple[str, ...] = ()
    further_numbers: tuple[str, ...] = ()
    paired: tuple[str, ...] = ()
    regretted: str | None = None

    def leaderboard(self, rows: Iterable[Row]) -> tuple[Field, ...]:
        """Columns of ``leaderboard.csv``.

        Args:
            rows: Its rows; of a file the keys, with any value.
        """
        return (*self.columns, *filled(self.further_columns, rows), *text("block", "label"))

    def sequences(self, rows: Iterable[Row]) -> tuple[Field, ...]:
        """Columns of ``sequences.csv``: no times, so that a rerun elsewhere writes the same file.

        Args:
            rows: As above.
        """
        head = (*text("row_id", "block", "unit", *self.traits), *count("repeat"), *text("status"), *count("frames"))
        further = filled(
            (*number(*self.further_errors), *count(*self.further_counts), *number(*self.further_numbers)), rows
        )
        return (*head, *number(*self.errors), *count(*self.counts), *further)

    @property
    def latencies(self) -> tuple[str, ...]:
        """Columns that are measured one run at a time: times, and how fast the machine was meanwhile."""
        return tuple(key for key in keys(self.columns) if key.startswith(("latency_", "calibration_")))

    def sequence_row(self, block: str, dataset: Dataset[Any], record: Record) -> Row:
        """A record's line of ``sequences.csv``."""
        import numpy as np

        row: Row = {
            "row_id": record.spec.row_id,
            "block": block,
            "unit": record.spec.unit,
            **self.traits_of(dataset, record.spec.sequence),
            "repeat": record.spec.repeat,
            "status": record.status,
            "frames": len(record.frames.index),
            **self.count(record),
        }
        for error in (*self.errors, *self.further_errors):
            values = record.errors.get(error, np.array([]))
            values = values[~np.isnan(values)]
            row[error] = float(values.mean()) if values.size else None
        return row
