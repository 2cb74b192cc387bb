"""Errors and latencies of runs over time, thinned out without losing their extremes."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.records.format import Record
from surgbench.report.column import Column
from surgbench.report.page.boards import Group

LATENCY = "latency_ms"
DIGITS = 4  # significant, of a point of a curve
# Of one line; fewer where there are many lines, so that the page stays small.
MOST_POINTS, FEWEST_POINTS = 400, 100
# Of all lines together: about 5 MB of text.
ALL_POINTS = 400_000


@dataclass(frozen=True)
class Curves:
    """What can be seen over time of a table's rows.

    Attributes:
        group: The table.
        measures: What is measured in every frame; the first is what moments are chosen by.
        units: What was run on, in order.
        runs: Place of a row and unit to its record, the first repeat's.
    """

    group: Group
    measures: tuple[Column, ...]
    units: tuple[str, ...]
    runs: dict[tuple[int, str], Record]

    @property
    def lines(self) -> int:
        """How many there are to draw."""
        return len(self.runs) * len(self.measures)


def curves_of(group: Group) -> Curves:
    """The runs of a table and what was measured in their frames."""
    runs: dict[tuple[int, str], Record] = {}
    for place in group.whole:
        for record in group.records[place]:  # in order of their repeats
            if record.frames.index:
                runs.setdefault((place, record.spec.unit), record)
    records = list(runs.values())
    measures = [one for one in group.task.shown if one.key == LATENCY or any(_has(record, one) for record in records)]
    measures.sort(key=lambda column: column.key == LATENCY)
    return Curves(group, tuple(measures), tuple(sorted({unit for _, unit in runs})), runs)


def _has(record: Record, column: Column) -> bool:
    return column.key in record.errors and column.key not in record.whole


def values_of(record: Record, column: Column) -> FloatArray:
    """``(T,)`` of a measure as shown, of two arms their mean; NaN where a frame has none, empty where no frame has."""
    if column.key == LATENCY:
        values = np.array(getattr(record.frames, LATENCY, []), dtype=np.float64)
    elif _has(record, column):
        values = record.errors[column.key]
    else:
        return np.empty(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of frames without any value
        flat = np.nanmean(values.reshape(len(values), -1), axis=1) if values.ndim > 1 and values.size else values
    return np.asarray(np.where(np.isfinite(flat), flat * column.scale, np.nan))


def thinned(values: FloatArray, most: int) -> NDArray[np.intp]:
    """Places of at most ``most`` values that show what all of them do: of each stretch the smallest and the largest.

    Args:
        values: ``(T,)``, NaN for none.
        most: Even, 4 or more.

    Returns:
        In order, with the first and the last that are there; all that are there where they are not too many.

    Example:
        >>> import numpy as np
        >>> from surgbench.report.page.curves import thinned
        >>> thinned(np.array([0.0, 1.0, 9.0, 1.0, 1.0, 0.5, 1.0, 1.0, 2.0]), 6).tolist()
        [0, 2, 5, 8]
    """
    there = np.flatnonzero(np.isfinite(values))
    if len(there) <= most:
        return there
    kept = {int(there[0]), int(there[-1])}
    for stretch in np.array_split(there, most // 2 - 1):
        kept |= {int(stretch[np.argmin(values[stretch])]), int(stretch[np.argmax(values[stretch])])}
    return np.array(sorted(kept), dtype=np.intp)


def points_for(all_curves: Sequence[Curves]) -> int:
    """How many points a line may have, even."""
    lines = max(1, sum(one.lines for one in all_curves))
    return max(FEWEST_POINTS, min(MOST_POINTS, ALL_POINTS // lines)) // 2 * 2


def units_shown(curves: Curves, share: float) -> tuple[str, ...]:
    """As large a share of the units as there is room for, spread evenly; one at least."""
    count = max(1, min(len(curves.units), round(share * len(curves.units))))
    places = sorted({round(place) for place in np.linspace(0, len(curves.units) - 1, count)}) if curves.units else []
    return tuple(curves.units[place] for place in places)


def share_of(all_curves: Sequence[Curves]) -> float:
    """Which share of all lines there is room for, drawn by as few points as will do."""
    return min(1.0, ALL_POINTS / max(1, FEWEST_POINTS * sum(one.lines for one in all_curves)))


def point(value: float) -> float:
    """A number with as many digits as a picture needs."""
    return float(f"{value:.{DIGITS}g}")
