"""What runs will take, told before they are begun: from records of the same settings, or from a short piece of one."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np

from surgbench.dataset.base import Dataset
from surgbench.errors import SurgbenchError
from surgbench.files import canonical_json
from surgbench.records.reader import read_record
from surgbench.suite.perform import perform
from surgbench.suite.running import Run
from surgbench.suite.settings import Job

# So long a run is watched once its first frame is done.
WATCH_S = 3.0
# Records of one row that are looked at.
LOOKED_AT = 8


@dataclass(frozen=True)
class Rate:
    """What runs of one row take.

    Attributes:
        start_s: Seconds before the first frame is done.
        frame_s: Seconds for each frame, errors included.
        frame_bytes: Of its record, for each frame.
        known_from: Earlier records, or a measurement.
        problem: Why nothing is known, one line; ``None`` where it is.
    """

    start_s: float = 0.0
    frame_s: float = 0.0
    frame_bytes: float = 0.0
    known_from: Literal["records", "measured"] = "measured"
    problem: str | None = None


@dataclass(frozen=True)
class Forecast:
    """What the runs of one row will take.

    Attributes:
        row_id: Its name.
        runs: How many.
        frames: Over all of them.
        rate: What it is reckoned from.
        longest_s: The longest of the runs.
    """

    row_id: str
    runs: int
    frames: int
    rate: Rate
    longest_s: float

    @property
    def seconds(self) -> float:
        """One run after the other."""
        return self.runs * self.rate.start_s + self.frames * self.rate.frame_s

    @property
    def size_bytes(self) -> float:
        """Disk for the records."""
        return self.frames * self.rate.frame_bytes


def by_row(jobs: Iterable[Job]) -> Mapping[str, Sequence[Job]]:
    """Jobs that can be done here, those of one row and settings together."""
    found: dict[str, list[Job]] = {}
    for job in jobs:
        if job.settings.unavailable is None:
            found.setdefault(job.settings.hash, []).append(job)
    return found


def forecasts(rows: Mapping[str, Sequence[Job]], dataset: Dataset[Any], out: Path) -> Iterator[Forecast]:
    """Work out what each row will take, one after the other; what is measured takes seconds.

    Args:
        rows: From :func:`by_row`.
        dataset: What all of it is about.
        out: Where records of earlier runs are looked for.
    """
    for jobs in rows.values():
        rate = recorded_rate(jobs[0], out) or measured_rate(jobs[0], dataset)
        longest = rate.start_s + max(job.frames for job in jobs) * rate.frame_s
        yield Forecast(jobs[0].settings.row_id, len(jobs), sum(job.frames for job in jobs), rate, longest)


def seconds_in_all(rows: Sequence[Forecast], jobs: int) -> float:
    """How long all rows take with so many jobs at a time: never less than the longest run."""
    return max(sum(row.seconds for row in rows) / jobs, max((row.longest_s for row in rows), default=0.0))


def recorded_rate(job: Job, out: Path) -> Rate | None:
    """What sound records of a job's row say; ``None`` where there are none that say how long they took."""
    seconds, frames, size = 0.0, 0, 0
    for path in sorted((out / job.path).parent.glob("*-r*.json"))[:LOOKED_AT]:
        try:
            record = read_record(path)
        except SurgbenchError:  # told where it is used
            continue
        if record is not None and record.status == "ok" and record.elapsed_s is not None and record.frames.index:
            seconds += record.elapsed_s
            frames += len(record.frames.index)
            size += path.stat().st_size
    return Rate(0.0, seconds / frames, size / frames, "records") if frames else None


def measured_rate(job: Job, dataset: Dataset[Any]) -> Rate:
    """What the beginning of a run takes, for :data:`WATCH_S` seconds after its first frame. No record is written."""
    began = time.monotonic()
    marks: list[tuple[float, float]] = []

    def mark(frames: float) -> None:
        if frames > 0:
            marks.append((time.monotonic(), part.done))
        if marks and marks[-1][0] - marks[0][0] > WATCH_S:
            part.kill()

    part = Run(mark)
    done = perform(job, dataset, part)
    ended = time.monotonic()
    if not marks or (done["status"] != "ok" and not part.stopping):
        return Rate(problem=done["error"])
    gaps = [(after - before) / (more - less) for (before, less), (after, more) in pairwise(marks)]
    # The middle one: the first frames may compile.
    frame_s = float(np.median(gaps)) if gaps else 0.0
    frame_s += (ended - marks[-1][0]) / part.done
    return Rate(marks[0][0] - began, frame_s, len(canonical_json(done)) / part.done)
