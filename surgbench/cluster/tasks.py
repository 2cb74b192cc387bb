"""Tasks of a generation on a cluster: a worker does them in a process of its own, which it keeps for the next."""

from __future__ import annotations

import math
import threading
import uuid
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError
from typing import TYPE_CHECKING, Any

from surgbench.cluster.connection import DEATHS, GONE, on_all_workers, threads
from surgbench.cluster.same_code import check_code, own_code
from surgbench.errors import SurgbenchError
from surgbench.processes.child import Child, ChildProblemError

if TYPE_CHECKING:
    from distributed import Client, Future

CHILD = "surgbench.cluster.task_child"
# A prepared process that nothing is asked of ends after so long: the command may have been killed.
IDLE_S = 60.0


class ClusterWorkers:
    """The cluster's part of :class:`surgbench.generation.Workers`.

    Args:
        client: Of the cluster.
        jobs: At most so many tasks at a time; ``None`` for as many as the cluster has threads.
    """

    elsewhere = True

    def __init__(self, client: Client, jobs: int | None = None) -> None:
        self._client, self._most = client, jobs

    @property
    def jobs(self) -> int:
        """How many tasks at a time, as of now."""
        return self._most or max(1, threads(self._client))

    def do(
        self,
        tasks: Iterable[Any],
        do: Callable[[Any], int],
        start: Callable[..., None],
        arguments: tuple[Any, ...],
        progress: Callable[[float], None],
    ) -> None:
        """Do tasks; see :meth:`surgbench.generation.Workers.do`. One whose worker dies is done by another.

        Raises:
            SurgbenchError: The cluster is gone, or tasks end its workers.
            Exception: What ``start`` or ``do`` raised.
        """
        from distributed import KilledWorker

        call, code = uuid.uuid4().hex, own_code()
        waiting: deque[Future[int]] = deque()
        try:
            for task in tasks:
                while len(waiting) >= (self._most or 2 * self.jobs):
                    progress(waiting.popleft().result())
                key = f"{do.__module__.rpartition('.')[2]}-{uuid.uuid4().hex}"
                ask = (task, do, start, arguments, code, call)
                waiting.append(self._client.submit(_do, *ask, key=key, pure=False))
            while waiting:
                progress(waiting.popleft().result())
        except KilledWorker:
            raise SurgbenchError(
                f"{DEATHS + 1} workers of the cluster died over one task (out of memory?); see what they say, "
                "then run the same command again, it goes on from here"
            ) from None
        except (CancelledError, OSError) as error:
            if isinstance(error, OSError) and self._client.status == "running":
                raise  # a worker's: a full disk, say
            raise SurgbenchError(GONE) from None
        finally:
            if self._client.status == "running":
                self._client.cancel(list(waiting))
            on_all_workers(self._client, _end, call)


# On a worker.

_idle: dict[str, list[Child]] = {}
_busy: dict[str, set[Child]] = {}
_lock = threading.Lock()


def _do(
    task: Any, do: Callable[[Any], int], start: Callable[..., None], arguments: tuple[Any, ...], code: str, call: str
) -> int:
    check_code(code)
    child = _taken(call)
    try:
        if child is None:
            child = _begun(call)
            _answer(child, "start", start, arguments, do)
        amount = _answer(child, "task", task)
    except BaseException:
        if child is not None:
            _given_up(call, child)
        raise
    _kept(call, child)
    return amount


def _answer(child: Child, *message: Any) -> int:
    child.send(*message)
    try:
        kind, content = child.receive()
    except ChildProblemError as problem:
        raise SurgbenchError(f"a worker's process ended: {problem}; run the same command again") from None
    if kind == "raised":
        raise content
    amount: int = content
    return amount


def _taken(call: str) -> Child | None:
    """A prepared process that has nothing to do."""
    with _lock:
        idle = _idle.get(call)
        if not idle:
            return None
        child = idle.pop()
        _busy.setdefault(call, set()).add(child)
        return child


def _begun(call: str) -> Child:
    child = Child(math.inf, CHILD)
    with _lock:
        _busy.setdefault(call, set()).add(child)
    return child


def _kept(call: str, child: Child) -> None:
    with _lock:
        _busy[call].discard(child)
        _idle.setdefault(call, []).append(child)
    clock = threading.Timer(IDLE_S, _end_idle, (call, child))
    clock.daemon = True
    clock.start()


def _end_idle(call: str, child: Child) -> None:
    with _lock:
        if child not in _idle.get(call, ()):
            return
        _idle[call].remove(child)
    child.stop()


def _given_up(call: str, child: Child) -> None:
    with _lock:
        _busy[call].discard(child)
    child.stop()


def _end(call: str) -> None:
    """End all processes of a generation; whoever waits for one is told by its end."""
    with _lock:
        idle, busy = _idle.pop(call, []), list(_busy.get(call, ()))
    for child in idle:
        child.stop()
    for child in busy:
        child.kill()
