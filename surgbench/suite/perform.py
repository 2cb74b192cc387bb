"""One job, from beginning to end, on the machine that it is done on."""

from __future__ import annotations

import time
from typing import Any, Protocol

from surgbench.dataset.base import Dataset
from surgbench.suite.environment import environment
from surgbench.suite.plug import edited
from surgbench.suite.running import Run
from surgbench.suite.settings import Job
from surgbench.task import find_task


class Workplace(Protocol):
    """Where jobs are done: on this machine, or on a cluster's."""

    @property
    def jobs(self) -> int:
        """At most so many at a time."""
        ...

    def perform(self, job: Job, dataset: Dataset[Any], part: Run) -> dict[str, Any]:
        """See :func:`perform`."""
        ...

    def missing(self) -> str | None:
        """What is waited for, a few words; ``None`` where nothing is missing."""
        ...

    def stop(self) -> None:
        """End what goes on elsewhere; what goes on here, :meth:`surgbench.suite.running.Run.kill` ends."""
        ...


class ThisMachine:
    """Jobs are done here, in processes of their own.

    Args:
        jobs: So many at a time.
    """

    def __init__(self, jobs: int = 1) -> None:
        self.jobs = jobs

    def perform(self, job: Job, dataset: Dataset[Any], part: Run) -> dict[str, Any]:
        """See :func:`perform`."""
        return perform(job, dataset, part)

    def missing(self) -> None:
        """Nothing."""

    def stop(self) -> None:
        """Nothing goes on elsewhere."""


def perform(job: Job, dataset: Dataset[Any], part: Run) -> dict[str, Any]:
    """Do a job.

    Args:
        job: One that can be done on this machine.
        dataset: What it is to be done on.
        part: Gives child processes, and is told how far the job is.

    Returns:
        What a record holds of it besides what is known before: what :meth:`surgbench.task.Task.execute` returns,
        ``environment``, ``calibration_ms``, and the ``elapsed_s`` from its beginning to its end.

    Raises:
        SurgbenchError: The dataset is at fault.
    """
    began = time.monotonic()
    done = find_task(dataset.task).execute(job, dataset, part)
    change = edited(job.settings.plugs)
    if change is not None:  # the record would be that of a text that nobody has run
        done = {**done, "status": "failed", "error": change}
    return {
        "environment": environment(job.settings.conditions.device),
        "calibration_ms": part.calibration_ms,
        "elapsed_s": time.monotonic() - began,
        **done,
    }
