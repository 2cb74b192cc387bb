"""``leaderboard.md`` of a table in which simulated hands lead the ring: the article's Fig. 7, and the differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import bootstrap

from surgbench.geometry import FloatArray
from surgbench.randomness import generator
from surgbench.report.column import NO_VALUE, Column
from surgbench.report.figures import FIGURE_PNG
from surgbench.report.markdown import QUICK_WARNING, failure_lines, markdown_table
from surgbench.report.row import Row
from surgbench.reproduce.published import Figure, Published
from surgbench.tasks.viewpoint.hand_columns import MEASURES, UNSEEN, VIEWS
from surgbench.tasks.viewpoint.hand_rows import UNFINISHED

if TYPE_CHECKING:
    from surgbench.reproduce.results import Results
    from surgbench.reproduce.table import Block, Definition

# Row of the published figures, whose datasets are the conditions.
FIG7 = "fig7"
RESAMPLES, CONFIDENCE = 2000, 0.95
DISCLAIMER = (
    "**No human took part.** A hand that is a dozen lines of control theory leads the ring; it has no workload, learns "
    "nothing, is never frustrated, and does not change its ways where they do not work. What such a simulation can "
    "say: what the geometry of a view (how far, along which direction, how wide its baseline), what hides the ring, "
    "and what teleoperation does when its view moves, would do to *anybody* who corrects what is seen, late and in "
    "proportion. What it can't say: how well people do in any of these conditions, that one is better for them than "
    "another, or anything about the article's participants. Its level (seconds, collisions) hangs on constants that "
    "are our choice; differences between rows, with the same hands on the same wires, hang on them less. One constant, "
    "how exactly edges are seen, is fitted: on other wires, to ENDO's share of time in contact. STAT and AUT are what "
    "then comes out. Nothing else is fitted to the published figures, which stand beside."
)
READING = (
    "Task time: there and back; collisions: contacts of ring and wire of at least 0.1 s that are 0.2 mm apart; in "
    "contact: all of them together; a contact: its mean duration; way: how far the ring's centre went; unseen: share "
    "of the time in which no picture that was shown had the ring in it and before the tool; views taken: how often "
    "teleoperation took the camera's pose anew; unfinished: runs broken off after 180 s, which count with what they "
    "had until then. Means over wires of means over people, ± standard deviation over runs (in the article over "
    "people). The model, its constants and their sources: `docs/viewpoint-view.md`."
)
PAIRED = (
    "Mean of the differences run by run: the same person, wire, and noise of eyes and hand. In brackets the 95 % "
    "interval by bootstrap, persons and wires drawn anew with replacement, each for itself (2000 times). In bold where "
    "it leaves out 0: of these hands and wires, not of people."
)


def has_hands(definition: Definition) -> bool:
    """Whether the table is one of simulated hands."""
    return any(getattr(row, "hand", None) is not None for _, row in definition.table.rows())


def condition(row: Row) -> str:
    """The article's name of what a row is: ``endo``, ``stat`` or ``aut``."""
    if row["hand"] == "endoscope":
        return "endo"
    return "stat" if row["tracker"] == "static" else "aut"


