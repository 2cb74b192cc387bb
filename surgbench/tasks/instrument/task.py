"""The instrument task, as the engine sees it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from surgbench.task import Task

if TYPE_CHECKING:
    from surgbench.conformance.subject import Check
    from surgbench.handeye.table import Judged
    from surgbench.report.column import Column
    from surgbench.report.field import Field
    from surgbench.report.filmed import Filmed
    from surgbench.report.row import Row
    from surgbench.report.stage import Stage, Subject
    from surgbench.report.video_options import VideoOptions
    from surgbench.reproduce.sheet import Sheet
    from surgbench.suite.asked import Conditions, FileRequest
    from surgbench.suite.running import Run
    from surgbench.suite.settings import Job
    from surgbench.tasks.instrument.asked import InstrumentRow
    from surgbench.tasks.instrument.dataset import InstrumentDataset
    from surgbench.tasks.instrument.format import InstrumentManifest
    from surgbench.tasks.instrument.from_file import FileJob
    from surgbench.tasks.instrument.plan import InstrumentSettings
    from surgbench.tasks.instrument.records import InstrumentRecord


class InstrumentTask(Task):
    """Estimate the state of one or two instruments in every frame of a mask sequence."""

    name: ClassVar[str] = "instrument"
    summary: ClassVar[str] = "estimate the state of one or two instruments in every frame of a mask sequence"
    default: ClassVar[bool] = True
    made_by: ClassVar[tuple[str, ...]] = tuple(
        f"{__package__}.{name}"
        for name in [
            "auxiliary",
            "dataset",
            "execute",
            "judge",
            "made_masks",
            "pairs",
            "references",
            "tables",
            "tips",
            "told_prompts",
            "units",
            "worker",
        ]
    )
    # The error of the masks that trackers saw, which is known of recordings too.
    ranked_by: ClassVar[str] = "mask_error"
    first_check: ClassVar[str] = "plain sequence"
    may_refuse: ClassVar[tuple[str, ...]] = ("readings", "kinematics", "two arms", "masks of arms", "crossing arms")
    aids: ClassVar[tuple[str, ...]] = ("kinematics", "images of painted instruments")

    @property
    def manifest(self) -> type[InstrumentManifest]:
        """Sequences, cameras, instruments."""
        from surgbench.tasks.instrument.format import InstrumentManifest

        return InstrumentManifest

    def open(self, folder: Path, manifest: InstrumentManifest, sha256: str) -> InstrumentDataset:
        """A dataset of masks."""
        from surgbench.tasks.instrument.dataset import InstrumentDataset

        return InstrumentDataset(folder, manifest, sha256)

    def validate(self, dataset: InstrumentDataset, progress: Callable[[float], None]) -> list[str]:
        """Masks, tables, instruments."""
        from surgbench.tasks.instrument.validate import validate

        return validate(dataset, progress)

    @property
    def row(self) -> type[InstrumentRow]:
        """Initialiser, filter, keypoint source, readings, view."""
        from surgbench.tasks.instrument.asked import InstrumentRow

        return InstrumentRow

    def complete(self, row: InstrumentRow, conditions: Conditions, dataset: InstrumentDataset) -> InstrumentSettings:
        """See :func:`surgbench.tasks.instrument.plan.complete`."""
        from surgbench.tasks.instrument.plan import complete

        return complete(row, conditions, dataset)

    def execute(self, job: Job, dataset: InstrumentDataset, run: Run) -> dict[str, Any]:
        """See :func:`surgbench.tasks.instrument.execute.execute`."""
        from surgbench.tasks.instrument.execute import execute

        return execute(job, dataset, run)

    def from_file(self, dataset: InstrumentDataset, path: Path, asked: FileRequest) -> list[FileJob]:
        """Poses and joints in a table."""
        from surgbench.tasks.instrument.from_file import file_jobs

        return file_jobs(dataset, path, asked, self.made_by)

    def recorded_job(self, record: dict[str, Any], dataset: InstrumentDataset) -> Job:
        """See :func:`surgbench.tasks.instrument.replay.recorded_job`."""
        from surgbench.tasks.instrument.replay import recorded_job

        return recorded_job(record, dataset)

    def rescore(self, record: dict[str, Any], dataset: InstrumentDataset, run: Run) -> dict[str, Any]:
        """See :func:`surgbench.tasks.instrument.rescored.rescore`."""
        from surgbench.tasks.instrument.rescored import rescore

        return rescore(record, dataset, run)

    @property
    def record(self) -> type[InstrumentRecord]:
        """A record of an instrument tracker."""
        from surgbench.tasks.instrument.records import InstrumentRecord

        return InstrumentRecord

    @property
    def columns(self) -> tuple[Field, ...]:
        """Settings, errors, jitter, lags."""
        from surgbench.tasks.instrument.rows import INSTRUMENT_COLUMNS

        return INSTRUMENT_COLUMNS

    @property
    def further_columns(self) -> tuple[Field, ...]:
        """What recordings have in place of truth, what the readings of their arms say, and what pairs have."""
        from surgbench.tasks.instrument.rows import FURTHER_COLUMNS

        return FURTHER_COLUMNS

    @property
    def shown(self) -> tuple[Column, ...]:
        """Errors with their units."""
        from surgbench.tasks.instrument.columns import COLUMNS

        return COLUMNS

    def rows(self, head: Row, records: list[InstrumentRecord]) -> list[Row]:
        """One row."""
        from surgbench.tasks.instrument.rows import instrument_row

        return [instrument_row(head, records)]

    def group(self, record: InstrumentRecord) -> str:
        """The same settings may be run on single arms and on pairs: those are not one row."""
        return str(len(record.spec.arms))

    def title(self, row: Row) -> str:
        """How many arms a run is about."""
        return "both arms together" if row["arms"] == "dual" else "single arms"

    @property
    def sheet(self) -> Sheet:
        """Tables beside those of Hu et al. 2026."""
        from surgbench.tasks.instrument.sheet import INSTRUMENT_SHEET

        return INSTRUMENT_SHEET

    def draw(
        self,
        records: Sequence[InstrumentRecord],
        options: VideoOptions,
        dataset: Path | None,
        out: Path,
        progress: Callable[[str, float], Any],
    ) -> list[Path]:
        """Estimates over what was seen: an MP4 and a contact sheet per unit."""
        from surgbench.tasks.instrument.video import draw, plan

        videos = plan(records, options, dataset)
        with progress("drawing frames", sum(video.frames for video in videos)) as advance:
            return [path for video in videos for path in draw(video, options, out, advance)]

    def filmed(self, record: InstrumentRecord, dataset: Path | None) -> Filmed:
        """Outlines of what was seen and estimated."""
        from surgbench.tasks.instrument.filmed import FilmedTracker

        return FilmedTracker(record, dataset)

    def view(self, subject: Subject, stage: Stage, progress: Callable[[str, float], Any]) -> list[str]:
        """Pictures with outlines, the instruments in space, the errors."""
        from surgbench.tasks.instrument.viewed import view

        return view(subject, stage, progress)

    def hand_eye(
        self,
        records: Sequence[InstrumentRecord],
        dataset: Path | None,
        fix_lag: Path | None,
        progress: Callable[[str, float], Any],
    ) -> list[Judged]:
        """Held against the robot's readings of its arms."""
        from surgbench.tasks.instrument.hand_eye import hand_eye

        return hand_eye(records, dataset, fix_lag, progress)

    def checks(self) -> Mapping[str, Check]:
        """Same seed same result, odd masks, missing input, one arm and two."""
        from surgbench.tasks.instrument.conformance.checks import CHECKS

        return CHECKS
