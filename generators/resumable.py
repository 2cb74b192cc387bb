"""Making a dataset so that it can be interrupted anywhere, and finished by the same command: for any task.

What is there already is the plan's to know: ours write with :class:`surgbench.dataset.writer.DatasetWriter`, and do
again what its ledgers do not name, or the disk does not hold as they say.
"""

from __future__ import annotations

import json
import shutil
import signal
import threading
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from surgbench.dataset.manifest import MANIFEST_NAME, MARKER_NAME
from surgbench.dataset.open import read_manifest
from surgbench.dataset.storage import storage_error
from surgbench.dataset.writer import SCRATCH_NAME, remove_ledgers
from surgbench.errors import ConfigError, DatasetError, SurgbenchError
from surgbench.files import PARTIAL_SUFFIX, write_atomic
from surgbench.generation import GenerationPlan, Workers
from surgbench.leftovers import without_leftovers
from surgbench.locks import sole_writer
from surgbench.processes.pool import ProcessPool

# A file takes at least a block of the disk.
BLOCK_BYTES = 4096
# What the manifest says of a file, and the ledgers as long as it does not.
LISTED_BYTES_PER_FILE = 2 * 160


def generate(
    plan: GenerationPlan,
    out: Path,
    *,
    workers: Workers | None = None,
    say: Callable[[str], None] = lambda line: None,
    progress: Callable[[float], None] = lambda frames: None,
) -> bool:
    """Make a dataset, or finish one that was interrupted.

    Args:
        plan: What to make.
        out: The dataset's folder: new, empty, or one where the same generation was interrupted.
        workers: Who does the work; ``None`` for this process alone. The bytes do not depend on it.
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
            manifest = plan.write(out, workers or ProcessPool(), progress)
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


def in_this_process(workers: Workers) -> bool:
    """Whether the work may be done here: one thing at a time, and Ctrl-C ends it with an exception.

    Mitsuba catches the signal too, and hands back an unfinished image as if it were whole.
    """
    if workers.elsewhere or workers.jobs > 1:
        return False
    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    return threading.current_thread() is threading.main_thread() and not ignored
