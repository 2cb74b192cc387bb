"""Films of viewpoint runs: an MP4 and a sheet of stills for each trial and controller, or of several side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from surgbench.errors import ConfigError, NotFoundError
from surgbench.geometry import FloatArray
from surgbench.report.drawing import (
    INK,
    PAPER,
    Colour,
    Picture,
    below,
    beside,
    heading,
    save_png,
    scaled,
    strip,
    text_size,
    write_text,
)
from surgbench.report.movie import spread_frames, write_video
from surgbench.report.recorded import UnitRuns, choose_runs, titles
from surgbench.report.video_options import VideoOptions
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.tasks.viewpoint.film.eyes import LOST, OUTLINE, Eyes
from surgbench.tasks.viewpoint.film.shot import Shot
from surgbench.tasks.viewpoint.film.space import CAMERA_TRAIL, FLOOR, NEAR, RING_TRAIL, ZONE, Space
from surgbench.tasks.viewpoint.film.strip import RULE_COLOURS, Strip
from surgbench.tasks.viewpoint.records import ViewpointRecord
from surgbench.tasks.viewpoint.rule_flags import RULE_NAMES
from surgbench.viewpoint.placement import CONSTRAINTS
from surgbench.viewpoint.registration import Method
from surgbench.viewpoint.simulator import make_scene
from surgbench.viewpoint.trial import Trial, Wire

FPS = 12.0
# One controller: space beside both eyes, one above the other; several: side by side, space above both eyes.
SPACE_PX, EYE_PX = (800, 600), 400
WIDEST_PX = 1920
SHEET_PX = 420
TITLE_PX, SMALL_PX = 13, 10
GAP = 4
# Apart from each other on white, also for colour-blind eyes (Okabe and Ito, without the palest).
COLOURS: tuple[Colour, ...] = (
    (0, 114, 178),
    (213, 94, 0),
    (0, 158, 115),
    (204, 121, 167),
    (86, 150, 210),
    (90, 90, 90),
)
LEGEND: tuple[tuple[str, Colour], ...] = (
    ("camera, its way", CAMERA_TRAIL),
    ("ring, its way", RING_TRAIL),
    ("no-go zone", ZONE),
    ("floor", FLOOR),
    ("nearest allowed", NEAR),
)
Job = UnitRuns[ViewpointDataset, ViewpointRecord]


@dataclass(frozen=True, eq=False)
class Panel:
    """What is drawn of one controller."""

    shot: Shot
    space: Space
    eyes: Eyes


class Film:
    """Frames of one or more controllers on one trial.

    Args:
        shots: In the order in which they stand.
        trial: What they ran on.
        name: Of the dataset.
    """

    def __init__(self, shots: Sequence[Shot], trial: Trial, name: str) -> None:
        self.steps = max(shot.steps for shot in shots)
        self._dt_s, self._head = trial.dt_s, f"{name}, trial {trial.id}"
        wire = None if trial.truth is None else trial.truth.wire
        self._tall = len(shots) > 1
        if self._tall:
            width = min(SPACE_PX[0], (WIDEST_PX - GAP * (len(shots) - 1)) // len(shots) // 4 * 4)
            size, eye = (width, width * 3 // 4), (width - GAP) // 2
        else:
            size, eye = SPACE_PX, EYE_PX
        cameras = np.concatenate([shot.T_world_camera[:, :3, 3] for shot in shots])
        self._panels = [_panel(shot, trial, wire, cameras, size, eye) for shot in shots]
        top = self._panels[0]
        self.width = size[0] if self._tall else size[0] + eye
        self.width = self.width * len(shots) + GAP * (len(shots) - 1) if self._tall else self.width
        self._strip = Strip(shots, self.width, trial.dt_s)
        self._eye_labels = [f"{side} eye{', turned upright' if top.eyes.turned else ''}" for side in ("left", "right")]

    def frame(self, step: int) -> Picture:
        """After a step; of even width and height, the same size for every frame."""
        title = heading(f"{self._head}   {(step + 1) * self._dt_s:6.2f} s", self.width, TITLE_PX)
        row = beside([self._draw(panel, step) for panel in self._panels], GAP)
        picture = below([title, row, self._strip.draw(step)])
        odd = ((0, picture.shape[0] % 2), (0, picture.shape[1] % 2), (0, 0))
        return np.pad(picture, odd, constant_values=PAPER[0])

    def sheet(self, steps: Sequence[int]) -> Picture:
        """Stills side by side, controllers one below the other, and the strip with all of it."""
        rows = []
        for panel in self._panels:
            stills = []
            for step in steps:
                still = self._draw(panel, min(step, panel.shot.steps - 1), tall=True)
                still = scaled(still, SHEET_PX / still.shape[1])
                stills.append(below([heading(f"{(step + 1) * self._dt_s:.2f} s", still.shape[1], TITLE_PX), still]))
            rows.append(beside(stills, GAP))
        whole = below(rows, GAP)
        shots = [panel.shot for panel in self._panels]
        curves = Strip(shots, max(whole.shape[1], 700), self._dt_s).mark(steps)
        wide = max(whole.shape[1], curves.shape[1])
        parts = [heading(self._head, wide, TITLE_PX), *(_padded(one, wide) for one in (whole, curves))]
        return below(parts)

    def _draw(self, panel: Panel, step: int, tall: bool | None = None) -> Picture:
        shot = panel.shot
        ended = step >= shot.steps
        step = min(step, shot.steps - 1)
        space = panel.space.draw(step)
        _write_rules(space, shot, step, ended)
        eyes = [
            _labelled(eye, label, bool(shot.seen[step, number]))
            for number, (eye, label) in enumerate(zip(panel.eyes.draw(step), self._eye_labels, strict=True))
        ]
        if self._tall or tall:
            both = beside(eyes, GAP)
            if both.shape[1] != space.shape[1]:
                space = scaled(space, both.shape[1] / space.shape[1])
            return below([space, both])
        return beside([space, below(eyes)])


def _panel(
    shot: Shot, trial: Trial, wire: Wire | None, cameras_m: FloatArray, size: tuple[int, int], eye: int
) -> Panel:
    workspace = shot.scene.workspace
    radius = 0.005 if wire is None else wire.ring_radius_m
    space = Space(shot, workspace, wire, cameras_m, *size, trial.dt_s)
    return Panel(shot, space, Eyes(shot, workspace, wire, eye, radius))


def _padded(picture: Picture, width: int) -> Picture:
    return np.pad(picture, ((0, 0), (0, width - picture.shape[1]), (0, 0)), constant_values=PAPER[0])


def _write_rules(picture: Picture, shot: Shot, step: int, ended: bool) -> None:
    """Title, the rules that are active or broken now, and what the colours mean."""
    height, width = picture.shape[:2]
    write_text(picture, shot.title + ("  (ended)" if ended else ""), 10, 22, 14, shot.colour)
    left = 10
    for number, name in enumerate(CONSTRAINTS):
        broken = bool(shot.rules.broken[step, number])
        if not (broken or shot.rules.active[step, number]):
            continue
        text = f"{RULE_NAMES[name]}{' BROKEN' if broken else ''}"
        write_text(picture, text, left, 42, SMALL_PX, LOST if broken else RULE_COLOURS[number])
        left += text_size(text, SMALL_PX)[0] + 14
    left = 10
    small = SMALL_PX if width >= 700 else 8
    for text, colour in LEGEND:
        if left + text_size(text, small)[0] > width - 10:
            break
        write_text(picture, text, left, height - 10, small, colour)
        left += text_size(text, small)[0] + 16


def _labelled(picture: Picture, label: str, seen: bool) -> Picture:
    """With what it is in its lower left corner, and whether the ring is seen in it."""
    note, said = f"{label}: ", "ring seen" if seen else "ring not seen"
    ground = strip(text_size(note + said, SMALL_PX)[0] + 14, 2 * SMALL_PX, INK)
    ground = ground[:, : picture.shape[1]]
    write_text(ground, note, 6, round(1.5 * SMALL_PX), SMALL_PX, PAPER)
    write_text(
        ground, said, 6 + text_size(note, SMALL_PX)[0], round(1.5 * SMALL_PX), SMALL_PX, OUTLINE if seen else LOST
    )
    picture[-ground.shape[0] :, : ground.shape[1]] = ground
    return picture


def plan(records: Sequence[ViewpointRecord], options: VideoOptions, dataset_path: Path | None) -> list[Job]:
    """What is drawn of which runs: a film for each controller, or with ``side_by_side`` one for each trial.

    Raises:
        ConfigError: An option that these films do not have.
        NotFoundError: A unit or row that no record has; or none of the runs did a step.
        DatasetError: The dataset is not there, or is another one than the records were made on.
    """
    if options.overlay:
        raise ConfigError("--overlay: cameras do not look from one place; give --side-by-side for several in one film")
    chosen = choose_runs(ViewpointDataset, records, options.units, options.rows, dataset_path)
    jobs: list[Job] = []
    for unit in chosen:
        done = [record for record in unit.records if record.frames.joints]
        if options.side_by_side and done:
            jobs.append(Job(unit.name, unit.dataset, tuple(done)))
        for record, title in zip(done, titles(done), strict=True):
            if not options.side_by_side:
                jobs.append(Job(f"{unit.name}-{_file_name(title)}", unit.dataset, (record,)))
    if not jobs:
        raise NotFoundError("none of these runs did a step that could be drawn")
    return jobs


def unit_steps(job: Job) -> int:
    """Steps of the longest of its runs."""
    return max(len(record.frames.joints) for record in job.records)


def make_film(job: Job) -> Film:
    """A film of a job's runs.

    Raises:
        DatasetError: Its trial cannot be read.
    """
    trial = job.dataset.trial(job.records[0].spec.sequence)
    shots = []
    for number, (record, title) in enumerate(zip(job.records, titles(job.records), strict=True)):
        method = cast(Method, record.spec.registration)
        scene = make_scene(trial, registration=method, missing_face=record.spec.missing_face)
        shots.append(Shot.of(record, trial, scene, title, COLOURS[number % len(COLOURS)]))
    return Film(shots, trial, job.dataset.name)


def draw(job: Job, options: VideoOptions, out: Path, advance: Callable[[float], None] = lambda _: None) -> list[Path]:
    """Draw ``<name>.mp4``, ``<name>.png`` and, if asked, ``<name>-<step>.png``.

    Args:
        job: From :func:`plan`.
        options: What to draw.
        out: Folder.
        advance: Called with the steps that a frame stands for.

    Returns:
        The files written.
    """
    film = make_film(job)
    dt_s = job.dataset.sequence(job.records[0].spec.sequence).entry.dt_s
    every = options.every or max(1, round(1.0 / (FPS * dt_s)))

    def pictures() -> Iterator[Picture]:
        for step in range(0, film.steps, every):
            yield film.frame(step)
            advance(min(every, film.steps - step))

    video, sheet = (out / f"{job.name}{ending}" for ending in (".mp4", ".png"))
    write_video(video, pictures(), options.fps or 1.0 / (every * dt_s))
    written = [video, sheet]
    moments = spread_frames(film.steps, options.columns)
    save_png(sheet, film.sheet(moments))
    if options.samples:
        for step in moments:
            written.append(out / f"{job.name}-{step:06d}.png")
            save_png(written[-1], film.frame(step))
    return written


def _file_name(title: str) -> str:
    """A title as it may stand in a file's name."""
    return "".join(letter if letter.isalnum() or letter in "._-" else "-" for letter in title).strip("-")
