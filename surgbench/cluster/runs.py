"""Runs on a cluster: a job goes to a worker, which starts the tracker's process; its record is written here."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surgbench.cluster.connection import DEATHS, GONE, on_all_workers, threads
from surgbench.cluster.same_code import check_code, own_code
from surgbench.dataset.base import Dataset
from surgbench.dataset.open import open_dataset
from surgbench.errors import DatasetError, SurgbenchError
from surgbench.registry import absolute
from surgbench.suite.head import without_results
from surgbench.suite.perform import perform
from surgbench.suite.running import Run
from surgbench.suite.settings import Job, Plug, Settings

if TYPE_CHECKING:
    from distributed import Client, Future

# How often a worker tells how far it is.
TELL_INTERVAL_S = 1.0
# Jobs that wait for a worker here, so that a cluster may grow; each holds a file open.
LEAST_AHEAD, MOST_AHEAD = 32, 500


class ClusterRuns:
    """Where a cluster's workers do what :func:`surgbench.suite.perform.perform` does here; for one call of ``run``.

    Args:
        client: Of the cluster.
        jobs: At most so many at a time; ``None`` for as many as the cluster has threads.

    Attributes:
        jobs: At most so many are handed over at a time.
    """

    def __init__(self, client: Client, jobs: int | None = None) -> None:
        self.jobs = jobs or min(MOST_AHEAD, max(LEAST_AHEAD, 2 * threads(client)))
        self._client, self._code = client, own_code()
        self._call = uuid.uuid4().hex
        self._parts: dict[str, Run] = {}
        self._futures: set[Future[dict[str, Any]]] = set()
        client.subscribe_topic(self._call, self._hear)

    def perform(self, job: Job, dataset: Dataset[Any], part: Run) -> dict[str, Any]:
        """See :func:`surgbench.suite.perform.perform`.

        A job whose worker dies goes to another one.

        Raises:
            SurgbenchError: The dataset is at fault or not there for a worker, or the cluster is gone.
        """
        from distributed import KilledWorker

        if part.stopping:
            return without_results("failed", "stopped")
        key = f"{job.settings.row_id}-{job.unit.id}-r{job.repeat}-{uuid.uuid4().hex}"
        self._parts[key] = part
        place = str(dataset.path.resolve())
        ask = (_placed(job), place, dataset.hash, _working_folder(), self._code, self._call, key)
        future = self._client.submit(_perform, *ask, key=key, pure=False)
        self._futures.add(future)
        try:
            found: dict[str, Any] = future.result()
            return found
        except KilledWorker:
            return without_results("exited", f"{DEATHS + 1} workers of the cluster died while they ran this")
        except (CancelledError, OSError) as error:
            if part.stopping:
                return without_results("failed", "stopped")
            if isinstance(error, OSError) and self._client.status == "running":  # a worker's
                raise SurgbenchError(f"a worker of the cluster cannot run this: {error}") from None
            raise SurgbenchError(GONE) from None
        finally:
            del self._parts[key]
            self._futures.discard(future)

    def missing(self) -> str | None:
        """What is waited for; ``None`` where nothing is missing."""
        return None if threads(self._client) else "waiting for workers of the cluster"

    def stop(self) -> None:
        """End what the workers are at."""
        if self._client.status == "running":
            self._client.cancel(list(self._futures))
        on_all_workers(self._client, _stop, self._call)

    def _hear(self, event: tuple[float, dict[str, Any]]) -> None:
        said = event[1]
        part = self._parts.get(said["key"])
        if part is not None:  # less than before where a worker died and another one begins anew
            part.advance(said["done"] - part.done)


def _working_folder() -> str:
    """As seen from which files are named here."""
    return str(Path.cwd())


def _placed(job: Job) -> Job:
    """The job with files of plug-ins where they are, whatever folder the worker is in."""
    settings: Any = job.settings
    named = {one.name: getattr(settings, one.name) for one in fields(settings)}
    files = {
        name: replace(plug, reference=absolute(plug.reference))
        for name, plug in named.items()
        if isinstance(plug, Plug)
    }
    placed: Settings = replace(settings, **files)
    return replace(job, settings=placed)


# On a worker.

_under_way: dict[str, set[Run]] = {}
_lock = threading.Lock()


def _perform(job: Job, place: str, sha256: str, folder: str, code: str, call: str, key: str) -> dict[str, Any]:
    from distributed import get_worker

    check_code(code)
    dataset = _opened(place, sha256)
    if dataset.hash != sha256:
        raise DatasetError(f"{place}: another dataset lies there for the cluster's workers")
    worker, told = get_worker(), [time.monotonic()]

    def tell(frames: float) -> None:
        if time.monotonic() >= told[0] + TELL_INTERVAL_S:
            told[0] = time.monotonic()
            worker.log_event(call, {"key": key, "done": part.done})

    part = Run(tell, folder=folder)
    with _registered(call, part):
        return perform(job, dataset, part)


@lru_cache(maxsize=8)
def _opened(place: str, sha256: str) -> Dataset[Any]:
    return open_dataset(Path(place))


@contextmanager
def _registered(call: str, part: Run) -> Iterator[None]:
    with _lock:
        _under_way.setdefault(call, set()).add(part)
    try:
        yield
    finally:
        with _lock:
            _under_way[call].discard(part)
            if not _under_way[call]:
                del _under_way[call]


def _stop(call: str) -> None:
    with _lock:
        runs = list(_under_way.get(call, ()))
    for run in runs:
        run.kill()
