"""Estimates from a file, measured as a tracker's are: the file answers in the place of a tracker's process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, cast

import numpy as np

from surgbench.contract import Observation
from surgbench.errors import ConfigError, DatasetError
from surgbench.files import HASH_DIGITS
from surgbench.processes.child import Child
from surgbench.sources import engine_modules, hash_modules
from surgbench.suite.asked import Conditions, FileRequest
from surgbench.suite.running import Run
from surgbench.suite.settings import Job, Plug
from surgbench.tasks.instrument.dataset import InstrumentDataset, InstrumentUnit
from surgbench.tasks.instrument.estimates_file import ArmEstimates, EstimatesFile, read_estimates
from surgbench.tasks.instrument.execute import execute
from surgbench.tasks.instrument.plan import InstrumentSettings
from surgbench.tasks.instrument.records import ANSWER_COLUMNS, SOURCE_COLUMNS

FROM_FILE = "from file"
# Takes the place of the plug-ins that another program has instead, or has not.
UNKNOWN = "from-file"
READERS = tuple(f"{__package__}.{name}" for name in ("estimates_file", "from_file", "pose_table"))


@dataclass(frozen=True)
class FileSettings(InstrumentSettings):
    """Settings of estimates whose making is not known here."""

    def words(self) -> list[str]:
        """Marks them."""
        words = [FROM_FILE]
        if self.frames_limit is not None:
            words.append(f"first {self.frames_limit} frames")
        if self.readings != "none":
            words.append("with joint readings")
        return words


@dataclass(frozen=True)
class FileJob:
    """One unit of a file of estimates.

    Attributes:
        job: As any other.
        dataset: What it is about.
        file: All of the file.
    """

    job: Job
    dataset: InstrumentDataset
    file: EstimatesFile

    def measure(self, run: Run) -> dict[str, Any]:
        """The errors of these estimates, as a record has them (:meth:`surgbench.task.Task.execute`)."""
        assert isinstance(self.job.unit, InstrumentUnit)
        arms = [self.file.arms[self.job.unit.sequence, arm] for arm in self.job.unit.arms]
        done = execute(self.job, self.dataset, _FileRun(run, arms), waits=False)
        # Where another program's search began is not known.
        frames, errors = {**done["frames"], "start": []}, {**done["errors"], "start_lag_ms": None}
        about = {"name": self.file.name, "sha256": self.file.sha256}
        return {**done, "initialise_s": None, "frames": frames, "errors": errors, "from_file": about}


def file_jobs(dataset: InstrumentDataset, path: Path, asked: FileRequest, made_by: tuple[str, ...]) -> list[FileJob]:
    """What a file of estimates is about: a job for each unit that it has all arms of.

    Args:
        dataset: What the estimates were made on.
        path: The file.
        asked: How it is to be called and read.
        made_by: Modules that measure errors.

    Raises:
        DatasetError: The file is wrong, or has no whole unit; one line.
        ConfigError: The dataset has not what the options say.
    """
    if asked.joints and not all(sequence.entry.readings for sequence in dataset.sequences):
        raise ConfigError(f"--joints: '{dataset.name}' has no joint readings")
    arms = asked.arms or _possible_arms(dataset)
    file = read_estimates(path, dataset, asked.frames, asked.time_column)
    units = dataset.units(arms)
    lengths = [dataset.length(unit.sequence) for unit in units]
    whole = [unit for unit in units if all((unit.sequence, arm) in file.arms for arm in unit.arms)]
    if not whole:
        other = "single" if arms == "dual" else "dual"
        needs = "both arms of no sequence" if arms == "dual" else "no arm that has a mask of its own"
        raise DatasetError(f"{path}: has {needs}; try --arms {other}")
    settings = FileSettings(
        row_id=asked.name,
        tracker=Plug("tracker", path.name, asked.name, f"{FROM_FILE}@{file.sha256[:HASH_DIGITS]}", {}, {}, False),
        conditions=Conditions(arms=arms),
        sequences=None,
        frames_limit=asked.frames if any(length > (asked.frames or length) for length in lengths) else None,
        initialiser=_unknown("initialiser"),
        filter=_unknown("filter"),
        keypoints=_unknown("keypoints"),
        readings="noisy" if asked.joints else "none",
        engine=hash_modules(engine_modules((), (*made_by, *READERS))),
    )
    return [
        FileJob(
            Job(
                settings,
                dataset.name,
                dataset.hash,
                unit,
                min(dataset.length(unit.sequence), asked.frames or dataset.length(unit.sequence)),
                sum(lengths),
                0,
            ),
            dataset,
            file,
        )
        for unit in whole
    ]


def _unknown(kind: str) -> Plug:
    return Plug(kind, UNKNOWN, UNKNOWN, FROM_FILE, {}, {}, False)


def _possible_arms(dataset: InstrumentDataset) -> Literal["single", "dual"]:
    """Single arms, but for datasets that have no mask of one alone."""
    try:
        dataset.units("single")
    except DatasetError:
        return "dual"
    return "single"


class _FileRun(Run):
    """A run whose child process is a file."""

    def __init__(self, run: Run, arms: list[ArmEstimates]) -> None:
        super().__init__(run.advance, run.stage)
        self._arms = arms

    @contextmanager
    def child(self, module: str, timeout_s: float, memory: str | None = None) -> Iterator[Child]:
        yield cast("Child", _File(self._arms))  # what is asked of a child, it can do


class _File:
    """Answers the messages that a tracker's process is sent (:mod:`surgbench.tasks.instrument.worker`)."""

    def __init__(self, arms: list[ArmEstimates]) -> None:
        self._arms = arms
        self._answer: tuple[Any, ...] = ()

    def send(self, kind: str, *content: Any) -> None:
        if kind == "first":
            self._answer = ("initialised", np.concatenate([arm.states[0] for arm in self._arms]), 0.0)
        elif kind == "step":
            self._answer = ("answer", self._step(content[0]))

    def ready(self) -> tuple[Any, ...]:
        return ("ready",)

    def receive(self) -> tuple[Any, ...]:
        return self._answer

    def _step(self, observation: Observation) -> SimpleNamespace:
        """The estimate of a frame."""
        frame, arms = observation.index, self._arms
        state = np.concatenate([arm.states[frame] for arm in arms])
        told = [arm.deviations[frame] for arm in arms if arm.deviations is not None]
        known = len(told) == len(arms) and bool(np.isfinite(told).all())
        confidence = np.array([arm.confidence[frame] for arm in arms], dtype=np.float64)
        lost = np.array([arm.lost[frame] for arm in arms], dtype=bool)
        times = [float(arm.time_ms[frame]) for arm in arms if arm.time_ms is not None]
        answer = {
            "start": state,
            "state": state,
            "confidence": float(confidence.min()),
            "lost": bool(lost.any()),
            "confidence_arms": confidence if len(arms) > 1 else None,
            "lost_arms": lost if len(arms) > 1 else None,
            "standard_deviations": np.concatenate(told) if known else None,
            "latency_ms": max(times) if times else None,
        }
        return SimpleNamespace(**{**dict.fromkeys((*ANSWER_COLUMNS, *SOURCE_COLUMNS, "seen")), **answer})
