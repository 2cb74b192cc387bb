"""The task itself, with one metric."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from surgbench.dataset.integrity import check_files
from surgbench.processes.child import ChildProblemError
from surgbench.records.format import Frames, Record
from surgbench.report.column import ROW, Column
from surgbench.report.field import number
from surgbench.report.row import COMMON_COLUMNS, Row
from surgbench.report.summary import summarise
from surgbench.suite.asked import Conditions, RowRequest
from surgbench.suite.plug import plug
from surgbench.suite.running import Run
from surgbench.suite.settings import Job, Settings
from surgbench.suite.slices import cut
from surgbench.task import Task
from surgbench_toy.data import CountingDataset, CountingManifest


@dataclass(frozen=True)
class CountingSettings(Settings):
    """A tracker and nothing else."""

    task: ClassVar[str] = "counting"


class CountingFrames(Frames):
    """What was said."""

    answer: list[float] = []  # noqa: RUF012
    latency_ms: list[float] = []  # noqa: RUF012


class CountingRecord(Record):
    """One tracker on one series."""

    error_names: ClassVar[tuple[str, ...]] = ("count_error",)

    frames: CountingFrames


class CountingTask(Task):
    """Say the next number of a series."""

    name: ClassVar[str] = "counting"
    summary: ClassVar[str] = "say the next number of a series"
    ranked_by: ClassVar[str] = "count_error"

    manifest = CountingManifest
    record = CountingRecord
    columns = (*COMMON_COLUMNS, *number("count_error"))
    shown = (ROW, Column("count_error", "off\nby", "off by", 2, best=True))

    def open(self, folder: Path, manifest: CountingManifest, sha256: str) -> CountingDataset:
        """A dataset of series."""
        return CountingDataset(folder, manifest, sha256)

    def validate(self, dataset: CountingDataset, progress: Callable[[float], None]) -> list[str]:
        """Every file there and unaltered."""
        return check_files(dataset.path, dataset.manifest, dataset.manifest.files, progress=progress)[0]

    def complete(self, row: RowRequest, conditions: Conditions, dataset: CountingDataset) -> Settings:
        """Its tracker, and how much of the data."""
        tracker = plug("tracker", row.tracker, row.options, self.name)
        lengths = [dataset.length(unit.sequence) for unit in dataset.units()]
        return CountingSettings(row.row_id or tracker.name, tracker, conditions, row.sequences, cut(row, lengths))

    def execute(self, job: Job, dataset: CountingDataset, run: Run) -> dict[str, Any]:
        """All numbers at once."""
        values = dataset.values(job.unit.sequence)[: job.frames].tolist()
        done: dict[str, Any] = {"status": "ok", "error": None, "traceback": None, "frames": {}, "errors": {}}
        try:
            with run.child("surgbench_toy.worker", job.settings.conditions.timeout_s) as child:
                child.send(job.settings.tracker, values[0] - 1, values)
                _, answers, times = child.receive()
        except ChildProblemError as problem:
            return {**done, "status": problem.status, "error": str(problem), "traceback": problem.traceback}
        frames = {"index": list(range(len(values))), "answer": answers, "latency_ms": times}
        errors = {"count_error": np.abs(np.subtract(answers, values)).tolist()}
        return {**done, "frames": frames, "errors": errors}

    def rows(self, head: Row, records: list[Record]) -> list[Row]:
        """The mean error."""
        errors = [[record.errors["count_error"]] for record in records if record.status == "ok"]
        return [{**head, "count_error": summarise(errors).mean}]
