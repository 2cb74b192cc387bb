"""Tasks done in worker processes of this machine."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from multiprocessing import get_context
from typing import Any

from surgbench.processes.interruption import without_ctrl_c


class ProcessPool:
    """Worker processes, begun anew with every :meth:`do`; see :class:`surgbench.generation.Workers`.

    Args:
        jobs: How many.
    """

    elsewhere = False

    def __init__(self, jobs: int = 1) -> None:
        self.jobs = max(1, jobs)

    def do(
        self,
        tasks: Iterable[Any],
        do: Callable[[Any], int],
        start: Callable[..., None],
        arguments: tuple[Any, ...],
        progress: Callable[[float], None],
    ) -> None:
        """Do tasks; see :meth:`surgbench.generation.Workers.do`.

        Raises:
            BrokenProcessPool: A worker was killed.
            Exception: What ``start`` or ``do`` raised.
        """
        context = get_context("spawn")
        # Without a lock, which a killed worker could take along.
        stop = context.RawValue(ctypes.c_bool, False)
        prepare = (start, *arguments, stop)
        with ProcessPoolExecutor(self.jobs, mp_context=context, initializer=_prepare, initargs=prepare) as pool:
            waiting: set[Future[int]] = set()
            try:
                for task in tasks:
                    # Few at a time, so that the states of a long dataset are not all held at once.
                    while len(waiting) >= 2 * self.jobs:
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
