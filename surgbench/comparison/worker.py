"""The process that a silhouette renderer is measured in."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from statistics import median
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surgbench.comparison.peers import Contestant
    from surgbench.comparison.workload import Workload

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
        from surgbench.comparison.peers import PEERS, SilhouetteEngine

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


class Service:
    """Answers the parent's messages.

    They are ``("prepare", name, threads, workload)``, ``("results",)`` and ``("turn", count, at_least_s)``.
    """

    def __init__(self) -> None:
        self._bench: Bench | None = None

    def __call__(self, tell: object, kind: str, *content: Any) -> tuple[Any, ...]:
        """One message's answer, under its own name."""
        if kind == "prepare":
            self._bench = Bench(*content)
            return (kind, self._bench.prepare())
        assert self._bench is not None
        return (kind, self._bench.results() if kind == "results" else self._bench.turn(*content))


def main() -> None:
    """Take the cores given, before anything is loaded that counts them."""
    os.sched_setaffinity(0, {int(core) for core in sys.argv[2].split(",")})
    from surgbench.processes.service import serve_parent

    serve_parent(Service())


if __name__ == "__main__":
    main()
