"""The silhouette engine beside other renderers: the same states, the same mask, one run.

Every renderer computes what the engine computes, the area of each candidate's silhouette and its overlap with a
mask, in a process of its own that may use one core (the engine as many as it is given threads). They take turns:
one turn each a round, so that a busy or hot machine slows all of them. What a renderer sets up once, and what it
does to a new mask, is not in its time a candidate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.comparison.peers import PEERS, SilhouetteEngine
from surgbench.comparison.process import RendererProcess, own_cores
from surgbench.comparison.workload import CANDIDATES, Workload, silhouette_workload
from surgbench.errors import ConfigError, NotFoundError, SurgbenchError, unknown_name
from surgbench.processes.child import ChildProblemError
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.suite.environment import environment

OURS = SilhouetteEngine.name
MICRO = 1e6


@dataclass(frozen=True)
class Effort:
    """How much is measured.

    Attributes:
        candidates: States of the workload.
        rounds: Turns of each renderer; its time is their median.
        turn_s: A turn goes on for so long at least.
        slow_turn_s: A renderer that would take longer for all states is timed on fewer.
    """

    candidates: int = CANDIDATES
    rounds: int = 15
    turn_s: float = 0.05
    slow_turn_s: float = 0.3


QUICK = Effort(candidates=6, rounds=2, turn_s=0.0, slow_turn_s=0.05)
FEWEST_CANDIDATES = 4


@dataclass(frozen=True)
class Measured:
    """What one renderer took and found.

    Attributes:
        name: ``"surgbench"`` or a peer's.
        threads: Threads it was given.
        version: Of its library.
        remark: What a reader of its figures should know.
        candidates: States it was timed on.
        round_us: Microseconds a candidate, one value a round.
        mask_us: Microseconds to take in a new mask.
        area: ``(N,)`` pixels of every state.
        overlap: ``(N,)`` pixels.
        masks: ``(N, bytes)`` packed bits.
    """

    name: str
    threads: int
    version: str
    remark: str
    candidates: int
    round_us: tuple[float, ...]
    mask_us: float
    area: NDArray[np.int64]
    overlap: NDArray[np.int64]
    masks: NDArray[np.uint8]

    @property
    def us(self) -> float:
        """Microseconds a candidate: the median of the rounds."""
        return median(self.round_us)

    def disagreement_px(self, other: Measured) -> int:
        """The largest disagreement over the states: of the masks, or of the counts, whichever is larger."""
        pixels = np.bitwise_count(self.masks ^ other.masks).sum(axis=1, dtype=np.int64)
        counts = np.maximum(np.abs(self.area - other.area), np.abs(self.overlap - other.overlap))
        return int(np.maximum(pixels, counts).max())


@dataclass(frozen=True)
class Comparison:
    """All that was measured in one run.

    Attributes:
        workload: What was rendered.
        triangles: Of the instrument.
        effort: How much was measured.
        ours: The engine, one for each number of threads.
        peers: The others.
        skipped: Name to reason, of what could not be measured.
    """

    workload: Workload
    triangles: int
    effort: Effort
    ours: tuple[Measured, ...]
    peers: tuple[Measured, ...]
    skipped: dict[str, str]

    def entries(self) -> list[dict[str, Any]]:
        """The comparison as JSON has it: one entry for each number of threads of the engine."""
        machine = environment()["machine"]
        shared = {
            "candidates": len(self.workload.states),
            "triangles": self.triangles,
            "width": self.workload.camera.width,
            "height": self.workload.camera.height,
            "rounds": self.effort.rounds,
            "peers": {peer.name: round(peer.us, 2) for peer in self.peers},
            "peer_range_us": {peer.name: _range(peer) for peer in self.peers},
            "peer_threads": {peer.name: peer.threads for peer in self.peers},
            "peer_candidates": {peer.name: peer.candidates for peer in self.peers},
            "remarks": {peer.name: peer.remark for peer in self.peers if peer.remark},
            "skipped": self.skipped,
            "versions": {one.name: one.version for one in (self.ours[0], *self.peers)},
            "cpu": machine["processor"],
            "cores": len(own_cores()),
        }
        return [{**self._entry(ours), **shared} for ours in self.ours]

    def _entry(self, ours: Measured) -> dict[str, Any]:
        disagreement = {peer.name: ours.disagreement_px(peer) for peer in self.peers}
        exact = [peer for peer in self.peers if PEERS[peer.name].exact]
        fastest = min((peer for peer in exact if PEERS[peer.name].third_party), key=lambda peer: peer.us, default=None)
        scanline = next((peer for peer in self.peers if peer.name == "scanline"), None)
        return {
            "threads": ours.threads,
            "us_per_candidate": round(ours.us, 3),
            "range_us": _range(ours),
            "us_per_mask": round(ours.mask_us, 1),
            "fastest_peer": fastest and fastest.name,
            "speedup_over_fastest_peer": fastest and round(fastest.us / ours.us, 2),
            "scanline_ratio": scanline and round(scanline.us / ours.us, 2),
            "max_pixel_disagreement": max((disagreement[peer.name] for peer in exact), default=None),
            "disagreement_px": disagreement,
        }


def _range(measured: Measured) -> list[float]:
    return [round(min(measured.round_us), 3), round(max(measured.round_us), 3)]


def check_peers(names: Sequence[str]) -> list[str]:
    """Names of peers, each once, in the table's order.

    Raises:
        NotFoundError: No peer has this name; the message offers the nearest.
    """
    for name in names:
        if name not in PEERS:
            raise NotFoundError(unknown_name("peer", name, PEERS))
    return [name for name in PEERS if name in names]


def check_threads(asked: Sequence[int]) -> tuple[list[int], dict[str, str]]:
    """The numbers of threads that can be measured here, ascending, and why the others can't.

    Raises:
        ConfigError: A number below 1, or none that this machine has cores for.
    """
    cores = len(own_cores())
    if not asked or min(asked) < 1:
        raise ConfigError(f"--threads {','.join(map(str, asked))}: give numbers from 1, for example 1,2")
    usable = sorted({threads for threads in asked if threads <= cores})
    reason = f"this process has {cores} core{'s' if cores > 1 else ''}"
    if not usable:
        raise ConfigError(f"--threads {','.join(map(str, asked))}: {reason}; give at most {cores}")
    return usable, {f"{OURS}, {threads} threads": reason for threads in sorted(set(asked)) if threads > cores}


class _Entrant:
    """A renderer while it is being measured.

    Attributes:
        reason: Why it can't be measured, once that is so.
    """

    reason = ""

    def __init__(self, name: str, threads: int, stack: ExitStack) -> None:
        self.name, self.threads = name, threads
        # All that have one thread share one core: they take turns. The first cores are the busiest.
        cores = own_cores()[-1:] if threads == 1 else own_cores()
        self._process = stack.enter_context(RendererProcess(threads, cores))
        self._rounds: list[float] = []

    def attempt(self, step: Callable[..., str | None], *arguments: Any) -> bool:
        """Whether a step went well; a peer for which it did not is out, and its process gone.

        Raises:
            SurgbenchError: It is the engine itself.
        """
        try:
            reason = step(*arguments)
        except ChildProblemError as problem:
            if self.name == OURS:
                raise SurgbenchError(f"the engine with {self.threads} threads: {problem}") from None
            reason = f"{problem.status}: {problem}"
        if reason is None:
            return True
        self.reason = reason
        self._process.stop()
        return False

    def prepare(self, workload: Workload, effort: Effort) -> str | None:
        """Set up, and compute what is checked; returns why it can't be measured, or ``None``."""
        self._ready = self._ask("prepare", self.name, self.threads, workload)
        if self._ready["skipped"] is not None:
            return str(self._ready["skipped"])
        self._results = self._ask("results")
        fitting = int(effort.slow_turn_s / self._ready["state_s"])
        self._candidates = min(len(workload.states), max(FEWEST_CANDIDATES, fitting))
        return None

    def turn(self, effort: Effort) -> None:
        """Take one turn."""
        seconds = median(self._ask("turn", self._candidates, effort.turn_s))
        self._rounds.append(MICRO * seconds / self._candidates)

    def _ask(self, *message: Any) -> Any:
        self._process.send(*message)
        return self._process.receive()[1]

    def measured(self) -> Measured:
        """After the last turn."""
        return Measured(
            name=self.name,
            threads=self.threads,
            version=self._ready["version"],
            remark=self._ready["remark"],
            candidates=self._candidates,
            round_us=tuple(self._rounds),
            mask_us=MICRO * self._ready["mask_s"],
            **self._results,
        )


