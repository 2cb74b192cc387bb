"""Frames of a tracker on a busy machine, as multiples of a single-threaded loop that is timed beside them.

    surgbench generate mini --out data/mini
    python benchmarks/under_load.py data/mini

A tracker runs in its child process, as in ``surgbench run``; after every few frames another child, always of one
thread, does the reference work of ``surgbench/processes/reference_work.py``. One waits while the other is busy, so that
both meet the same machine. That with and without so many busy loops beside them, which this script starts and ends.
Where the scheduler is fair and nothing waits busily, a frame takes as many times as long as the loop with them as
without.

``--threads`` says what the tracker's child is told: ``one`` is what the engine tells it, ``before`` what it did once
(no word of OpenCV, nor of waiting), ``default`` nothing. They are run in turns, so many rounds.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from surgbench.dataset.open import open_as
from surgbench.processes.child import Child
from surgbench.processes.threads import THREADS
from surgbench.suite.asked import Conditions
from surgbench.suite.plan import complete, jobs
from surgbench.suite.settings import Job
from surgbench.tasks.instrument.asked import InstrumentRow
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.execute import WORKER, child_setup, true_states, unit_data

COUNTED = ("cpu_s", "given_up", "taken_away")
BEFORE = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
TOLD = {"one": THREADS, "before": {name: "1" for name in BEFORE}, "default": {}}
TIMEOUT_S = 600.0
EVERY = 5  # frames, then as many turns of the reference work
# A busy loop ends by itself, whatever happens to this script.
BUSY = "import time\nend = time.monotonic() + {}\nwhile time.monotonic() < end: pass"
LONGEST_S = 900.0


class Switches(NamedTuple):
    """What the kernel has counted of all threads of a process."""

    threads: int
    cpu_s: float
    given_up: int
    taken_away: int


def switches(pid: int) -> Switches:
    """Of a process, now."""
    threads, ticks, given_up, taken_away = 0, 0, 0, 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        threads += 1
        fields = (task / "stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
        lines = (task / "status").read_text().splitlines()
        counts = [int(line.split()[1]) for line in lines if "ctxt_switches" in line]
        given_up, taken_away = given_up + counts[0], taken_away + counts[1]
    return Switches(threads, ticks / 100.0, given_up, taken_away)


@contextmanager
def busy(count: int) -> Iterator[None]:
    """So many busy loops meanwhile."""
    loops = [subprocess.Popen([sys.executable, "-c", BUSY.format(LONGEST_S)]) for _ in range(count)]
    try:
        time.sleep(1.0 if count else 0.0)
        yield
    finally:
        for loop in loops:
            loop.kill()
        for loop in loops:
            loop.wait()


class Timing(NamedTuple):
    """Milliseconds of frames and of turns of the reference work, and what the kernel counted in the frames."""

    frame_ms: list[float]
    reference_ms: list[float]
    counted: Switches


def run(job: Job, dataset: InstrumentDataset, told: str, load: int, frames: int) -> Timing:
    data = unit_data(job, dataset)
    observations = [data.observation(k) for k in range(frames)]
    frame_ms, reference_ms = [], []
    with Child(TIMEOUT_S, WORKER, TOLD[told]) as child, Child(TIMEOUT_S, WORKER) as reference:
        child.send("setup", child_setup(job, data))
        child.receive()
        truth = None if data.truth is None else data.truth[0].reshape(-1)
        child.send("first", observations[0], truth, true_states(job, data))
        while child.receive()[0] == "progress":
            pass
        reference.calibrate()
        with busy(load):
            before = switches(child.pid)
            for index, observation in enumerate(observations):
                child.send("step", observation)
                frame_ms.append(child.receive()[1].latency_ms)
                if index % EVERY == EVERY - 1:
                    reference_ms += reference.calibrate()
            after = switches(child.pid)
    counted = Switches(
        after.threads,
        after.cpu_s - before.cpu_s,
        after.given_up - before.given_up,
        after.taken_away - before.taken_away,
    )
    return Timing(frame_ms, reference_ms, counted)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--tracker", default="hybrid")
    parser.add_argument("--keypoints", default="resnet18")
    parser.add_argument("--load", type=int, default=13, help="busy loops")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--threads", action="append", choices=TOLD, help="default: all of them")
    options = parser.parse_args()
    dataset = open_as(InstrumentDataset, options.dataset)
    row = InstrumentRow(tracker=options.tracker, keypoints=options.keypoints)
    job = jobs(complete(row, Conditions(), dataset), dataset)[0]
    frames = min(options.frames, job.frames)
    found: dict[tuple[str, int], list[Timing]] = defaultdict(list)
    for _ in range(options.rounds):
        for load in (0, options.load):
            for told in options.threads or TOLD:
                found[told, load].append(run(job, dataset, told, load, frames))
    print("threads  busy  frame ms  loop ms  ratio | of the child, a frame: threads  cpu ms  given up  taken away")
    for (told, load), timings in found.items():
        frame = statistics.median(one for timing in timings for one in timing.frame_ms)
        loop = statistics.median(one for timing in timings for one in timing.reference_ms)
        count = frames * len(timings)
        cpu_ms, given_up, taken_away = (sum(getattr(t.counted, name) for t in timings) / count for name in COUNTED)
        print(
            f"{told:8} {load:4d} {frame:9.1f} {loop:8.1f} {frame / loop:6.2f} | {timings[0].counted.threads:30d} "
            f"{1e3 * cpu_ms:7.1f} {given_up:9.1f} {taken_away:11.1f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
