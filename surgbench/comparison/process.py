"""The parent's end of a renderer's process."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

from surgbench.processes.child import Child, ChildProblemError
from surgbench.processes.threads import THREADS

# The first call may compile for a minute.
TIMEOUT_S = 300.0
# Mesa's llvmpipe then draws in the thread that asks.
NO_DRAWING_THREADS = {"LP_NUM_THREADS": "0"}


def own_cores() -> list[int]:
    """The processor's cores that this process may use."""
    return sorted(os.sched_getaffinity(0))


class RendererProcess(Child):
    """A renderer in a process of its own: libraries that don't go together stay apart, and none can end the run.

    Args:
        threads: It is told to use so many, of however many cores it may use.
        cores: The ones it may use.
    """

    def __init__(self, threads: int, cores: Iterable[int]) -> None:
        environment = {**THREADS, **NO_DRAWING_THREADS, "NUMBA_NUM_THREADS": str(threads)}
        super().__init__(TIMEOUT_S, "surgbench.comparison.worker", environment, (",".join(map(str, cores)),))

    def receive(self) -> tuple[Any, ...]:
        """The child's next message.

        Raises:
            ChildProblemError: It reports a problem, ended, or said nothing for too long.
        """
        try:
            return super().receive()
        except ChildProblemError as problem:
            text = str(problem).replace("the tracker's process", "its process")
            raise ChildProblemError(problem.status, text, problem.traceback) from None
