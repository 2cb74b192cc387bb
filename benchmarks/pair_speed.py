"""What two arms cost beside one: a frame of a tracker, and a generation of candidates on one and two threads.

    surgbench generate paper-dual --sequences 1 --frames 200 --out data/paper-dual
    OMP_NUM_THREADS=1 python benchmarks/pair_speed.py data/paper-dual [--tracker cmaes] [--frames 100]

Frames of each arm alone and of both, in one search (eq. 15) and in one for each arm, are taken in turn; a figure is the
median over the frames of the least of some rounds, without tip detection, and its ratio is to the mean of the two arms
alone. Generations are of 70 candidates around the true state of every tenth frame.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from surgbench.dataset.open import open_as
from surgbench.geometry import FloatArray
from surgbench.silhouette import Reference, SilhouetteEvaluator, VisibleScorer
from surgbench.state import STATE_SCALE
from surgbench.suite.asked import Conditions
from surgbench.suite.plan import complete_all
from surgbench.suite.plan import jobs as plan_jobs
from surgbench.suite.settings import Job
from surgbench.tasks.instrument.asked import InstrumentRow
from surgbench.tasks.instrument.dataset import InstrumentDataset, Sequence
from surgbench.tasks.instrument.in_process import answers

ROUNDS = 3
CANDIDATES = 70
SPREAD = 1.0  # natural steps
EVERY = 10


def jobs_of(dataset: InstrumentDataset, tracker: str, arms: Any, options: dict[str, Any]) -> list[Job]:
    """The runs of a tracker on the first sequence."""
    row = InstrumentRow(tracker=tracker, keypoints="none")
    (settings,) = complete_all([row], Conditions(arms=arms), dataset, {tracker: options})
    return [job for job in plan_jobs(settings, dataset) if job.unit.sequence == dataset.sequences[0].id]


def frames_ms(jobs: dict[str, Job], dataset: InstrumentDataset, frames: int) -> dict[str, FloatArray]:
    """Of each job the least time of each frame, milliseconds."""
    least = {name: np.full(frames, np.inf) for name in jobs}
    for _ in range(ROUNDS):
        for number, together in enumerate(zip(*(answers(job, dataset) for job in jobs.values()), strict=False)):
            if number == frames:
                break
            for name, answer in zip(jobs, together, strict=True):
                taken = answer.latency_optimise_ms
                least[name][number] = min(least[name][number], np.inf if taken is None else taken)
    return {name: values[np.isfinite(values)] for name, values in least.items()}


def generations_us(dataset: InstrumentDataset, sequence: Sequence, threads: int) -> dict[str, float]:
    """Microseconds a candidate, in the mean over frames of the least of some rounds."""
    instruments = [dataset.instrument(sequence.entry.instruments[arm]) for arm in sequence.arms]
    alone = SilhouetteEvaluator(instruments[:1], sequence.camera, threads=threads)
    both = SilhouetteEvaluator(instruments, sequence.camera, threads=threads)
    apart = VisibleScorer(instruments, sequence.camera, threads=threads)
    rng = np.random.default_rng(0)
    taken: dict[str, list[float]] = {}
    for frame in range(0, sequence.frames, EVERY):
        truth = np.concatenate([np.asarray(sequence.states(arm))[frame] for arm in sequence.arms])
        states = truth + SPREAD * np.tile(STATE_SCALE, 2) * rng.standard_normal((CANDIDATES, len(truth)))
        union, own = (Reference(sequence.clean_mask(kind, frame)) for kind in ("both", "left"))
        each = [Reference(sequence.clean_mask(kind, frame)) for kind in sequence.instance_kinds or ()]
        work: dict[str, Callable[[], object]] = {
            "one arm": lambda states=states, own=own: alone.score(states[:, :9], own),  # type: ignore[misc]
            "both, one mask": lambda states=states, union=union: both.score(states, union),  # type: ignore[misc]
            "both, a mask each": lambda states=states, each=each: apart.score(states, each),  # type: ignore[misc]
        }
        for name, call in work.items():
            taken.setdefault(name, []).append(_least_s(call) / CANDIDATES * 1e6)
    return {name: float(np.mean(values)) for name, values in taken.items()}


def _least_s(call: Callable[[], object]) -> float:
    call()
    least = np.inf
    for _ in range(2 * ROUNDS):
        begin = time.perf_counter()
        call()
        least = min(least, time.perf_counter() - begin)
    return float(least)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="pairs with instance masks and truth")
    parser.add_argument("--tracker", default="cmaes", help="one with the option `dual` (default: cmaes)")
    parser.add_argument("--frames", type=int, default=100)
    arguments = parser.parse_args()
    dataset = open_as(InstrumentDataset, arguments.dataset)
    single = jobs_of(dataset, arguments.tracker, "single", {})
    jobs = {f"{job.unit.id}, alone": job for job in single}
    for dual in ("joint", "separate"):
        jobs[f"both, dual={dual}"], *_ = jobs_of(dataset, arguments.tracker, "dual", {"dual": dual})
    times = {name: float(np.median(ms)) for name, ms in frames_ms(jobs, dataset, arguments.frames).items()}
    one = np.mean([times[name] for name in list(times)[:2]])
    print(f"| `{arguments.tracker}`, one thread | ms a frame | times one arm |\n|---|---|---|")
    for name, ms in times.items():
        print(f"| {name} | {ms:.2f} | {ms / one:.2f} |")
    counts = {threads: generations_us(dataset, dataset.sequences[0], threads) for threads in (1, 2)}
    print(
        "\n| 70 candidates, us each | one thread | times one arm | two threads | times one arm |\n|---|---|---|---|---|"
    )
    for name in counts[1]:
        cells = [f"{counts[n][name]:.1f} | {counts[n][name] / counts[n]['one arm']:.2f}" for n in (1, 2)]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