def page_of_hands(definition: Definition, results: Results) -> str:
    """The whole page."""
    table = definition.table
    parts = [f"# {table.title}"]
    if results.about["quick"]:
        parts.append(QUICK_WARNING)
    parts += [table.note.strip(), DISCLAIMER]
    if results.about["figure"]:
        parts.append(f"![Time, collisions and contact in the three conditions]({FIGURE_PNG})")
    rows = [row for row in results.rows if row.get("hand") is not None]
    for block in table.blocks:
        own = [row for row in rows if row["block"] == block.name]
        data = results.about["datasets"][block.dataset.folder]
        parts += [f"## {block.heading}", block.note.strip(), _what(block, own, data), *failure_lines(own)]
        parts.append(_measures(own, definition.published))
    parts.append(READING)
    still = [row for row in rows if condition(row) != "aut"]
    if still:
        parts += ["## Differences", PAIRED]
    for reference in still:
        parts += [f"### From {reference['label']}", _differences(rows, reference, results.sequences)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _what(block: Block, rows: Sequence[Row], data: Mapping[str, object]) -> str:
    if not rows:
        return ""
    wires, people = rows[0]["sequences"], rows[0]["repeats"]
    return (
        f"{people} simulated people on {wires} wires of dataset `{block.dataset.folder}` (SHA-256 "
        f"`{str(data['sha256'])[:12]}…`), the same in every row."
    )


def _measures(rows: Sequence[Row], published: Published | None) -> str:
    columns = (*MEASURES, UNSEEN, VIEWS)
    lines = [["condition", "row id", "runs", *(column.heading for column in columns), UNFINISHED]]
    if published is not None and FIG7 in published.rows:
        for name in dict.fromkeys(condition(row) for row in rows):
            values = published.rows[FIG7].data[name]
            cells = [_published(column, values.get(column.key)) for column in columns]
            lines.append([f"*{name.upper()}, {published.short}*", "", "6 × 5", *cells, NO_VALUE])
    for row in rows:
        cells = [column.with_spread(row[column.key], row[f"{column.key}_std"]) for column in columns]
        runs = f"{row['repeats']} × {row['sequences']}"
        lines.append([row["label"], f"`{row['row_id']}`", runs, *cells, str(row[UNFINISHED])])
    return markdown_table(lines, text_columns=2)


def _differences(rows: Sequence[Row], reference: Row, sequences: Sequence[Row]) -> str:
    lines = [["condition", "row id", *(column.heading for column in MEASURES)]]
    for row in rows:
        if row["row_id"] == reference["row_id"]:
            continue
        cells = []
        for column in MEASURES:
            found = difference(sequences, row["row_id"], reference["row_id"], column.key)
            cells.append(NO_VALUE if found is None else _interval(column, *found))
        lines.append([row["label"], f"`{row['row_id']}`", *cells])
    return markdown_table(lines, text_columns=2)


def difference(sequences: Sequence[Row], row: str, reference: str, measure: str) -> tuple[float, float, float] | None:
    """Mean difference of two rows over the runs that both have, and its interval.

    Args:
        sequences: Lines of ``sequences.csv``.
        row: Row id.
        reference: Row id of what is taken off.
        measure: Column.

    Returns:
        Mean, lower and upper end; ``None`` where there are fewer than two persons or wires.
    """
    table = _by_run(sequences, row, measure) - _by_run(sequences, reference, measure)
    wires, people = table.shape
    if min(wires, people) < 2 or np.isnan(table).all():
        return None

    def mean(chosen: FloatArray, persons: FloatArray, axis: int = -1) -> FloatArray:
        part = table[chosen.astype(int)[..., :, None], persons.astype(int)[..., None, :]]
        return np.asarray(np.nanmean(part, axis=(-2, -1)))

    drawn = bootstrap(
        (np.arange(wires), np.arange(people)),
        mean,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=generator(row=row, reference=reference, measure=measure, purpose="bootstrap"),
    )
    low, high = (float(end) for end in drawn.confidence_interval)
    return float(np.nanmean(table)), low, high


def _by_run(sequences: Sequence[Row], row: str, measure: str) -> FloatArray:
    """``(wires, people)`` values, NaN where there is none."""
    own = [one for one in sequences if one["row_id"] == row]
    units, repeats = sorted({one["unit"] for one in sequences}), sorted({one["repeat"] for one in sequences})
    table = np.full((len(units), len(repeats)), np.nan)
    for one in own:
        value = one[measure]
        table[units.index(one["unit"]), repeats.index(one["repeat"])] = np.nan if value is None else value
    return table


def _interval(column: Column, mean: float, low: float, high: float) -> str:
    text = f"{column.text(mean)} [{column.text(low)}, {column.text(high)}]"
    return f"**{text}**" if low > 0 or high < 0 else text


def _published(column: Column, value: float | Figure | None) -> str:
    if isinstance(value, Figure):
        return column.with_spread(value.mean, value.std)
    return column.text(value)
