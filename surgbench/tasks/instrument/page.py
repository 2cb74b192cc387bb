"""``leaderboard.md``: the table for people, made of nothing but the other files and the table's definition."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from surgbench.report.column import NO_VALUE, Column
from surgbench.report.figures import FIGURE_PNG
from surgbench.report.markdown import QUICK_WARNING, escape, failure_lines, markdown_table
from surgbench.report.row import Row
from surgbench.reproduce.compare import Comparison, Pair, compare
from surgbench.reproduce.published import Published
from surgbench.reproduce.results import Results
from surgbench.reproduce.table import Block, Definition, Table
from surgbench.tasks.instrument.columns import (
    IN_RECORDINGS,
    MARKED_TIPS,
    OUT_OF_VIEW,
    PAGE_ERRORS,
    PAGE_LATENCY,
    PAGE_MADE_MASKS,
    PAGE_MASK_SOURCE,
    PAGE_OPTIMISATION,
    PAGE_P95,
    PAGE_POSE,
    PAGE_SCALED,
    PUBLISHED,
    READ_JOINTS,
    SURE,
    TIPS,
)
from surgbench.tasks.instrument.levels import LEVELS_PNG
from surgbench.tasks.instrument.page_spread import SPREAD_NOTE, spread_table
from surgbench.tasks.instrument.worst import WORST_PNG

READING = (
    "Errors are means over sequences (each arm is one) ± their standard error, after the paper's rule for the 180° "
    "twin; where `scored` in `leaderboard.csv` says so, of the state that the filter makes of the tracker's. *mask "
    "error* is against the mask that the tracker saw, *true mask error* against the uncorrupted one; *keypoints* is "
    "the sum over both tips. *latency* is the median time of a frame, everything that a user waits for (tips, "
    "masks, filter), *p95* its 95th percentile; *optimisation* is the median of the tracker's own part of it. Every "
    "column is explained in `docs/metrics.md`; `leaderboard.csv` has more of them, with all digits, and "
    "`sequences.csv` every sequence's means."
)


def markdown(definition: Definition, results: Results) -> str:
    """The whole page."""
    table, published = definition.table, definition.published
    source = "" if published is None else published.short
    compared = {block.name: compare(block, results.rows, published, PUBLISHED, IN_RECORDINGS) for block in table.blocks}
    parts = [f"# {table.title}"]
    if results.about["quick"]:
        parts.append(QUICK_WARNING)
    if table.note:
        parts.append(table.note.strip())
    parts.append(_summary(table, compared, source))
    parts += [READING, _times(results.about, published)]
    if results.about["figure"]:
        parts.append(f"![Ground truth and estimates over time]({FIGURE_PNG})")
    parts += [f"![{PICTURES[name]}]({name})" for name in results.about.get("pictures", ())]
    for block in table.blocks:
        rows = [row for row in results.rows if row["block"] == block.name]
        about_data = _dataset(block, results.about["datasets"][block.dataset.folder])
        parts += [f"## {block.heading}", block.note.strip(), about_data, _block_table(rows), *failure_lines(rows)]
        spread = spread_table(block, rows, published)
        if spread:
            parts += ["### Over sequences", SPREAD_NOTE, spread]
        if compared[block.name]:
            parts += [f"### Beside {source}", _comparison_table(compared[block.name])]
            parts.append(_not_met(compared[block.name]))
        floors = _floor_table(block, results.rows)
        if floors:
            parts += ["### Above the floor", FLOOR_NOTE, floors]
        for title, note, columns in (SURE_PART, OUT_OF_VIEW_PART):
            told = told_table(rows, columns)
            if told:
                parts += [f"### {title}", note, told]
        gains = _gain_table(block, results)
        if gains:
            parts += ["### What it changes", GAIN_NOTE, gains]
    return "\n\n".join(part for part in parts if part) + "\n"


FLOOR_NOTE = (
    "How many times the error of the floor row, which searches every frame from its true state: what the masks allow."
)

PICTURES = {
    LEVELS_PNG: "Errors over the level of what makes it hard",
    WORST_PNG: "The worst moments: where the tips were farthest from the truth",
}

SURE_PART = (
    "How sure they are",
    "How often the truth lies in the central 90 % interval that a tracker states with its standard deviations: over "
    "frames, and over the components of each group. 90 is right, 85 to 95 good; less is too sure, more not sure "
    "enough.",
    SURE,
)

OUT_OF_VIEW_PART = (
    "When the instrument is out of view",
    "Of the frames in which a tracker says that it is lost, how many have an instrument out of view (precision); of "
    "those that have, in how many it says so (recall); and the median of the frames that it takes after a return until "
    "the tips are within 5 mm again. No error counts frames out of view.",
    OUT_OF_VIEW,
)

GAIN_NOTE = (
    "By how much each error is smaller (−) or larger (+) than that of the row it is held against, and in how many of "
    "the sequences the tips' error is smaller."
)


def _summary(table: Table, compared: dict[str, list[Comparison]], source: str) -> str:
    """How many of the published accuracies are reached, block by block; what was not run is no figure."""
    counts = []
    for block in table.blocks:
        stand = [one for one in compared[block.name] if one.row.published is not None]
        pairs = [pair for one in stand for pair in _accuracies(one) if pair.ours is not None]
        if pairs:
            rows = "1 row" if len(stand) == 1 else f"{len(stand)} rows"
            counts.append(
                f"{block.heading}: {sum(pair.met for pair in pairs)} of the {len(pairs)} accuracies of {rows}"
            )
    if not counts:
        return ""
    return (
        f"**Accuracies of {source} met or bettered by the rows that stand for its rows: {'; '.join(counts)}.** Not "
        "counted are times, which are of other hardware, and rows that are only shown beside a published one."
    )


def _accuracies(one: Comparison) -> list[Pair]:
    """The errors of a row that stands for a published one; none of any other row."""
    return [pair for pair in one.pairs if pair.measure != PAGE_OPTIMISATION] if one.row.published is not None else []


def _not_met(comparisons: list[Comparison]) -> str:
    worse = [
        f"`{one.row.id}` {pair.measure.name} ({_ratio(pair.ratio)})"
        for one in comparisons
        for pair in _accuracies(one)
        if pair.ratio is not None and not pair.met
    ]
    if not any(one.row.published is not None for one in comparisons):
        return ""
    return f"Less accurate than published: {', '.join(worse) or 'nothing'}."


def _times(about: dict[str, Any], published: Published | None) -> str:
    timed = about["timing_environments"] or about["environments"]
    processors = sorted({environment["machine"]["processor"] for environment in timed})
    how = "one run at a time" if about["timing_environments"] else "beside other runs, if there were several jobs"
    where = f"on one core of {' and of '.join(processors)}, {how}"
    if published is None:
        return f"Times were measured {where}."
    return (
        f"The times of {published.short} were measured on {published.machine}, ours {where}; "
        "their ratio is of what a user waits for, not of the methods' arithmetic."
    )


def _dataset(block: Block, dataset: dict[str, Any]) -> str:
    """What a reader needs to see whether a row is won by an easy dataset."""
    hash_ = f"SHA-256 `{dataset['sha256'][:12]}…`"
    if not dataset["difficulty"]:
        recordings = "1 recording" if dataset["sequences"] == 1 else f"{dataset['sequences']} recordings"
        return f"Dataset `{block.dataset.folder}`: {recordings} without truth, {dataset['frames']} frames, {hash_}."
    speeds = [
        f"{speed} sequences, an arm moves {1000 * values['translation_m']:.2f} mm, {values['rotation_rad']:.4f} rad "
        f"and {values['joints_rad']:.4f} rad per joint a frame in the mean, and its masks differ from the "
        f"true ones by {values['mask_error']:.4f} (1 − IoU)"
        for speed, values in sorted(
            dataset["difficulty"].items(), reverse=True
        )  # nominal first, also as read from a file
    ]
    pairs = f"{dataset['sequences']} {'pair' if dataset['sequences'] == 1 else 'pairs'} of arms"
    return f"Dataset `{block.dataset.folder}`: {pairs}, {dataset['frames']} frames, {hash_}. In {'; in '.join(speeds)}."


def _block_table(rows: Sequence[Row]) -> str:
    partly = any(row["coverage"] < 1 for row in rows)
    scaled = [PAGE_SCALED] if any(row[PAGE_SCALED.key] is not None for row in rows) else []
    made = [PAGE_MASK_SOURCE] if any(row.get(PAGE_MADE_MASKS.key) is not None for row in rows) else []
    spreadless = (*scaled, *made, PAGE_OPTIMISATION, PAGE_LATENCY, PAGE_P95)
    # Recordings have no truth, and the page no columns of what nobody knows.
    possible = (*PAGE_ERRORS, PAGE_MADE_MASKS, MARKED_TIPS, *READ_JOINTS)
    known = [column for column in possible if any(row.get(column.key) is not None for row in rows)]
    errors = known or PAGE_ERRORS
    headings = ["method", "row id", *(column.heading for column in (*errors, *spreadless))]
    lines = [headings + (["sequences × frames"] if partly else [])]
    for row in rows:
        cells = [escape(row["label"]), f"`{row['row_id']}`"]
        cells += [column.with_spread(row.get(column.key), row.get(f"{column.key}_sem")) for column in errors]
        cells += [column.text(row[column.key]) for column in spreadless]
        if partly:
            frames = row["frames"] / row["sequences"] / row["repeats"]
            cells.append(f"{row['sequences']} × {frames:g}" if frames else row["status"])
        lines.append(cells)
    return markdown_table(lines, text_columns=2)


def _comparison_table(comparisons: Sequence[Comparison]) -> str:
    """Three lines a row: published, ours, and their ratio, bold where ours is no worse."""
    compared = {pair.measure for one in comparisons for pair in one.pairs}
    measures = [column for column in (*PAGE_ERRORS, PAGE_OPTIMISATION) if column in compared]
    lines = [["method", "", *(measure.heading for measure in measures)]]
    for one in comparisons:
        pairs = {pair.measure: pair for pair in one.pairs}
        published, ours, ratio = [], [], []
        for measure in measures:
            pair = pairs.get(measure)
            published.append(NO_VALUE if pair is None else measure.text(pair.published))
            ours.append(NO_VALUE if pair is None else measure.with_spread(pair.ours, pair.sem))
            text = NO_VALUE if pair is None or pair.ratio is None else _ratio(pair.ratio)
            ratio.append(f"**{text}**" if pair is not None and pair.met else text)
        # A method of ours stands beside another method's figures.
        whose = "published" if one.row.published is not None else f"published, `{one.row.beside}`"
        lines += [[escape(one.row.label), whose, *published], ["", "ours", *ours], ["", "ratio", *ratio]]
    return markdown_table(lines, text_columns=2)


def _floor_table(block: Block, rows: Sequence[Row]) -> str:
    found = {row["row_id"]: row for row in rows}
    lines = [["method", "floor", *(column.name for column in PAGE_POSE)]]
    for row in block.rows:
        if row.floor is None:
            continue
        ours, floor = found[row.id], found[row.floor]
        ratios = [
            _ratio(ours[column.key] / floor[column.key]) if ours[column.key] and floor[column.key] else NO_VALUE
            for column in PAGE_POSE
        ]
        lines.append([escape(row.label), f"`{row.floor}`", *ratios])
    return markdown_table(lines, text_columns=2) if len(lines) > 1 else ""


def told_table(rows: Sequence[Row], columns: Sequence[Column]) -> str:
    """The rows that have one of some columns."""
    telling = [row for row in rows if any(row[column.key] is not None for column in columns)]
    if not telling:
        return ""
    lines = [["method", "row id", *(column.heading for column in columns)]]
    lines += [
        [escape(row["label"]), f"`{row['row_id']}`", *(column.text(row[column.key]) for column in columns)]
        for row in telling
    ]
    return markdown_table(lines, text_columns=2)


def _gain_table(block: Block, results: Results) -> str:
    found = {row["row_id"]: row for row in results.rows}
    lines = [["method", "against", *(column.name for column in PAGE_POSE), "better in"]]
    for row in block.rows:
        if row.against is None:
            continue
        ours, other = found[row.id], found[row.against]
        changes = [
            _percent(ours[column.key] / other[column.key] - 1.0) if ours[column.key] and other[column.key] else NO_VALUE
            for column in PAGE_POSE
        ]
        lines.append([escape(row.label), f"`{row.against}`", *changes, _better_in(row.id, row.against, results)])
    return markdown_table(lines, text_columns=2) if len(lines) > 1 else ""


def _better_in(row_id: str, against: str, results: Results) -> str:
    """In how many of the sequences that both were run on the tips' error is smaller."""
    errors = {
        (one["row_id"], one["unit"], one["repeat"]): one[TIPS.key]
        for one in results.sequences
        if one[TIPS.key] is not None
    }
    pairs = [
        (error, errors[against, unit, repeat])
        for (id_, unit, repeat), error in errors.items()
        if id_ == row_id and (against, unit, repeat) in errors
    ]
    return f"{sum(ours < other for ours, other in pairs)} of {len(pairs)}"


def _ratio(value: float) -> str:
    return f"{value:.2f}×" if value < 10 else f"{value:.0f}×"


def _percent(change: float) -> str:
    return f"{100 * change:+.0f} %".replace("-", "−")