def compare(
    threads: Sequence[int],
    peers: Sequence[str],
    effort: Effort,
    advance: Callable[[float], None],
    preparing: Callable[[str, float], None],
) -> Comparison:
    """Measure the engine and its peers in one run.

    Args:
        threads: Of the engine, one measurement each; more than there are cores are skipped.
        peers: Names of peers.
        effort: How much is measured.
        advance: Called with 1 for each round done.
        preparing: Called with what is being set up and how far that is, 0 to 1.

    Raises:
        NotFoundError: No peer has one of the names.
        ConfigError: A number of threads is below 1, or none can be measured here.
        SurgbenchError: The engine itself can't be measured. What keeps a peer from being measured is in ``skipped``.
    """
    names = check_peers(peers)
    counts, skipped = check_threads(threads)
    workload = silhouette_workload(effort.candidates)
    asked = [(OURS, count) for count in counts] + [(name, 1) for name in names]
    with ExitStack() as stack:
        entrants: list[_Entrant] = []
        for index, (name, count) in enumerate(asked):
            preparing("preparing", index / len(asked))
            entrant = _Entrant(name, count, stack)
            if entrant.attempt(entrant.prepare, workload, effort):
                entrants.append(entrant)
            else:
                skipped[name] = entrant.reason
        preparing("preparing", 1.0)
        for _ in range(effort.rounds):
            for entrant in tuple(entrants):
                if not entrant.attempt(entrant.turn, effort):
                    entrants.remove(entrant)
                    skipped[entrant.name] = entrant.reason
            advance(1)
        measured = [entrant.measured() for entrant in entrants]
    return Comparison(
        workload=workload,
        triangles=SilhouetteEvaluator([workload.instrument], workload.camera).triangles,
        effort=effort,
        ours=tuple(one for one in measured if one.name == OURS),
        peers=tuple(one for one in measured if one.name != OURS),
        skipped=skipped,
    )
