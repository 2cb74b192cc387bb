"""Making a dataset so that it can be interrupted anywhere, and finished by the same command: for any task.

What is there already is the plan's to know: ours write with :class:`surgbench.dataset.writer.DatasetWriter`, and do
again what its ledgers do not name, or the disk does not hold as they say.
"""

from __future__ import annotations

import ctypes
import json
import shutil
import signal
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from surgbench.dataset.manifest import MANIFEST_NAME, MARKER_NAME
from surgbench.dataset.open import read_manifest
from surgbench.dataset.storage import storage_error
from surgbench.dataset.writer import SCRATCH_NAME, remove_ledgers
from surgbench.errors import ConfigError, DatasetError, SurgbenchError
from surgbench.files import PARTIAL_SUFFIX, write_atomic
from surgbench.generation import GenerationPlan
from surgbench.leftovers import without_leftovers
from surgbench.locks import sole_writer
from surgbench.processes.interruption import without_ctrl_c

# A file takes at least a block of the disk.
BLOCK_BYTES = 4096
# What the manifest says of a file, and the ledgers as long as it does not.
LISTED_BYTES_PER_FILE = 2 * 160


def generate(
    plan: GenerationPlan,
    out: Path,
    *,
    jobs: int = 1,
    say: Callable[[str], None] = lambda line: None,
    progress: Callable[[float], None] = lambda frames: None,
) -> bool:
    """Make a dataset, or finish one that was interrupted.

    Args:
        plan: What to make.
        out: The dataset's folder: new, empty, or one where the same generation was interrupted.
        jobs: Worker processes. The bytes do not depend on it.
        say: Takes a line about what is going to be done.
        progress: Takes the number of frames just done.

    Returns:
        ``False`` if the dataset was complete already and nothing was done.

    Raises:
        ConfigError: The preset asks for what cannot be found.
        DatasetError: The folder holds something else or the same dataset with files missing, or another process is at
            work in it.
        SurgbenchError: The disk lacks room, before or during the work, or a worker died.
    """
    _refuse_other_content(plan, out)
    if _is_complete(out):
        return False
    fresh = not out.exists() or not any(without_leftovers(out.iterdir()))
    done = {path for path in plan.paths if (out / path).is_file()} if out.is_dir() else set()
    planned = _check_disk(plan, out, len(done) / len(plan.paths))
    try:
        with sole_writer(out, "generate"):
            _remove_partial(out)
            write_atomic(out / MARKER_NAME, json.dumps(plan.marker, sort_keys=True, indent=1).encode())
            say(planned)  # not before something could be written there
            manifest = plan.write(out, jobs, progress)
            _remove_partial(out)
            write_atomic(out / MANIFEST_NAME, manifest.to_bytes())
            _remove_marker(out)
    except ConfigError:
        # These settings can never be finished.
        if fresh:
            shutil.rmtree(out, ignore_errors=True)
        raise
    except OSError as error:
        raise storage_error(error, out, "run the same command again, it goes on from here") from None
    except BrokenProcessPool:
        raise SurgbenchError(
            f"{out}: a worker process was killed (out of memory?); "
            "run the same command again, with fewer --jobs, to go on"
        ) from None
    return True


def configuration(plan: GenerationPlan) -> dict[str, Any]:
    """What the manifest says of how the dataset was made."""
    return {key: value for key, value in plan.marker.items() if key != "format"}


