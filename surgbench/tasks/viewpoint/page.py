"""``leaderboard.md`` of a viewpoint table: the article's three tables, the paper's figures first, then ours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from surgbench.report.figures import FIGURE_PNG
from surgbench.report.markdown import QUICK_WARNING
from surgbench.report.row import Row
from surgbench.reproduce.published import Figure, Published

if TYPE_CHECKING:
    from surgbench.reproduce.results import Results
    from surgbench.reproduce.table import Block, Definition

PATHS_PNG, CENTROIDS_PNG = "paths.png", "centroids.png"
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
    "projected": "by geometry, at every sample",
}
# Key, heading, decimals.
Column = tuple[str, str, int]
ERRORS = (
    ("vva_deg", "VVA [deg]", 2),
    ("fd_mm", "FD [mm]", 2),
    ("pf_deg", "PF [deg]", 2),
    ("an_deg", "AN [deg]", 2),
    ("pn_mm", "PN [mm]", 2),
)
QUICK_TRIAL = (
    "It is the beginning of one trial: how often rules bind in that is not what the headings say of whole trials, and "
    "a subset may be empty."
)
SIGNED = ("fd_signed_mm", "FD, signed [mm]", 2)
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
    for block in table.blocks:
        rows = [row for row in results.rows if row["block"] == block.name]
        data = _dataset(block, results.about["datasets"][block.dataset.folder])
        parts += [f"## {block.heading}", block.note.strip(), data, *_failures(rows)]
        for subset, name in SUBSET_NAMES.items():
            parts += [f"### Table I, {name}", _errors(rows, published, "table1", subset)]
        parts += ["### In truth, and what was commanded", _truth(rows)]
        for source, name in SOURCES.items():
            centroids = _centroids(rows, published, source)
            if centroids:
                parts += [f"### Table II, {name}", centroids]
        for subset, name in OPTIMISED.items():
            parts += [f"### Table III, {name}", _errors(rows, published, "table3", subset, (*ERRORS, SIGNED))]
    return "\n\n".join(part for part in parts if part) + "\n"


def _errors(
    rows: Sequence[Row], published: Published | None, table: str, subset: str, columns: Sequence[Column] = ERRORS
) -> str:
    lines = [["controller", "row id", "samples", *(name for _, name, _ in columns), "time [ms]"]]
    if published is not None:
        values = published.rows[table].data["solver" if subset == "optimised" else subset]
        cells = [_published(values.get(key), decimals) for key, _, decimals in columns]
        count = f"{values['samples']:.0f}" if "samples" in values else "–"
        lines.append([f"*{published.short}*", "", count, *cells, _published(values.get("latency_ms"), 2)])
    for row in rows:
        if row["subset"] != subset or row["camera"] is not None:
            continue
        cells = [_with_spread(row[key], row[f"{key}_std"], decimals) for key, _, decimals in columns]
        lines.append([row["label"], f"`{row['row_id']}`", str(row["samples"]), *cells, _latency(row)])
    return _table(lines, text_columns=2)


def _centroids(rows: Sequence[Row], published: Published | None, source: str) -> str:
    """One line for each controller: left and right errors in pixels and percent, and visibility."""
    eyes, errors = ("left", "right"), ("l2", "u", "v")
    heads = [f"{error.upper() if error == 'l2' else error} {eye} [px]" for eye in eyes for error in errors]
    heads += [
        "L2 both [%]",
        "u both [%]",
        "v both [%]",
        *(f"seen {which} [%]" for which in ("left", "right", "any", "both")),
    ]
    lines = [["controller", "row id", "pictures", *heads]]
    if published is not None:
        data = published.rows["table2"].data
        cells = [_published(data[eye][f"{error}_error_px"], 1) for eye in eyes for error in errors]
        cells += [_published(data["any"][f"{error}_error_percent"], 2) for error in errors]
        cells += [_published(data[which]["visibility_percent"], 2) for which in ("left", "right", "any", "both")]
        lines.append([f"*{published.short}*", "", "–", *cells])
    for id_ in dict.fromkeys(row["row_id"] for row in rows):
        own = {row["camera"]: row for row in rows if row["row_id"] == id_ and row["pixels"] == source}
        if not own:
            continue
        cells = [
            _with_spread(own[eye][f"{error}_error_px"], own[eye][f"{error}_error_px_std"], 1)
            for eye in eyes
            for error in errors
        ]
        both = own["any"]
        for error in errors:
            cells.append(_with_spread(both[f"{error}_error_percent"], both[f"{error}_error_percent_std"], 2))
        cells += [_number(both[f"visibility_{which}_percent"], 2) for which in ("left", "right", "any", "both")]
        lines.append([both["label"], f"`{id_}`", str(both["samples"]), *cells])
    return _table(lines, text_columns=2) if len(lines) > 1 + (published is not None) else ""


def _truth(rows: Sequence[Row]) -> str:
    heads = ["true VVA [deg]", "true FD [mm]", "true PF [deg]", "true AN [deg]", "PN, whole way [mm]"]
    heads += ["constrained [%]", "in the zone", "below the floor", "too near", "beyond limits", "clipped commands"]
    heads += ["p99.9 [ms]"]
    lines = [["controller", "row id", *heads]]
    for row in rows:
        if row["subset"] == "all" and row["camera"] is None:
            keys = ("vva_true_deg", "fd_true_mm", "pf_true_deg", "an_true_deg", "pn_full_mm", "constrained_percent")
            cells = [_number(row[key], 2) for key in keys]
            counts = [str(row[f"{key}_violations"]) for key in ("no_go", "floor", "proximity", "limit")]
            counts.append(str(row["clipped_commands"]))
            p999 = _number(row["latency_ms_p999"], 3)
            lines.append([row["label"], f"`{row['row_id']}`", *cells, *counts, p999])
    return _table(lines, text_columns=2)


def _times(about: dict[str, Any], published: Published | None) -> str:
    timed = about["timing_environments"] or about["environments"]
    processors = " and of ".join(sorted({environment["machine"]["processor"] for environment in timed}))
    ours = f"Times are means of one call of a controller, on one core of {processors}."
    return ours if published is None else f"{ours} Those of {published.short}: {published.machine}."


def _dataset(block: Block, dataset: dict[str, Any]) -> str:
    shares = dataset["constrained_percent"]
    return (
        f"Dataset `{block.dataset.folder}`: {dataset['sequences']} trials, {dataset['frames']} samples, "
        f"{dataset['seconds']:.1f} s, SHA-256 `{dataset['sha256'][:12]}…`. Rules speak against the naive pose in "
        f"{min(shares):.1f} to {max(shares):.1f} % of a trial's samples."
    )


def _failures(rows: Sequence[Row]) -> list[str]:
    lines = [
        f"- `{row['row_id']}` {row['status']}: {row['error'] or 'no message'}"
        for row in rows
        if row["status"] != "ok" and row["subset"] == "all" and row["camera"] is None
    ]
    return ["\n".join(lines)] if lines else []


def _published(value: float | Figure | None, decimals: int) -> str:
    if isinstance(value, Figure):
        return _with_spread(value.mean, value.std, decimals)
    return _number(value, decimals)


def _with_spread(value: float | None, std: float | None, decimals: int) -> str:
    if value is None:
        return "–"
    return f"{value:.{decimals}f}" + ("" if std is None else f" ± {std:.{decimals}f}")


def _number(value: float | None, decimals: int) -> str:
    return "–" if value is None else f"{value:.{decimals}f}"


def _latency(row: Row) -> str:
    return _with_spread(row["latency_ms_mean"], row["latency_ms_std"], 3)


def _table(lines: list[list[str]], text_columns: int) -> str:
    rule = ["---" if column < text_columns else "---:" for column in range(len(lines[0]))]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in [lines[0], rule, *lines[1:]])
