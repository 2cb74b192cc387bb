"""Records of estimates that another program made."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from surgbench.dataset.base import Dataset
from surgbench.files import canonical_json, write_atomic
from surgbench.records.reader import check_written
from surgbench.records.seal import sealed
from surgbench.suite.asked import FileRequest
from surgbench.suite.claim import cannot_write, claim
from surgbench.suite.environment import environment
from surgbench.suite.head import head
from surgbench.suite.run import Plan, check_output, make_plan, probe_output
from surgbench.suite.running import Run
from surgbench.suite.settings import Job
from surgbench.task import find_task


class FileScore:
    """The scoring of a file of estimates: everything of it is read before anything is written.

    Args:
        dataset: What the estimates were made on.
        path: The file.
        asked: How it is to be called and read.
        out: Folder of records.
        again: Score what is recorded already, too.

    Attributes:
        jobs: One per unit of the file.
        plan: Which of them have no record yet.

    Raises:
        SurgbenchError: The file is wrong, or the folder holds something else than records.
    """

    def __init__(self, dataset: Dataset[Any], path: Path, asked: FileRequest, out: Path, again: bool = False) -> None:
        check_output(out)
        self._dataset, self._out = dataset, out
        self._told = {one.job.hash: one for one in find_task(dataset.task).from_file(dataset, path, asked)}
        self.jobs: list[Job] = [one.job for one in self._told.values()]
        self.plan: Plan = make_plan(self.jobs, out, again=again)

    def run(self, advance: Callable[[float], None]) -> None:
        """Measure what has no record yet, and write its records.

        Args:
            advance: Takes the number of frames just done.

        Raises:
            SurgbenchError: A record cannot be written, or the dataset is at fault.
        """
        if self.plan.todo:
            probe_output(self._out)
        for job in self.plan.todo:
            path = self._out / job.path
            with claim(path) as ours:
                if ours:  # else another call is at the same file
                    done = self._told[job.hash].measure(Run(advance))
                    about = {**head(job, self._dataset), "environment": environment(), "calibration_ms": None}
                    record = sealed({**about, **done})
                    check_written(record, path)
                    try:
                        write_atomic(path, (canonical_json(record) + "\n").encode())
                    except OSError as error:
                        raise cannot_write(path, error) from None
