"""Run what is planned and not there yet, several at a time, and write every record as soon as it is made."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgbench.dataset.base import Dataset
from surgbench.errors import DatasetError, SurgbenchError
from surgbench.files import PARTIAL_SUFFIX, canonical_json, write_atomic
from surgbench.records.format import FORMATS, SKIPPED
from surgbench.records.reader import check_written
from surgbench.records.seal import check_seal, sealed
from surgbench.suite.environment import environment
from surgbench.suite.head import head, skipped
from surgbench.suite.running import Run
from surgbench.suite.settings import Job
from surgbench.task import find_task


@dataclass(frozen=True)
class Plan:
    """What a call of ``run`` will do.

    Attributes:
        todo: Jobs without a sound record, or all where they are run again; those that this machine cannot run among
            them.
        done: Number of jobs whose record is there already.
        retried: Number of jobs among ``todo`` whose record says that they failed.
        again: Number of jobs among ``todo`` whose record is there and is replaced.
        skipped: Number of jobs among ``todo`` that this machine cannot run.
    """

    todo: tuple[Job, ...]
    done: int
    retried: int
    again: int
    skipped: int

    @property
    def frames(self) -> int:
        """Frames to be tracked."""
        return sum(job.frames for job in self.todo if job.settings.unavailable is None)


def check_output(out: Path) -> None:
    """Refuse an output folder that holds something else than records.

    Raises:
        SurgbenchError: It is a file, a dataset, or a folder of other things.
    """
    if not out.exists():
        return
    if not out.is_dir():
        raise SurgbenchError(f"{out}: is a file; --out names a folder for records")
    if (out / "dataset.json").exists() or (out / "generating.json").exists():
        raise SurgbenchError(f"{out}: is a dataset; give records a folder of their own with --out")
    strangers = sorted(path.name for path in out.iterdir() if path.is_file() and not path.name.endswith(PARTIAL_SUFFIX))
    ours = {"leaderboard.csv", "leaderboard.md", "leaderboard.json"}
    strangers = [name for name in strangers if name not in ours]
    if strangers:
        raise SurgbenchError(f"{out}: holds something else ('{strangers[0]}'); records need a folder of their own")


def _write(path: Path, data: bytes) -> None:
    try:
        write_atomic(path, data)
    except OSError as error:
        raise SurgbenchError(
            f"{path}: cannot be written ({error.strerror}); mend that, then run the same command again"
        ) from None


def probe_output(out: Path) -> None:
    """Make the output folder, and see before the work that a record can be written there.

    Raises:
        SurgbenchError: It cannot.
    """
    probe = out / f"probe{PARTIAL_SUFFIX}"
    _write(probe, bytes(1 << 16))
    probe.unlink()


def make_plan(jobs: list[Job], out: Path, retry_failed: bool = True, again: bool = False) -> Plan:
    """Sort jobs by what is already there.

    Args:
        jobs: What is asked for.
        out: Folder of records.
        retry_failed: Failed runs are tried again.
        again: All are run again, whatever is there, be it damaged.

    Raises:
        DatasetError: A record is damaged or altered, or is of another run.
    """
    todo, done, retried, replaced = [], 0, 0, 0
    for job in {job.hash: job for job in jobs}.values():  # each once, however often it is asked for
        if again:
            todo.append(job)
            replaced += (out / job.path).exists()
            continue
        status = _recorded_status(out / job.path, job)
        if status is None or (status != "ok" and retry_failed):
            todo.append(job)
            retried += status not in (None, SKIPPED) and job.settings.unavailable is None
        else:
            done += 1
    return Plan(tuple(todo), done, retried, replaced, sum(job.settings.unavailable is not None for job in todo))


def _recorded_status(path: Path, job: Job) -> str | None:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if record["format"] in FORMATS:
            check_seal(record, path)
            if record["spec_hash"] == job.hash:
                return str(record["status"])
    except (FileNotFoundError, NotADirectoryError):
        return None  # nothing there, or nowhere to write, which is noticed before the work
    except (OSError, ValueError, KeyError, TypeError):
        raise DatasetError(f"{path}: damaged record; delete it, or run with --again") from None
    raise DatasetError(f"{path}: record of another run; choose another --out")


def run(
    plan: Plan,
    dataset: Dataset[Any],
    out: Path,
    workers: int,
    under_way: Run,
    finished: Callable[[dict[str, Any]], None],
) -> None:
    """Run the plan's jobs.

    Args:
        plan: From :func:`make_plan`.
        dataset: The dataset all jobs are about.
        out: Folder of records.
        workers: Jobs at a time.
        under_way: Is told how far they are.
        finished: Called with every record once it is written.

    Raises:
        SurgbenchError: A record cannot be written, or could not be read again, or the dataset is at fault; runs in
            work are ended.
    """
    task = find_task(dataset.task)

    def one(job: Job) -> dict[str, Any] | None:
        if under_way.stopping:
            return None
        try:
            unavailable = job.settings.unavailable
            if unavailable is not None:
                done = skipped(unavailable)
            else:
                part = under_way.part()
                done = task.execute(job, dataset, part)
                if under_way.stopping:
                    return None
                part.advance(job.frames - part.done)  # what a failed run never reached
            record = sealed({**head(job, dataset, environment(job.settings.conditions.device)), **done})
            check_written(record, out / job.path)
            _write(out / job.path, (canonical_json(record) + "\n").encode())
        except BaseException:
            under_way.stop()  # before this thread takes the next job
            raise
        return record

    with ThreadPoolExecutor(max_workers=workers) as pool:
        waiting: set[Future[dict[str, Any] | None]] = {pool.submit(one, job) for job in plan.todo}
        try:
            while waiting:
                ended, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in ended:
                    record = future.result()
                    if record is not None:
                        finished(record)
        except BaseException:
            # Ctrl-C or a fault: what is in work ends now, what is written stays.
            under_way.stop()
            for future in waiting:
                future.cancel()
            under_way.kill()
            raise
