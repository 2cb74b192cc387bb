"""Run what is planned and not there yet, several at a time, and write every record as soon as it is made."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surgbench.dataset.reader import Dataset
from surgbench.errors import DatasetError, SurgbenchError
from surgbench.files import PARTIAL_SUFFIX, canonical_json, write_atomic
from surgbench.report.records import RECORD_FORMAT, SKIPPED
from surgbench.suite.child import Child
from surgbench.suite.environment import environment
from surgbench.suite.execute import execute
from surgbench.suite.head import skipped
from surgbench.suite.plan import Job

if TYPE_CHECKING:
    from surgbench.dataset.open import AnyDataset


@dataclass(frozen=True)
class Plan:
    """What a call of ``run`` will do.

    Attributes:
        todo: Jobs without a sound record, those that this machine cannot run among them.
        done: Number of jobs whose record is there already.
        retried: Number of jobs among ``todo`` whose record says that they failed.
        skipped: Number of jobs among ``todo`` that this machine cannot run.
    """

    todo: tuple[Job, ...]
    done: int
    retried: int
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


def make_plan(jobs: list[Job], out: Path, retry_failed: bool = True) -> Plan:
    """Sort jobs by what is already there.

    Raises:
        DatasetError: A record is damaged, or is of another run.
    """
    todo, done, retried = [], 0, 0
    for job in {job.hash: job for job in jobs}.values():  # each once, however often it is asked for
        status = _recorded_status(out / job.path, job)
        if status is None or (status != "ok" and retry_failed):
            todo.append(job)
            retried += status not in (None, SKIPPED) and job.settings.unavailable is None
        else:
            done += 1
    return Plan(tuple(todo), done, retried, sum(job.settings.unavailable is not None for job in todo))


def _recorded_status(path: Path, job: Job) -> str | None:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if record["format"] == RECORD_FORMAT and record["spec_hash"] == job.hash:
            return str(record["status"])
    except (FileNotFoundError, NotADirectoryError):
        return None  # nothing there, or nowhere to write, which is noticed before the work
    except (OSError, ValueError, KeyError, TypeError):
        raise DatasetError(f"{path}: damaged record; delete it and run again") from None
    raise DatasetError(f"{path}: record of another run; choose another --out")


def run(
    plan: Plan,
    dataset: AnyDataset,
    out: Path,
    workers: int,
    advance: Callable[[float], None],
    stage: Callable[[str, float], None],
    finished: Callable[[dict[str, Any]], None],
) -> None:
    """Run the plan's jobs.

    Args:
        plan: From :func:`make_plan`.
        dataset: The dataset all jobs are about.
        out: Folder of records.
        workers: Jobs at a time.
        advance: Called with the frames done since.
        stage: Called with a description and a fraction while an initialiser works.
        finished: Called with every record once it is written.

    Raises:
        SurgbenchError: A record cannot be written, or the dataset is at fault; runs in work are ended.
    """
    children: set[Child] = set()
    stopping = threading.Event()

    def written(job: Job, record: dict[str, Any]) -> dict[str, Any]:
        _write(out / job.path, (canonical_json(record) + "\n").encode())
        return record

    def one(job: Job) -> dict[str, Any] | None:
        if stopping.is_set():
            return None
        where = environment(job.settings.protocol.device)
        unavailable = job.settings.unavailable
        label = f"{job.settings.row_id} {job.unit.id}: finding the instrument"
        frames_done = 0.0

        def count(amount: float) -> None:
            nonlocal frames_done
            frames_done += amount
            advance(amount)

        try:
            if unavailable is not None:
                return written(job, skipped(job, dataset, where, unavailable))
            if job.settings.task == "viewpoint":
                from surgbench.viewpoint.execute import execute_viewpoint

                record = execute_viewpoint(job, dataset, where, count, children, stopping)
            else:
                assert isinstance(dataset, Dataset)
                record = execute(
                    job, dataset, where, count, lambda fraction: stage(label, fraction), children, stopping
                )
            if stopping.is_set():
                return None
            advance(job.frames - frames_done)
            return written(job, record)
        except BaseException:
            stopping.set()  # before this thread takes the next job
            raise

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
            stopping.set()
            for future in waiting:
                future.cancel()
            for child in list(children):
                child.kill()
            raise