def blocks(size: float) -> int:
    """A size in bytes, rounded up to whole blocks of the disk."""
    return -(-int(size) // BLOCK_BYTES) * BLOCK_BYTES


def _refuse_other_content(plan: GenerationPlan, out: Path) -> None:
    """Raise unless the folder is missing, empty, or holds this very dataset, whole or in part."""
    if not out.exists():
        return
    if not out.is_dir():
        raise DatasetError(f"{out}: is a file; --out needs a new or empty folder")
    entries = sorted(path.name for path in without_leftovers(out.iterdir()) if not path.name.endswith(PARTIAL_SUFFIX))
    if not entries:
        return
    if MANIFEST_NAME in entries:
        manifest, _ = read_manifest(out)
        if manifest.configuration != configuration(plan):
            raise DatasetError(
                f"{out}: holds another dataset ('{manifest.name}', other settings); choose another --out"
            )
        return
    marker = out / MARKER_NAME
    if not marker.is_file():
        raise DatasetError(f"{out}: holds something else ('{entries[0]}'); --out needs a new or empty folder")
    try:
        same = json.loads(marker.read_bytes()) == plan.marker
    except ValueError:
        raise DatasetError(f"{marker}: damaged; delete the folder {out} and start again") from None
    if not same:
        raise DatasetError(
            f"{out}: an unfinished dataset with other settings lies here; choose another --out or delete it"
        )
    expected = {*plan.paths, MARKER_NAME}
    for path in sorted(without_leftovers(out.rglob("*"), out)):
        name = path.relative_to(out).as_posix()
        scratch = name.startswith(f"{SCRATCH_NAME}/")
        if path.is_file() and name not in expected and not scratch and not name.endswith(PARTIAL_SUFFIX):
            raise DatasetError(f"{path}: does not belong to this dataset; move it away, or choose another --out")


def _is_complete(out: Path) -> bool:
    """Whether the dataset was finished; raises if files of it are no longer there."""
    if not (out / MANIFEST_NAME).is_file():
        return False
    manifest, _ = read_manifest(out)
    for name, entry in manifest.files.items():
        path = out / name
        size = path.stat().st_size if path.is_file() else None
        if size != entry.bytes:
            state = "missing from" if size is None else f"{size} instead of {entry.bytes} bytes in"
            raise DatasetError(
                f"{path}: {state} a finished dataset; see 'surgbench validate {out}', or choose another --out"
            )
    # Killed between the manifest and the last step.
    _remove_marker(out)
    return True


def _check_disk(plan: GenerationPlan, out: Path, share_done: float) -> str:
    """A line that says what is going to be made; raises where there is no room for it."""
    parent = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.is_dir())
    free = shutil.disk_usage(parent).free
    need = int(plan.disk_bytes * (1.0 - share_done))
    resumed = f", {share_done:.0%} of its files are there already" if share_done else ""
    if free < need:
        raise SurgbenchError(
            f"{out}: the disk has {free / 1e6:.0f} MB free but {need / 1e6:.0f} MB are needed; "
            "make room, choose another --out, or fewer --sequences or --frames"
        )
    return f"{plan.name}: {plan.counts}, about {plan.disk_bytes / 1e6:.0f} MB{resumed}; {free / 1e6:.0f} MB free"


def _remove_marker(out: Path) -> None:
    if (out / MARKER_NAME).exists():  # else a folder of that name is not ours
        remove_ledgers(out)
        (out / MARKER_NAME).unlink()


def _remove_partial(out: Path) -> None:
    for path in out.rglob(f"*{PARTIAL_SUFFIX}"):
        path.unlink(missing_ok=True)


def ctrl_c_raises() -> bool:
    """Whether Ctrl-C ends this thread's work with an exception; only then may it render.

    Mitsuba catches the signal too, and hands back an unfinished image as if it were whole.
    """
    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    return threading.current_thread() is threading.main_thread() and not ignored


def in_workers(
    tasks: Iterable[Any],
    do: Callable[[Any], int],
    jobs: int,
    start: Callable[..., None],
    arguments: tuple[Any, ...],
    progress: Callable[[float], None],
) -> None:
    """Do tasks in worker processes.

    Args:
        tasks: In order; few are drawn ahead of the work.
        do: Does one, in a worker; returns what ``progress`` is to take.
        jobs: Worker processes.
        start: Prepares a worker: takes ``arguments`` and a shared ``ctypes.c_bool``; once that is true, no new work is
            to begin.
        arguments: For ``start``.
        progress: Takes how much was just done.

    Raises:
        BrokenProcessPool: A worker was killed.
        Exception: What ``start`` or ``do`` raised.
    """
    jobs = max(1, jobs)
    context = get_context("spawn")
    # Without a lock, which a killed worker could take along.
    stop = context.RawValue(ctypes.c_bool, False)
    prepare = (start, *arguments, stop)
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=_prepare, initargs=prepare) as pool:
        waiting: set[Future[int]] = set()
        try:
            for task in tasks:
                # Few at a time, so that the states of a long dataset are not all held at once.
                while len(waiting) >= 2 * jobs:
                    waiting = _collect(waiting, progress)
                # Workers start in here, and keep the block.
                with without_ctrl_c():
                    waiting.add(pool.submit(_work, do, task))
            while waiting:
                waiting = _collect(waiting, progress)
        except BaseException:
            stop.value = True
            pool.shutdown(wait=True, cancel_futures=True)
            raise


# What kept this worker from being prepared: told with its first task, for a pool that breaks says nothing of it.
_unprepared: Exception | None = None


def _prepare(start: Callable[..., None], *arguments: Any) -> None:
    global _unprepared
    try:
        start(*arguments)
    except Exception as error:
        _unprepared = error


def _work(do: Callable[[Any], int], task: Any) -> int:
    if _unprepared is not None:
        raise _unprepared
    return do(task)


def _collect(waiting: set[Future[int]], progress: Callable[[float], None]) -> set[Future[int]]:
    done, rest = wait(waiting, return_when=FIRST_COMPLETED)
    for future in done:
        progress(future.result())
    return rest
