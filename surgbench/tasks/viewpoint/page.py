"""``leaderboard.md`` of a viewpoint table: the article's three tables, the paper's figures first, then ours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from surgbench.report.column import NO_VALUE, Column
from surgbench.report.figures import FIGURE_PNG
from surgbench.report.markdown import QUICK_WARNING, failure_lines, markdown_table
from surgbench.report.row import Row
from surgbench.reproduce.paired import AGAINST, ENDS, difference_key
from surgbench.reproduce.published import Figure, Published
from surgbench.tasks.viewpoint.columns import (
    PAGE_BOTH,
    PAGE_ERRORS,
    PAGE_EYES,
    PAGE_FRAMED,
    PAGE_LATENCY,
    PAGE_MEAN_LATENCY,
    PAGE_PAIRED,
    PAGE_REGRET,
    PAGE_RULES,
    PAGE_SEEN,
    PAGE_SIGNED,
    PAGE_TRUTH,
    PAGE_UNAVOIDABLE,
    PUBLISHED_MEAN_LATENCY,
)
from surgbench.tasks.viewpoint.robustness import ROBUSTNESS_PNG, robustness_table
from surgbench.viewpoint.rules import RULE_UNITS, TWINS

if TYPE_CHECKING:
    from surgbench.reproduce.results import Results
    from surgbench.reproduce.table import Block, Definition

PATHS_PNG, CENTROIDS_PNG, PIXELS_PNG = "paths.png", "centroids.png", "pixels.png"
SUBSET_NAMES = {
    "all": "all samples",
    "unconstrained": "without a constraint (WoC)",
    "constrained": "with a constraint (WC)",
}
OPTIMISED = {
    "solver": "where the naive pose is out of reach or too near",
    "optimised": "the samples in which a controller says that it optimised, its own",
}
SOURCES = {
    "tags": "by the tags in rendered pictures, as the authors measured it",
    "projected": "by geometry, at every sample: seen where half of the ring is in the picture and not covered",
}
QUICK_TRIAL = (
    "It is the beginning of one trial, chosen because rules bind in it: how often they do is not what the headings say "
    "of whole trials. There are no intervals and no differences over trials."
)
RULES_NOTE = (
    "Events beyond 0.5 mm, or 0.5° for sides and joints (the longest; the deepest), of all samples, at one moment: "
    "where the camera was after the step against the feature at that time. *Reported*: by the registered base, joints "
    "as measured or told, whichever is worse, against the measured feature. *True*: by the true poses of both."
)
PAIRED_NOTE = (
    "Mean over trials of the row's figure less that of the row it is held against, and its 95 % interval (bootstrap "
    "over trials). Regret: the cost less that of the optimum in hindsight, which is told the future."
)
READING = (
    "VVA: angle between the optical axis and the line to the feature; FD: distance to it less 110 mm; PF: camera's x "
    "axis out of the horizontal; AN, PN: angle and distance to the naive pose. On reported poses, what was wanted at a "
    "step against where the camera was one step later, as the authors have it; the *true* columns on true poses at one "
    "moment, registration error and all. Mean ± standard deviation over the samples, means taken over trials. The "
    "subsets are those of the naive pose, so that they hold the same samples for every controller with the same "
    "registration; the article's are its controller's own. Every column is explained in `docs/viewpoint.md`; "
    "`leaderboard.csv` has more of them, with all digits."
)


def page(definition: Definition, results: Results) -> str:
    """The whole page."""
    table, published = definition.table, definition.published
    parts = [f"# {table.title}"]
    if results.about["quick"]:
        parts += [QUICK_WARNING, QUICK_TRIAL]
    parts += [table.note.strip(), READING, _times(results.about, published)]
    if results.about["figure"]:
        parts.append(f"![Errors over time]({FIGURE_PNG})")
        parts.append(f"![Ring, naive camera and camera in space]({PATHS_PNG})")
        parts.append(f"![Where the ring was in the pictures]({CENTROIDS_PNG})")
        parts.append(f"![How far it was from their middle over time]({PIXELS_PNG})")
    for block in table.blocks:
        rows = [row for row in results.rows if row["block"] == block.name]
        data = _dataset(block, results.about["datasets"][block.dataset.folder])
        parts += [f"## {block.heading}", block.note.strip(), data, *failure_lines(list(filter(_is_whole, rows)))]
        if any(row["disturbance"] for row in rows):
            if ROBUSTNESS_PNG in results.about.get("pictures", ()):
                parts.append(f"![Errors against levels of disturbance]({ROBUSTNESS_PNG})")
            parts.append(robustness_table(list(filter(_is_whole, rows))))
            continue
        for subset, name in SUBSET_NAMES.items():
            parts += [f"### Table I, {name}", _errors(rows, published, "table1", subset)]
        parts += ["### In truth", _truth(rows), "### Rules", RULES_NOTE, _rules(rows)]
        paired = _paired(rows)
        if paired:
            parts += ["### Differences, paired by trial", PAIRED_NOTE, paired]
        for source, name in SOURCES.items():
            centroids = _centroids(rows, published, source)
            if centroids:
                parts += [f"### Table II, {name}", centroids]
        for subset, name in OPTIMISED.items():
            parts += [f"### Table III, {name}", _errors(rows, published, "table3", subset, (*PAGE_ERRORS, PAGE_SIGNED))]
    return "\n\n".join(part for part in parts if part) + "\n"


def _errors(
    rows: Sequence[Row], published: Published | None, table: str, subset: str, columns: Sequence[Column] = PAGE_ERRORS
) -> str:
    lines = [
        ["controller", "row id", "samples", *(column.heading for column in (*columns, PAGE_LATENCY, PAGE_MEAN_LATENCY))]
    ]
    if published is not None:
        values = published.rows[table].data["solver" if subset == "optimised" else subset]
        cells = [_published(column, values.get(column.key)) for column in columns]
        cells += [NO_VALUE, _published(PUBLISHED_MEAN_LATENCY, values.get(PUBLISHED_MEAN_LATENCY.key))]
        count = f"{values['samples']:.0f}" if "samples" in values else NO_VALUE
        lines.append([f"*{published.short}*", "", count, *cells])
    for row in rows:
        if row["subset"] != subset or row["camera"] is not None:
            continue
        cells = [column.with_spread(row[column.key], row[f"{column.key}_std"]) for column in columns]
        mean = PAGE_MEAN_LATENCY.with_spread(row[PAGE_MEAN_LATENCY.key], row["latency_ms_std"])
        cells += [PAGE_LATENCY.cell(row), mean]
        lines.append([row["label"], f"`{row['row_id']}`", str(row["samples"]), *cells])
    return markdown_table(lines, text_columns=2)


def _centroids(rows: Sequence[Row], published: Published | None, source: str) -> str:
    """One line for each controller: left and right errors in pixels and percent, and visibility."""
    of_pictures = [(eye, column) for eye, columns in PAGE_EYES.items() for column in columns]
    of_pictures += [("any", column) for column in PAGE_BOTH]
    framed = [PAGE_FRAMED] if source == "projected" else []
    heads = [column.heading for column in (*(column for _, column in of_pictures), *PAGE_SEEN.values(), *framed)]
    lines = [["controller", "row id", "pictures", *heads]]
    if published is not None:
        data = published.rows["table2"].data
        cells = [_published(column, data[camera][column.key]) for camera, column in of_pictures]
        cells += [_published(column, data[which]["visibility_percent"]) for which, column in PAGE_SEEN.items()]
        lines.append([f"*{published.short}*", "", NO_VALUE, *cells, *(NO_VALUE for _ in framed)])
    for id_ in dict.fromkeys(row["row_id"] for row in rows):
        own = {row["camera"]: row for row in rows if row["row_id"] == id_ and row["pixels"] == source}
        if not own:
            continue
        cells = [
            column.with_spread(own[camera][column.key], own[camera][f"{column.key}_std"])
            for camera, column in of_pictures
        ]
        both = own["any"]
        cells += [_with_interval(column, both) for column in PAGE_SEEN.values()]
        cells += [column.text(both[column.key]) for column in framed]
        lines.append([both["label"], f"`{id_}`", str(both["samples"]), *cells])
    return markdown_table(lines, text_columns=2) if len(lines) > 1 + (published is not None) else ""


def _truth(rows: Sequence[Row]) -> str:
    lines = [["controller", "row id", *(column.heading for column in PAGE_TRUTH)]]
    for row in rows:
        if _is_whole(row):
            cells = [column.text(row[column.key]) for column in PAGE_TRUTH]
            lines.append([row["label"], f"`{row['row_id']}`", *cells])
    return markdown_table(lines, text_columns=2)


def _rules(rows: Sequence[Row]) -> str:
    """Two lines for each controller: on reported poses and, where they are known, on true ones."""
    unavoidable = [PAGE_UNAVOIDABLE] if any(row[PAGE_UNAVOIDABLE.key] is not None for row in rows) else []
    heads = [*PAGE_RULES.values(), *(column.heading for column in unavoidable)]
    lines = [["controller", "row id", "poses", *heads]]
    for row in filter(_is_whole, rows):
        for twin, poses in zip(TWINS, ("reported", "true"), strict=True):
            if row[f"no_go_deepest_mm{twin}"] is None:
                continue
            cells = [_events(row, rule, twin) for rule in PAGE_RULES]
            cells += [column.text(None if twin else row[column.key]) for column in unavoidable]
            lines.append([row["label"], f"`{row['row_id']}`", poses, *cells])
    return markdown_table(lines, text_columns=3)


def _events(row: Row, rule: str, twin: str) -> str:
    """How often a rule was broken, how long at most, and how much."""
    unit = RULE_UNITS[rule]
    if not row[f"{rule}_events{twin}"]:
        return "0"
    longest, deepest = row[f"{rule}_longest_s{twin}"], row[f"{rule}_deepest_{unit}{twin}"]
    return f"{row[f'{rule}_events{twin}']} ({longest:.2f} s; {deepest:.1f}{'°' if unit == 'deg' else f' {unit}'})"


def _paired(rows: Sequence[Row]) -> str:
    """One line for each row that is held against another."""
    columns = [replace(column, key=difference_key(column.key)) for column in PAGE_PAIRED]
    columns += [PAGE_REGRET] if any(row.get(PAGE_REGRET.key) is not None for row in rows) else []
    lines = [["controller", "row id", "against", *(column.heading for column in columns)]]
    for row in filter(_is_whole, rows):
        if any(row.get(f"{column.key}_low") is not None for column in columns):
            against = f"`{row[AGAINST]}`" if row.get(AGAINST) else NO_VALUE
            cells = [_with_interval(column, row) for column in columns]
            lines.append([row["label"], f"`{row['row_id']}`", against, *cells])
    return markdown_table(lines, text_columns=3) if len(lines) > 1 else ""


def _with_interval(column: Column, row: Row) -> str:
    """A value and, where there is one, its interval."""
    low, high = (row.get(f"{column.key}{end}") for end in ENDS[1:])
    value = column.text(row.get(column.key))
    return value if low is None or high is None else f"{value} [{column.text(low)}, {column.text(high)}]"


def _times(about: dict[str, Any], published: Published | None) -> str:
    timed = about["timing_environments"] or about["environments"]
    processors = " and of ".join(sorted({environment["machine"]["processor"] for environment in timed}))
    ours = f"*latency* is the median time of one call of a controller, on one core of {processors}."
    return ours if published is None else f"{ours} The article's are means; {published.short}: {published.machine}."


def _dataset(block: Block, dataset: dict[str, Any]) -> str:
    shares = dataset["constrained_percent"]
    return (
        f"Dataset `{block.dataset.folder}`: {dataset['sequences']} trials, {dataset['frames']} samples, "
        f"{dataset['seconds']:.1f} s, SHA-256 `{dataset['sha256'][:12]}…`. Rules speak against the naive pose in "
        f"{min(shares):.1f} to {max(shares):.1f} % of a trial's samples."
    )


def _is_whole(row: Row) -> bool:
    return row["subset"] == "all" and row["camera"] is None


def _published(column: Column, value: float | Figure | None) -> str:
    if isinstance(value, Figure):
        return column.with_spread(value.mean, value.std)
    return column.text(value)
