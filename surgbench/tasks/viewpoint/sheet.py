"""Tables of the viewpoint task: what is kept of them, their page and their figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from surgbench.files import sha256_text
from surgbench.records.reader import read_record
from surgbench.report.figures import FIGURE_PNG
from surgbench.report.losses import LOSS_COLUMNS
from surgbench.report.row import Row
from surgbench.reproduce.paired import paired_fields
from surgbench.reproduce.results import RECORDS, Results
from surgbench.reproduce.sheet import Sheet
from surgbench.tasks.viewpoint.columns import PAGE_PAIRED
from surgbench.tasks.viewpoint.figures import Line, draw_centroids, draw_paths, draw_pixel_errors, draw_timeline
from surgbench.tasks.viewpoint.hand_figure import draw_hands
from surgbench.tasks.viewpoint.hand_page import has_hands, page_of_hands
from surgbench.tasks.viewpoint.hand_rows import HAND_COLUMNS, HAND_MEASURES, UNFINISHED, unfinished
from surgbench.tasks.viewpoint.page import CENTROIDS_PNG, PATHS_PNG, PIXELS_PNG, page
from surgbench.tasks.viewpoint.picture_rows import SEEN, seen_percent
from surgbench.tasks.viewpoint.plan import ViewpointSettings
from surgbench.tasks.viewpoint.records import ViewpointRecord
from surgbench.tasks.viewpoint.robustness import ROBUSTNESS_PNG, Level, draw_robustness
from surgbench.tasks.viewpoint.rows import CLIPPED, ERRORS, VIEWPOINT_COLUMNS, clipped, subsets
from surgbench.tasks.viewpoint.rule_rows import DEEPEST, EVENT_COUNTS, UNAVOIDABLE, rule_row
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO
from surgbench.viewpoint.scores import naive_violations
from surgbench.viewpoint.simulator import make_scene

if TYPE_CHECKING:
    from surgbench.reproduce.results import BlockWork
    from surgbench.reproduce.table import Definition
    from surgbench.tasks.viewpoint.dataset import ViewpointDataset


def _describe(dataset: ViewpointDataset, frames: int) -> dict[str, Any]:
    """How long the trials are and how often rules bind, and hashes of the first samples as they were measured."""
    seconds, constrained, first = 0.0, [], {}
    for unit in dataset.units():
        trial = dataset.trial(unit.sequence)
        seconds += float(trial.timestamps_s[-1])
        constrained.append(float(naive_violations(trial, make_scene(trial)).any[trial.measured].mean()))
        first[unit.sequence] = sha256_text(np.ascontiguousarray(trial.T_world_feature[:frames], "<f8").tobytes().hex())
    return {
        "sequences": len(first),
        "frames": sum(dataset.sequence(name).frames for name in first),
        "seconds": round(seconds, 3),
        "constrained_percent": [round(100 * share, 2) for share in constrained],
        "first_sha256": first,
    }


PAIRED = tuple(column.key for column in PAGE_PAIRED)
_COUNTS = (CLIPPED, *EVENT_COUNTS[""])
_FURTHER_COUNTS = (*EVENT_COUNTS["_true"], UNAVOIDABLE)
_NUMBERS = (*DEEPEST[""], *DEEPEST["_true"], *SEEN)


def _count(record: ViewpointRecord) -> Row:
    of_rules = rule_row([record])
    kept = {name: of_rules[name] for name in (*_COUNTS[1:], *_FURTHER_COUNTS, *DEEPEST[""], *DEEPEST["_true"])}
    counts = {CLIPPED: clipped(record, subsets(record)["all"]), **kept, **seen_percent(record)}
    return counts if record.spec.hand is None else {**counts, UNFINISHED: unfinished(record)}


def _page(definition: Definition, results: Results) -> str:
    return page_of_hands(definition, results) if has_hands(definition) else page(definition, results)


def _draw(definition: Definition, blocks: Sequence[BlockWork], results: Results, folder: Path) -> list[str]:
    return [*_draw_trial(definition, blocks, results, folder), *_draw_robustness(blocks, results, folder)]


def _draw_robustness(blocks: Sequence[BlockWork], results: Results, folder: Path) -> list[str]:
    """Curves over levels, of the first block that has disturbed rows."""
    of_all = {row["row_id"]: row for row in results.rows if row["subset"] == "all" and row["camera"] is None}
    for block in blocks:
        settings = {one.row.id: cast(ViewpointSettings, one.jobs[0].settings) for one in block.rows if one.jobs}
        found = [
            Level(one.tracker.name, one.disturbance.levels(), of_all[id_])
            for id_, one in settings.items()
            if id_ in of_all
        ]
        title = f"{block.block.heading}: means over trials"
        if any(one.levels for one in found) and draw_robustness(found, folder / ROBUSTNESS_PNG, title):
            return [ROBUSTNESS_PNG]
    return []


def _draw_trial(definition: Definition, blocks: Sequence[BlockWork], results: Results, folder: Path) -> list[str]:
    wanted = definition.table.figure
    if wanted is None:
        return []
    if has_hands(definition):
        return draw_hands(definition, results, folder)
    work = next(work for work in blocks if work.block.name == wanted.block)
    dataset = cast("ViewpointDataset", work.dataset)
    by_id = {row.row.id: row for row in work.rows}
    lines = []
    settings: ViewpointSettings | None = None
    for id_ in wanted.rows:
        for job in by_id[id_].jobs:
            if job.unit.id == wanted.unit and job.repeat == 0:
                record = read_record(folder / RECORDS / job.path)
                if isinstance(record, ViewpointRecord) and record.frames.joints:
                    lines.append(Line(by_id[id_].row.label, record))
                    settings = cast(ViewpointSettings, job.settings)
    if settings is None:
        return []
    trial = dataset.trial(lines[0].record.spec.sequence)
    title = f"{dataset.name}, trial {trial.id}: errors over time"
    draw_timeline(lines, trial.dt_s, folder / FIGURE_PNG, title)
    draw_paths(lines, trial, make_scene(trial, registration=settings.registration), folder / PATHS_PNG)
    size = AUTOCAM_STEREO.left.width, AUTOCAM_STEREO.left.height
    title = f"{dataset.name}, trial {trial.id}: the ring in the pictures"
    draw_centroids(lines, *size, folder / CENTROIDS_PNG, title)
    draw_pixel_errors(lines, *size, trial.dt_s, folder / PIXELS_PNG, title)
    return [FIGURE_PNG, PATHS_PNG, CENTROIDS_PNG, PIXELS_PNG]


def _no_traits(dataset: ViewpointDataset, sequence: str) -> Row:
    return {}


VIEWPOINT_SHEET = Sheet(
    columns=VIEWPOINT_COLUMNS,
    errors=ERRORS,
    spreadless=(),
    counts=_COUNTS,
    traits=(),
    no_difference={
        "vva_deg": 0.02,
        "fd_mm": 0.05,
        "pf_deg": 0.02,
        "an_deg": 0.1,
        "pn_mm": 0.1,
        "vva_true_deg": 0.02,
    },
    traits_of=_no_traits,
    count=_count,
    describe=_describe,
    page=_page,
    draw=_draw,
    estimates="setpoint",
    further_columns=(*paired_fields(PAIRED), *LOSS_COLUMNS, *HAND_COLUMNS),
    further_errors=HAND_MEASURES,
    further_estimates=("ring",),
    further_counts=(*_FURTHER_COUNTS, UNFINISHED),
    further_numbers=_NUMBERS,
    paired=PAIRED,
    regretted="view_cost",
)
