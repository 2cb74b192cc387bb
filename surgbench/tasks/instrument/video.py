"""Estimates drawn over what was seen: a video and a contact sheet per unit, as in Figs. 3 and 4 of Hu et al. 2026."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surgbench.errors import SurgbenchError
from surgbench.report.drawing import (
    ESTIMATE_COLOURS,
    PAPER,
    REFERENCE_COLOUR,
    Picture,
    below,
    beside,
    heading,
    legend,
    save_png,
    side_label,
    strip,
    write_note,
)
from surgbench.report.movie import spread_frames, write_video
from surgbench.report.recorded import UnitRuns, choose_runs, titles
from surgbench.report.video_options import VideoOptions
from surgbench.tasks.instrument.records import InstrumentRecord
from surgbench.tasks.instrument.scenery import Scenery, Shot
from surgbench.tasks.instrument.skeletons import BEST_COLOUR, draw_samples, rank_colours

if TYPE_CHECKING:
    from surgbench.tasks.instrument.dataset import InstrumentDataset

VIDEO_WIDTH = 1920
SHEET_PANEL_WIDTH = 420
SHEET_LARGEST_SCALE = 2.0
SHEET_COLUMNS = 5
SAMPLE_FRAMES = 3
TITLE_PX, SMALL_PX = 13, 11
OBSERVED = "observed"
_GAP = 4


def _error_text(shot: Shot, frame: int) -> str:
    if shot.state(frame) is None:
        return "no estimate"
    error = shot.mask_error(frame)
    return "" if error is None else f"mask error {error:.3f}"


def compose_frame(
    scenery: Scenery, shots: Sequence[Shot], frame: int, overlay: bool = False, side_by_side: bool = False
) -> Picture:
    """One frame of the video: a panel per tracker with its title, or all trackers in one panel.

    Args:
        scenery: The unit.
        shots: The trackers.
        frame: Which frame.
        overlay: All in one panel, with a legend.
        side_by_side: What was observed in a panel before theirs, and all masks laid over the pictures.

    Returns:
        A picture of even width and height (video codecs want that), the same size for every frame.
    """
    groups = [list(shots)] if overlay else [[shot] for shot in shots]
    if side_by_side:
        groups.insert(0, [])
    across = len(groups) if len(groups) <= 3 else math.ceil(math.sqrt(len(groups)))
    scale = min(1.0, (VIDEO_WIDTH / across - _GAP) / scenery.camera.width)
    panels = []
    for group in groups:
        panel = scenery.panel(frame, group, scale, filled=side_by_side)
        width = panel.shape[1]
        if overlay:
            title = f"{scenery.recording.id}   frame {frame}"
            entries = [("reference mask", REFERENCE_COLOUR)]
            entries += [(f"{shot.title}  {_error_text(shot, frame)}", shot.colour) for shot in group]
            # One line each, since the texts change their widths and the picture must not change its size.
            foot = below([legend([entry], width, SMALL_PX) for entry in entries])
            panels.append(below([heading(title, width, TITLE_PX), panel, foot]))
        else:
            who, note = (group[0].title, _error_text(group[0], frame)) if group else (OBSERVED, scenery.recording.id)
            title = f"{who}   frame {frame}   {note}"
            panels.append(below([heading(title, width, TITLE_PX), panel]))
    blank = strip(panels[0].shape[1], panels[0].shape[0])
    panels += [blank] * (-len(panels) % across)
    picture = below([beside(panels[i : i + across], _GAP) for i in range(0, len(panels), across)], _GAP)
    odd = ((0, picture.shape[0] % 2), (0, picture.shape[1] % 2), (0, 0))
    return np.pad(picture, odd, constant_values=PAPER[0])


def contact_sheet(
    scenery: Scenery, shots: Sequence[Shot], frames: Sequence[int], side_by_side: bool = False
) -> Picture:
    """Frames as columns, trackers as rows, with labels and a legend; cropped to where the instruments are.

    Args:
        scenery: The unit.
        shots: The trackers, one row each.
        frames: Frame numbers, one column each.
        side_by_side: What was observed in a row above theirs, and all masks laid over the pictures.
    """
    window = scenery.window(frames)
    scale = min(SHEET_LARGEST_SCALE, SHEET_PANEL_WIDTH / window.width)
    rows: list[Picture] = []
    for shot in (None, *shots) if side_by_side else shots:
        panels = []
        for frame in frames:
            panel = scenery.panel(frame, [] if shot is None else [shot], scale, window, filled=side_by_side)
            # Records have mask errors in the endoscope's view alone.
            if shot is not None and not scenery.is_auxiliary:
                write_note(panel, _error_text(shot, frame), SMALL_PX)
            panels.append(panel)
        height, width = panels[0].shape[:2]
        label = OBSERVED if shot is None else shot.title
        rows.append(beside([side_label(label, height, TITLE_PX), beside(panels, _GAP)]))
    heads = beside([heading(f"frame {frame}", width, TITLE_PX) for frame in frames], _GAP)
    side = rows[0].shape[1] - heads.shape[1]
    top = beside([strip(side, heads.shape[0]), heads])
    seen = (
        "mask that was seen, tips and marked points in the data"
        if side_by_side
        else "reference mask, as the trackers saw it"
    )
    entries = [(seen, REFERENCE_COLOUR)]
    entries += [(f"estimate: {shot.title}", shot.colour) for shot in shots]
    return below([top, below(rows, _GAP), legend(entries, top.shape[1], TITLE_PX)])


def sample_sheet(dataset: InstrumentDataset, scenery: Scenery, shots: Sequence[Shot], frames: list[int]) -> Picture:
    """Candidates of each iteration as skeletons: one row per tracker and frame, one column per iteration.

    Raises:
        SurgbenchError: None of the trackers shows its candidates, or the instrument has no skeleton.
    """
    for instrument in scenery.instruments:
        if not instrument.spec.skeleton:
            raise SurgbenchError(f"--samples: instrument '{instrument.name}' has no 'skeleton' in its file to draw")
    from surgbench.tasks.instrument.from_file import FROM_FILE
    from surgbench.tasks.instrument.replay import replay_traces

    rows = []
    for shot in shots:
        if shot.record.spec.tracker.source.startswith(FROM_FILE):
            continue  # there is nothing here that could be repeated
        content = json.loads(shot.record.path.read_text(encoding="utf-8"))
        wanted = [frame for frame in frames if shot.state(frame) is not None]
        traces = replay_traces(content, dataset, wanted) if wanted else {}
        for frame in wanted:
            if frame in traces and traces[frame].states:
                image = scenery.recording.image(frame)
                ground = scenery.reference(frame) if image is None else image
                picture = draw_samples(scenery.camera, scenery.instruments, ground, traces[frame].states)
                rows.append(beside([side_label(f"{shot.title}, frame {frame}", picture.shape[0], TITLE_PX), picture]))
    if not rows:
        names = ", ".join(shot.title for shot in shots)
        raise SurgbenchError(f"--samples: no tracker here shows its candidates ({names}); cmaes does")
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=PAPER[0]) for row in rows]
    better, worse = rank_colours(2)
    entries = [("best candidate", BEST_COLOUR), ("better candidates", better), ("worse ones", worse)]
    return below([*padded, legend(entries, width, TITLE_PX)], _GAP)


UnitVideo = UnitRuns["InstrumentDataset", InstrumentRecord]


def plan(
    records: Sequence[InstrumentRecord], options: VideoOptions, dataset_path: Path | None = None
) -> list[UnitVideo]:
    """Which units to draw, and from which dataset; see :func:`surgbench.report.recorded.choose_runs`."""
    from surgbench.tasks.instrument.dataset import InstrumentDataset

    return choose_runs(InstrumentDataset, records, options.units, options.rows, dataset_path)


def draw(
    job: UnitVideo, options: VideoOptions, out: Path, advance: Callable[[float], None] = lambda _: None
) -> list[Path]:
    """Draw one unit: ``<unit>.mp4``, ``<unit>.png`` and, if asked, ``<unit>-samples.png``.

    Of runs with an auxiliary view there is a sheet of that view too, ``<unit>-<view>.png``.

    Args:
        job: From :func:`plan`.
        options: What to draw.
        out: Folder.
        advance: Called with 1 for every frame of the video.

    Returns:
        The files written.
    """
    shots = make_shots(job.records)
    scenery = Scenery(job.dataset, job.records[0])
    # A run that failed at once may not have known how many frames there are.
    total = min(job.frames or scenery.recording.frames, scenery.recording.frames)

    every = options.every or 1

    def pictures() -> Iterable[Picture]:
        for frame in range(0, total, every):
            yield compose_frame(scenery, shots, frame, options.overlay, options.side_by_side)
            advance(min(every, total - frame))

    video, sheet, samples = (out / f"{job.name}{ending}" for ending in (".mp4", ".png", "-samples.png"))
    write_video(video, pictures(), options.fps or 1.0 / (every * scenery.recording.dt_s))
    written = [video, sheet]
    columns = spread_frames(total, options.columns)
    save_png(sheet, contact_sheet(scenery, shots, columns, options.side_by_side))
    for view in sorted({record.spec.view for record in job.records if record.spec.view is not None}):
        seen = [shot for shot in shots if shot.record.spec.view == view]
        of_view = Scenery(job.dataset, job.records[0], view)
        written.append(out / f"{job.name}-{view}.png")
        save_png(written[-1], contact_sheet(of_view, seen, columns, options.side_by_side))
    if not options.samples:
        return written
    frames = spread_frames(total, min(SAMPLE_FRAMES, options.columns))
    save_png(samples, sample_sheet(job.dataset, scenery, shots, frames))
    return [*written, samples]


def make_shots(records: Sequence[InstrumentRecord]) -> list[Shot]:
    """Records of one unit with titles that tell them apart, and colours."""
    return [
        Shot(record, title, ESTIMATE_COLOURS[number % len(ESTIMATE_COLOURS)])
        for number, (record, title) in enumerate(zip(records, titles(records), strict=True))
    ]
