"""The process that a silhouette renderer is measured in."""

from __future__ import annotations

import contextlib
import os
import sys
import time
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from statistics import median
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surgbench.bench.peers import Contestant
    from surgbench.bench.workload import Workload

WARM_STATES = 2
MASKS = 9


class Bench:
    """One renderer with its workload.

    Args:
        name: Of a peer, or of the engine itself.
        threads: Threads of the engine; the peers have one.
        workload: What is rendered.
    """

    def __init__(self, name: str, threads: int, workload: Workload) -> None:
        from surgbench.bench.peers import PEERS, SilhouetteEngine

        self._workload = workload
        self._contestant: Contestant = PEERS[name]() if name in PEERS else SilhouetteEngine(threads)

    def prepare(self) -> dict[str, Any]:
        """Set up and warm up.

        Returns:
            ``skipped``: why it can't be used, or ``None``; else ``version``, ``remark``, ``mask_s``: what a new mask
            takes, and ``state_s``: what a state takes.
        """
        work, one = self._workload, self._contestant
        problem = one.problem()
        if problem is not None:
            return {"skipped": problem}
        one.prepare(work.instrument, work.camera)
        one.aim(work.mask)
        one.score(work.states[:WARM_STATES])
        return {
            "skipped": None,
            "version": one.version(),
            "remark": one.remark(),
            "mask_s": median(_seconds(lambda: one.aim(work.mask)) for _ in range(MASKS)),
            "state_s": _seconds(lambda: one.score(work.states[:WARM_STATES])) / WARM_STATES,
        }

    def results(self) -> dict[str, Any]:
        """Area and overlap of all states as they are timed, and their masks as packed bits. Untimed."""
        import numpy as np

        area, overlap = self._contestant.score(self._workload.states)
        masks = [np.packbits(self._contestant.silhouette(state)) for state in self._workload.states]
        return {"area": area, "overlap": overlap, "masks": np.stack(masks)}

    def turn(self, count: int, at_least_s: float) -> list[float]:
        """Score the first ``count`` states again and again.

        Returns:
            Seconds of each time; one at least, more until ``at_least_s`` have passed.
        """
        states = self._workload.states[:count]
        # Another process had the core in the meantime: its caches are not this renderer's fault.
        self._contestant.score(states[: max(1, count // 10)])
        times: list[float] = []
        first = time.perf_counter()
        while not times or time.perf_counter() - first < at_least_s:
            times.append(_seconds(lambda: self._contestant.score(states)))
        return times


def _seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def serve(connection: Connection) -> None:
    """Answer the parent's messages until it hangs up.

    They are ``("prepare", name, threads, workload)``, ``("results",)`` and ``("turn", count, at_least_s)``.
    """
    bench: Bench | None = None
    while True:
        try:
            kind, *content = connection.recv()
        except EOFError:
            return
        try:
            answer: Any
            if kind == "prepare":
                bench = Bench(*content)
                answer = bench.prepare()
            else:
                assert bench is not None
                answer = bench.results() if kind == "results" else bench.turn(*content)
            connection.send((kind, answer))
        except Exception as error:  # whatever the library raised is its row's result
            text = " ".join(f"{type(error).__name__}: {error}".split())
            with contextlib.suppress(OSError):  # the parent may be gone
                connection.send(("problem", "failed", text, traceback.format_exc()))
            return


def main() -> None:
    """Take the cores given, before anything is loaded that counts them."""
    os.sched_setaffinity(0, {int(core) for core in sys.argv[2].split(",")})
    from surgbench.suite.process import serve_parent

    serve_parent(serve)


if __name__ == "__main__":
    main()
