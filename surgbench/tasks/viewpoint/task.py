"""The viewpoint task, as the engine sees it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from surgbench.task import Task

if TYPE_CHECKING:
    from surgbench.conformance.subject import Check
    from surgbench.report.column import Column
    from surgbench.report.field import Field
    from surgbench.report.filmed import Filmed
    from surgbench.report.row import Row
    from surgbench.report.stage import Stage, Subject
    from surgbench.report.video_options import VideoOptions
    from surgbench.reproduce.sheet import Sheet
    from surgbench.suite.asked import Conditions
    from surgbench.suite.running import Run
    from surgbench.suite.settings import Job
    from surgbench.tasks.viewpoint.asked import ViewpointRow
    from surgbench.tasks.viewpoint.dataset import ViewpointDataset
    from surgbench.tasks.viewpoint.format import ViewpointManifest
    from surgbench.tasks.viewpoint.plan import ViewpointSettings
    from surgbench.tasks.viewpoint.records import ViewpointRecord


class ViewpointTask(Task):
    """Command a camera-holding arm so that a moving feature stays in view."""

    name: ClassVar[str] = "viewpoint"
    summary: ClassVar[str] = "command a camera-holding arm so that a moving feature stays in view"
    # A row for every subset of the samples, and rows of the pictures for each camera.
    made_by: ClassVar[tuple[str, ...]] = tuple(
        f"{__package__}.{name}" for name in ("dataset", "execute", "hand_execute", "hand_worker", "pictures", "worker")
    )
    parts: ClassVar[Mapping[str, Any]] = {"subset": "all", "camera": None, "pixels": None}
    # How far the feature is from the optical axis.
    ranked_by: ClassVar[str] = "vva_deg"
    first_check: ClassVar[str] = "plain trial"

    @property
    def manifest(self) -> type[ViewpointManifest]:
        """Trials."""
        from surgbench.tasks.viewpoint.format import ViewpointManifest

        return ViewpointManifest

    def open(self, folder: Path, manifest: ViewpointManifest, sha256: str) -> ViewpointDataset:
        """A dataset of trials."""
        from surgbench.tasks.viewpoint.dataset import ViewpointDataset

        return ViewpointDataset(folder, manifest, sha256)

    def validate(self, dataset: ViewpointDataset, progress: Callable[[float], None]) -> list[str]:
        """Tables, poses, what is true over a trial."""
        from surgbench.tasks.viewpoint.validate import validate

        return validate(dataset, progress)

    @property
    def row(self) -> type[ViewpointRow]:
        """Registration, the zone as published, pictures."""
        from surgbench.tasks.viewpoint.asked import ViewpointRow

        return ViewpointRow

    def complete(self, row: ViewpointRow, conditions: Conditions, dataset: ViewpointDataset) -> ViewpointSettings:
        """See :func:`surgbench.tasks.viewpoint.plan.complete`."""
        from surgbench.tasks.viewpoint.plan import complete

        return complete(row, conditions, dataset)

    def execute(self, job: Job, dataset: ViewpointDataset, run: Run) -> dict[str, Any]:
        """See :func:`surgbench.tasks.viewpoint.execute.execute`, and with a simulated hand ``hand_execute``."""
        if getattr(job.settings, "hand", None) is not None:
            from surgbench.tasks.viewpoint.hand_execute import execute_with_hand

            return execute_with_hand(job, dataset, run)
        from surgbench.tasks.viewpoint.execute import execute

        return execute(job, dataset, run)

    def timed(self, row: ViewpointRow) -> ViewpointRow:
        """Without pictures, which are taken after the run."""
        return row.model_copy(update={"photographs_hz": 0.0})

    def recorded_job(self, record: dict[str, Any], dataset: ViewpointDataset) -> Job:
        """See :func:`surgbench.tasks.viewpoint.rescored.recorded_job`."""
        from surgbench.tasks.viewpoint.rescored import recorded_job

        return recorded_job(record, dataset)

    def rescore(self, record: dict[str, Any], dataset: ViewpointDataset, run: Run) -> dict[str, Any]:
        """See :func:`surgbench.tasks.viewpoint.rescored.rescore`."""
        from surgbench.tasks.viewpoint.rescored import rescore

        return rescore(record, dataset, run)

    @property
    def record(self) -> type[ViewpointRecord]:
        """A record of a controller."""
        from surgbench.tasks.viewpoint.records import ViewpointRecord

        return ViewpointRecord

    @property
    def columns(self) -> tuple[Field, ...]:
        """Errors, rules that were broken, what the pictures show."""
        from surgbench.tasks.viewpoint.rows import VIEWPOINT_COLUMNS

        return VIEWPOINT_COLUMNS

    @property
    def further_columns(self) -> tuple[Field, ...]:
        """Time out of view, and what a simulated hand did."""
        from surgbench.report.losses import LOSS_COLUMNS
        from surgbench.tasks.viewpoint.hand_rows import HAND_COLUMNS

        return (*LOSS_COLUMNS, *HAND_COLUMNS)

    @property
    def shown(self) -> tuple[Column, ...]:
        """The article's measures."""
        from surgbench.tasks.viewpoint.columns import COLUMNS
        from surgbench.tasks.viewpoint.hand_columns import HAND_SHOWN

        return (*COLUMNS, *HAND_SHOWN)

    def rows(self, head: Row, records: list[ViewpointRecord]) -> list[Row]:
        """One row for every subset of the samples, and for every camera."""
        from surgbench.tasks.viewpoint.rows import viewpoint_rows

        return viewpoint_rows(head, records)

    def on_page(self, row: Row) -> bool:
        """Rows of the pictures are for files."""
        return row["camera"] is None

    @property
    def sheet(self) -> Sheet:
        """Tables beside those of the article on AutoCam."""
        from surgbench.tasks.viewpoint.sheet import VIEWPOINT_SHEET

        return VIEWPOINT_SHEET

    def draw(
        self,
        records: Sequence[ViewpointRecord],
        options: VideoOptions,
        dataset: Path | None,
        out: Path,
        progress: Callable[[str, float], Any],
    ) -> list[Path]:
        """The scene, both eyes, errors and rules: an MP4 and a sheet of stills for each run or trial."""
        from surgbench.tasks.viewpoint.film.film import draw, plan, unit_steps

        films = plan(records, options, dataset)
        with progress("steps drawn", sum(unit_steps(film) for film in films)) as advance:
            return [path for film in films for path in draw(film, options, out, advance)]

    def filmed(self, record: ViewpointRecord, dataset: Path | None) -> Filmed:
        """The scene, both eyes, errors and rules."""
        from surgbench.tasks.viewpoint.film.filmed import FilmedController

        return FilmedController(record, dataset)

    def view(self, subject: Subject, stage: Stage, progress: Callable[[str, float], Any]) -> list[str]:
        """The scene, the arm that holds the camera, what it sees, the errors and rules."""
        from surgbench.tasks.viewpoint.viewed import view

        return view(subject, stage, progress)

    def plots(
        self,
        records: Sequence[ViewpointRecord],
        dataset: Path | None,
        out: Path,
        progress: Callable[[str, float], Any],
    ) -> list[Path]:
        """Errors, rules and latencies over time."""
        from surgbench.tasks.viewpoint.timelines import draw_plots

        return draw_plots(records, dataset, out, progress)

    def checks(self) -> Mapping[str, Check]:
        """Small worlds of all kinds."""
        from surgbench.tasks.viewpoint.conformance.checks import VIEWPOINT_CHECKS

        return VIEWPOINT_CHECKS
