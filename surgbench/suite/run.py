"""Run what is planned and not there yet, several at a time, and write every record as soon as it is made.

Several calls at once into one folder share the work: a job that another one is at is left to it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NamedTuple

from surgbench.dataset.base import Dataset
from surgbench.errors import DatasetError, SurgbenchError
from surgbench.files import MOST_JSON_BYTES, PARTIAL_SUFFIX, canonical_json, read_whole, write_atomic
from surgbench.leftovers import without_leftovers
from surgbench.locks import LOCK_SUFFIX
from surgbench.records.format import FORMATS, SKIPPED
from surgbench.records.reader import check_written
from surgbench.records.seal import check_seal, sealed
from surgbench.suite.claim import cannot_write, claim, tidy
from surgbench.suite.head import head, skipped
from surgbench.suite.perform import Workplace
from surgbench.suite.running import Run
from surgbench.suite.settings import Job
from surgbench.syntax import parse_json

# Between two looks at what other calls are at.
LOOK_AGAIN_S = 0.5
# And at whether there is anybody to do the work.
LOOK_FOR_WORKERS_S = 5.0


class Stamp(NamedTuple):
    """What tells a file from the one that replaces it."""

    inode: int
    modified_ns: int


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
        before: Of jobs among ``todo``, by their paths, which file was there when this was planned.
    """

    todo: tuple[Job, ...]
    done: int
    retried: int
    again: int
    skipped: int
    before: Mapping[str, Stamp]

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
    ours = {"leaderboard.csv", "leaderboard.md", "leaderboard.json"}
    passing = (PARTIAL_SUFFIX, LOCK_SUFFIX)
    names = sorted(path.name for path in without_leftovers(out.iterdir()) if path.is_file())
    strangers = [name for name in names if name not in ours and not name.endswith(passing)]
    if strangers:
        raise SurgbenchError(f"{out}: holds something else ('{strangers[0]}'); records need a folder of their own")


def _write(path: Path, data: bytes) -> None:
    try:
        write_atomic(path, data)
    except OSError as error:
        raise cannot_write(path, error) from None


def probe_output(out: Path) -> None:
    """Make the output folder, and see before the work that a record can be written there.

    Raises:
        SurgbenchError: It cannot.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=out) as probe:  # without a name, so that nothing is left where this process is killed
            probe.write(bytes(1 << 16))
            probe.flush()
    except OSError as error:
        raise cannot_write(out, error) from None


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
    todo, before, done, retried, replaced = [], {}, 0, 0, 0
    for job in {job.hash: job for job in jobs}.values():  # each once, however often it is asked for
        path = out / job.path
        stamp = _stamp(path)  # before it is read: what replaces it meanwhile is another one
        record = None if again else _recorded(path, job)
        if record is not None and (record["status"] == "ok" or not retry_failed):
            done += 1
            tidy(path)
            continue
        todo.append(job)
        if stamp is not None:
            before[job.path] = stamp
            replaced += again
        retried += record is not None and record["status"] != SKIPPED and job.settings.unavailable is None
    skipped = sum(job.settings.unavailable is not None for job in todo)
    return Plan(tuple(todo), done, retried, replaced, skipped, before)


def _stamp(path: Path) -> Stamp | None:
    """Of the file that is there now; ``None`` where there is none."""
    try:
        found = path.stat()
    except OSError:  # nothing there, or nowhere to look
        return None
    return Stamp(found.st_ino, found.st_mtime_ns)


def _recorded(path: Path, job: Job) -> dict[str, Any] | None:
    """A job's record; ``None`` where there is none."""
    try:
        record: dict[str, Any] = parse_json(read_whole(path, MOST_JSON_BYTES))
        if record["format"] in FORMATS:
            check_seal(record, path)
            if record["spec_hash"] == job.hash and record["status"]:
                return record
    except (FileNotFoundError, NotADirectoryError):
        return None  # nothing there, or nowhere to write, which is noticed before the work
    except (OSError, ValueError, KeyError, TypeError):
        raise DatasetError(f"{path}: damaged record; delete it, or run with --again") from None
    raise DatasetError(f"{path}: record of another run; choose another --out")


def run(
    plan: Plan,
    dataset: Dataset[Any],
    out: Path,
    where: Workplace,
    under_way: Run,
    finished: Callable[[dict[str, Any]], None],
) -> int:
    """Run the plan's jobs.

    What another process is at is left to it, and looked at again when all else is done: if it has come to nothing
    there, it is run here.

    Args:
        plan: From :func:`make_plan`.
        dataset: The dataset all jobs are about.
        out: Folder of records.
        where: Where jobs are done, and how many at a time.
        under_way: Is told how far they are.
        finished: Called with every record once it is written.

    Returns:
        How many of the records another process has made.

    Raises:
        SurgbenchError: A record cannot be written, or could not be read again, or the dataset is at fault; runs in
            work are ended.
    """

    def make(job: Job) -> dict[str, Any] | None:
        unavailable = job.settings.unavailable
        if unavailable is not None:
            done = skipped(unavailable)
        else:
            part = under_way.part()
            done = where.perform(job, dataset, part)
            if under_way.stopping:
                return None
            part.advance(job.frames - part.done)  # what a failed run never reached
        record = sealed({**head(job, dataset), **done})
        check_written(record, out / job.path)
        _write(out / job.path, (canonical_json(record) + "\n").encode())
        return record

    def one(job: Job) -> _Outcome:
        if under_way.stopping:
            return _Outcome(job, None)
        path = out / job.path
        try:
            with claim(path) as ours:
                if not ours:
                    return _Outcome(job, None)
                if _stamp(path) in (None, plan.before.get(job.path)):
                    return _Outcome(job, make(job))
                record = _recorded(path, job)  # by another process, since this was planned
            if job.settings.unavailable is None:
                under_way.advance(job.frames)
            return _Outcome(job, record, elsewhere=True)
        except BaseException:
            under_way.stop()  # before this thread takes the next job
            raise

    told: list[str] = []

    def tell_of_missing() -> None:
        missing = where.missing()
        for words in told:
            if words != missing:
                under_way.stage(words, 1.0)
        told[:] = [] if missing is None else [missing]
        if missing is not None:
            under_way.stage(missing, 0.0)

    elsewhere = 0
    with ThreadPoolExecutor(max_workers=where.jobs) as pool:
        waiting: set[Future[_Outcome]] = {pool.submit(one, job) for job in plan.todo}
        left: list[Job] = []
        try:
            while waiting:
                ended, waiting = wait(waiting, timeout=LOOK_FOR_WORKERS_S, return_when=FIRST_COMPLETED)
                tell_of_missing()
                for future in ended:
                    outcome = future.result()
                    if outcome.record is None:
                        left.append(outcome.job)
                    else:
                        elsewhere += outcome.elsewhere
                        finished(outcome.record)
                if left and not waiting and not under_way.stopping:
                    under_way.stage("waiting for another call's runs", 0.0)
                    time.sleep(LOOK_AGAIN_S)
                    waiting, left = {pool.submit(one, job) for job in left}, []
            under_way.stage("waiting for another call's runs", 1.0)
        except BaseException:
            # Ctrl-C or a fault: what is in work ends now, what is written stays.
            under_way.stop()
            for future in waiting:
                future.cancel()
            under_way.kill()
            where.stop()
            raise
    return elsewhere


@dataclass(frozen=True)
class _Outcome:
    """What came of a job: its record, or none where it is left to another process or the run is being stopped."""

    job: Job
    record: dict[str, Any] | None
    elsewhere: bool = False
