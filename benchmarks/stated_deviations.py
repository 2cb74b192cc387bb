"""How far `hybrid` is off, beside how far it believes to be: the factor STATED of `trackers/hybrid.py`.

    surgbench generate paper --out data/paper       (and the same for agile and mismatch)
    python benchmarks/stated_deviations.py data/paper data/agile data/mismatch

Runs `hybrid` in this process without readings, on each arm alone, and prints Markdown: of each component of the state

- the factor, the median over the frames of |error| / (0.6745 s), where s is the standard deviation that the belief has
  of the component. It is 1 where errors are Gaussian with that deviation, and else what STATED should be for stated
  deviations to be right in the median;
- the share of frames in which the truth lies in the 90 % interval whose deviation is STATED s; and in the stated one,
  which has besides what a departure from the declared instrument and camera adds (`hybrid.model_error`).

Every frame is tracked twice for it, with `hybrid.model_error=0` and without.

Errors are those after the twin rule, frames in which the arm is out of view do not count, and `pooled` are all
components of all frames together. `--sequences N` and `--frames N` take a share as `surgbench run` does.

What came out stands in docs/trackers.md.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from surgbench.cli.progress import Bar, progress
from surgbench.dataset.open import open_as
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray, wrap_angle
from surgbench.metrics import INTERVAL_SIGMAS, choose_twin
from surgbench.state import ANGLES, STATE_NAMES
from surgbench.suite.asked import Conditions
from surgbench.suite.plan import complete_all
from surgbench.suite.plan import jobs as plan_jobs
from surgbench.suite.settings import Job
from surgbench.suite.suites import parse_sets
from surgbench.tasks.instrument.asked import InstrumentRow
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.execute import out_of_view, unit_data
from surgbench.tasks.instrument.in_process import answers
from surgbench.trackers.registration.follower import STATED

MEDIAN_SIGMAS = 0.67449  # half of a Gaussian lies within so many standard deviations


class Off(NamedTuple):
    """Of N frames ``(N, 9)``, rad and m: how far estimates are off, the belief's deviations, the stated ones."""

    errors: FloatArray
    belief: FloatArray
    stated: FloatArray


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", nargs="+", type=Path)
    parser.add_argument("--sequences", type=int, metavar="N", help="arms of each dataset; default: all")
    parser.add_argument("--frames", type=int, metavar="N", help="frames of each arm; default: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="NAME.option=value", help="of the tracker's row")
    options = parser.parse_args()
    row = InstrumentRow(tracker="hybrid", sequences=options.sequences, frames=options.frames)
    found = []
    datasets = [open_as(InstrumentDataset, path) for path in options.dataset]
    # What a run without the model's error states are the belief's deviations alone, and its states are the same.
    sets = [parse_sets([*options.set, *more]) for more in (["hybrid.model_error=0"], [])]
    planned = [
        [plan_jobs(complete_all([row], Conditions(seed=options.seed), dataset, one)[0], dataset) for one in sets]
        for dataset in datasets
    ]
    with progress("hybrid, frames", sum(job.frames for both in planned for jobs in both for job in jobs)) as bar:
        for dataset, both in zip(datasets, planned, strict=True):
            alone, whole = ([follow(job, dataset, bar) for job in jobs] for jobs in both)
            errors, stated = (np.concatenate(parts) for parts in zip(*whole, strict=True))
            belief = np.concatenate([deviations for _, deviations in alone]) / STATED
            found.append(Off(errors, belief, stated))
    show([dataset.name for dataset in datasets], found)
    return 0


def follow(job: Job, dataset: InstrumentDataset, bar: Bar) -> tuple[FloatArray, FloatArray]:
    """Run a job and hold its states against the truth: errors, and the deviations that were stated.

    Raises:
        SurgbenchError: There is none.
    """
    data = unit_data(job, dataset)
    if data.truth is None:
        raise SurgbenchError(f"{dataset.path}: sequence {job.unit.id} has no true states")
    states, stated = [], []
    for answer in answers(job, dataset):
        states.append(answer.state)
        stated.append(answer.standard_deviations)
        bar(1)
    truth = data.truth[: job.frames, 0]
    errors = choose_twin(np.array(states), truth) - truth
    errors[:, ANGLES] = wrap_angle(errors[:, ANGLES])
    seen = ~out_of_view(data, job.frames)[:, 0]
    return errors[seen], np.array(stated)[seen]


def factor(off: Off) -> FloatArray:
    """What the belief's deviations are to be taken times, ``(9,)`` and last of all components together."""
    ratios = np.abs(off.errors) / (MEDIAN_SIGMAS * off.belief)
    return np.append(np.median(ratios, axis=0), np.median(ratios))


def covered(errors: FloatArray, deviations: FloatArray) -> FloatArray:
    """How often the truth lies in the 90 % interval of deviations, ``(9,)`` and last of all components together."""
    inside = np.abs(errors) <= INTERVAL_SIGMAS * deviations
    return np.append(inside.mean(axis=0), inside.mean())


def show(names: list[str], found: list[Off]) -> None:
    """Print a table, a row for each component and three columns for each dataset."""
    heads = [f"`{name}`: factor | belief's 90 % | stated 90 %" for name in names]
    print(f"| | {' | '.join(heads)} |")
    print("|---|" + "---:|---:|---:|" * len(found))
    columns = [
        (factor(off), covered(off.errors, STATED * off.belief), covered(off.errors, off.stated)) for off in found
    ]
    for place, name in enumerate((*STATE_NAMES, "pooled")):
        cells = [f"{one[0][place]:.3f} | {one[1][place]:.1%} | {one[2][place]:.1%}" for one in columns]
        print(f"| {name} | {' | '.join(cells)} |")
    frames = ", ".join(f"{len(off.errors)} of {name}" for name, off in zip(names, found, strict=True))
    print(f"\nSTATED is {STATED:g}. Frames: {frames}.")


if __name__ == "__main__":
    try:
        sys.exit(main())
    except SurgbenchError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
