"""Ours beside what was published."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from surgbench.report.column import Column
from surgbench.report.row import Row
from surgbench.reproduce.published import Published
from surgbench.reproduce.table import Block, TableRow


@dataclass(frozen=True)
class Pair:
    """One figure of ours beside the published one.

    Attributes:
        measure: Which.
        published: Mean.
        ours: Mean over sequences; ``None`` where the row has none.
        sem: Standard error over sequences.
    """

    measure: Column
    published: float
    ours: float | None
    sem: float | None

    @property
    def ratio(self) -> float | None:
        """Ours over the published one: 1 or less is no worse."""
        return None if self.ours is None else self.ours / self.published

    @property
    def met(self) -> bool:
        """Ours is no worse."""
        return self.ours is not None and self.ours <= self.published


@dataclass(frozen=True)
class Comparison:
    """One row beside its published one."""

    row: TableRow
    pairs: tuple[Pair, ...]


def compare(
    block: Block,
    rows: Sequence[Row],
    published: Published | None,
    measures: Sequence[Column],
    instead: Mapping[str, str],
) -> list[Comparison]:
    """All rows of a block that stand for or beside a published row and were run, with the figures both are about.

    Args:
        block: Whose.
        rows: Of the leaderboard.
        published: The figures.
        measures: Columns that are compared.
        instead: Column to the one that stands in its place where a row has that: of recordings.
    """
    if published is None:
        return []
    found = {row["row_id"]: row for row in rows}
    comparisons = []
    for row in block.rows:
        name = row.published or row.beside
        if name is None or not found[row.id]["frames"]:
            continue
        ours, pairs = found[row.id], []
        for measure in measures:
            figure = published.value(name, str(block.published_on), measure.key)
            if figure is not None:
                other = instead.get(measure.key, "")
                key = measure.key if ours.get(other) is None else other
                pairs.append(Pair(measure, figure, ours[key], ours.get(f"{key}_sem")))
        comparisons.append(Comparison(row, tuple(pairs)))
    return comparisons
