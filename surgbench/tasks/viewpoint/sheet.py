"""Tables of the viewpoint task: what is kept of them, their page and their figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from surgbench.files import sha256_text
from surgbench.records.reader import read_record
from surgbench.report.figures import FIGURE_PNG
from surgbench.report.row import Row
from surgbench.reproduce.results import RECORDS, Results
from surgbench.reproduce.sheet import Sheet
from surgbench.tasks.viewpoint.figures import Line, draw_centroids, draw_paths, draw_timeline
from surgbench.tasks.viewpoint.hand_figure import draw_hands
from surgbench.tasks.viewpoint.hand_page import has_hands, page_of_hands
from surgbench.tasks.viewpoint.hand_rows import HAND_COLUMNS, HAND_MEASURES, UNFINISHED, unfinished
from surgbench.tasks.viewpoint.page import CENTROIDS_PNG, PATHS_PNG, page
from surgbench.tasks.viewpoint.plan import ViewpointSettings
from surgbench.tasks.viewpoint.records import ViewpointRecord
from surgbench.tasks.viewpoint.rows import COUNTS, ERRORS, VIEWPOINT_COLUMNS, counted, stacked_pixels
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


def _count(record: ViewpointRecord) -> Row:
    counts: Row = {**counted(record, np.array(record.frames.asked, dtype=bool))}
    return counts if record.spec.hand is None else {**counts, UNFINISHED: unfinished(record)}


def _page(definition: Definition, results: Results) -> str:
    return page_of_hands(definition, results) if has_hands(definition) else page(definition, results)


def _draw(definition: Definition, blocks: Sequence[BlockWork], results: Results, folder: Path) -> list[str]:
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
    clouds = [(line.label, *stacked_pixels([line.record], "projected_px")) for line in lines]
    size = AUTOCAM_STEREO.left.width, AUTOCAM_STEREO.left.height
    draw_centroids(clouds, *size, folder / CENTROIDS_PNG, f"{dataset.name}, trial {trial.id}: the ring in the pictures")
    return [FIGURE_PNG, PATHS_PNG, CENTROIDS_PNG]


def _no_traits(dataset: ViewpointDataset, sequence: str) -> Row:
    return {}


VIEWPOINT_SHEET = Sheet(
    columns=VIEWPOINT_COLUMNS,
    errors=ERRORS,
    spreadless=(),
    counts=COUNTS,
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
    further_estimates=("ring",),
    further_columns=HAND_COLUMNS,
    further_errors=HAND_MEASURES,
    further_counts=(UNFINISHED,),
)
