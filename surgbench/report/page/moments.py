"""Which moments of which runs are shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.records.format import Record
from surgbench.report.page.content import Moment, clipped
from surgbench.report.page.curves import Curves, values_of

KINDS = ("best", "median", "worst")
SEQUENCES = 3  # of each table: those that its best row is best, middling and worst on


@dataclass(frozen=True)
class Choice:
    """A moment of a run, not yet drawn."""

    kind: str
    place: int


def choose(values: FloatArray) -> list[Choice]:
    """The best, the median and the worst of a run's frames; fewer where they are the same or there are none.

    Args:
        values: ``(T,)``, less is better, NaN for none.
    """
    there = np.flatnonzero(np.isfinite(values))
    if not len(there):
        return []
    known = values[there]
    middle = there[np.argmin(np.abs(known - np.median(known)))]
    places = (there[np.argmin(known)], middle, there[np.argmax(known)])
    found: dict[int, str] = {}
    for kind, place in zip(KINDS, places, strict=True):
        found.setdefault(int(place), kind)
    return [Choice(kind, place) for place, kind in found.items()]


def chosen_units(curves: Curves, place: int) -> list[str]:
    """Units that a row is best, middling and worst on."""
    means = {}
    for unit in curves.units:
        record = curves.runs.get((place, unit))
        values = np.empty(0) if record is None else values_of(record, curves.measures[0])
        if np.isfinite(values).any():
            means[unit] = float(np.nanmean(values))
    ordered = sorted(means, key=lambda unit: (means[unit], unit))
    places = {round(one) for one in np.linspace(0, len(ordered) - 1, min(SEQUENCES, len(ordered)))}
    return [ordered[one] for one in sorted(places)]


@dataclass(frozen=True)
class Drawing:
    """What is to be drawn of one run."""

    curves: Curves
    row: int
    unit: str
    choices: tuple[Choice, ...]

    @property
    def record(self) -> Record:
        """The run."""
        return self.curves.runs[self.row, self.unit]

    def anchor(self, choice: Choice) -> str:
        """What links to a moment name."""
        unit = self.curves.units.index(self.unit)
        return f"moment-{self.curves.group.number}-{self.row}-{unit}-{choice.kind}"


def planned(all_curves: Sequence[Curves], rows: int) -> list[Drawing]:
    """What to draw: of each table so many of its best sound rows, on the same few units.

    Args:
        all_curves: Of all tables.
        rows: Of each.
    """
    drawings = []
    for curves in all_curves:
        sound = [place for place in curves.group.whole if curves.group.rows[place]["status"] == "ok"][:rows]
        if not sound or not curves.measures:
            continue
        for unit in chosen_units(curves, sound[0]):
            for place in sound:
                if (place, unit) in curves.runs:
                    values = values_of(curves.runs[place, unit], curves.measures[0])
                    drawings.append(Drawing(curves, place, unit, tuple(choose(values))))
    return [one for one in drawings if one.choices]


def row_name(curves: Curves, place: int) -> str:
    """What a row is called, with its variant where others of its table have its name."""
    rows = curves.group.rows
    row = rows[place]
    namesakes = [rows[other] for other in curves.group.whole if rows[other]["row_id"] == row["row_id"]]
    return clipped(f"{row['row_id']} ({row['variant']})" if len(namesakes) > 1 else row["row_id"], 200)


def described(drawing: Drawing, choice: Choice) -> Moment:
    """A moment with its frame and error, without its picture."""
    measure = drawing.curves.measures[0]
    value = float(values_of(drawing.record, measure)[choice.place])
    text = f"{measure.name} {value:.{3 if measure.decimals is None else measure.decimals}f}"
    return Moment(
        drawing.anchor(choice),
        choice.kind,
        choice.place,
        drawing.record.frames.index[choice.place],
        f"{text} {measure.unit}".strip(),
    )
