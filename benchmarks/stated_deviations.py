"""How far `hybrid` is off, beside how far it believes to be: the factor STATED of `trackers/hybrid.py`.

    surgbench generate paper --out data/paper       (and the same for agile and mismatch)
    python benchmarks/stated_deviations.py data/paper data/agile data/mismatch

Runs `hybrid` in this process without readings, on each arm alone, and prints Markdown: of each component of the state

- the factor, the median over the frames of |error| / (0.6745 s), where s is the standard deviation that the belief has
  of the component. It is 1 where errors are Gaussian with that deviation, and else what STATED should be for stated
  deviations to be right in the median;
- the share of frames in which the truth lies in the stated 90 % interval, whose deviation is STATED s; and the same
  with `hybrid.model_error=1`, which adds what instrument and camera are wrong by in `mismatch`.

Errors are those after the twin rule, frames in which the arm is out of view do not count, and `pooled` are all
components of all frames together. `--sequences N` and `--frames N` take a share as `surgbench run` does.

What came out stands in docs/trackers.md: in the median 0.19 (`paper`) and 0.21 (`agile`), and 0.24 holds the truth in
90.8 and 89.5 % of all, for errors have longer tails than a Gaussian.
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
from surgbench.trackers.hybrid import MODEL_ERROR, STATED

MEDIAN_SIGMAS = 0.67449  # half of a Gaussian lies within so many standard deviations


class Off(NamedTuple):
    """Of N frames ``(N, 9)``, rad and m: how far off the estimates are, and the belief's standard deviations."""

    errors: FloatArray
    belief: FloatArray


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", nargs="+", type=Path)
    parser.add_argument("--sequences", type=int, metavar="N", help="arms of each dataset; default: all")
    parser.add_argument("--frames", type=int, metavar="N", help="frames of each arm; default: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="NAME.option=value", help="of the tracker's row")
    options = parser.parse_args()
    row = InstrumentRow(tracker="hybrid", sequences=options.sequences, frames=options.frames)
    # The deviations that a run without the model's error states are the belief's alone.
    sets = parse_sets([*options.set, "hybrid.model_error=0"])
    datasets = [open_as(InstrumentDataset, path) for path in options.dataset]
    settings = [complete_all([row], Conditions(seed=options.seed), dataset, sets)[0] for dataset in datasets]
    planned = [plan_jobs(one, dataset) for one, dataset in zip(settings, datasets, strict=True)]
    found = []
    with progress("hybrid, frames", sum(job.frames for jobs in planned for job in jobs)) as bar:
        for dataset, jobs in zip(datasets, planned, strict=True):
            parts = [follow(job, dataset, bar) for job in jobs]
            found.append(Off(*(np.concatenate(part) for part in zip(*parts, strict=True))))
    show([dataset.name for dataset in datasets], found)
    return 0


def follow(job: Job, dataset: InstrumentDataset, bar: Bar) -> Off:
    """Run a job and hold its states against the truth.

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
    return Off(errors[seen], np.array(stated)[seen] / STATED)


def factor(off: Off) -> FloatArray:
    """What the belief's deviations are to be taken times, ``(9,)`` and last of all components together."""
    ratios = np.abs(off.errors) / (MEDIAN_SIGMAS * off.belief)
    return np.append(np.median(ratios, axis=0), np.median(ratios))


def covered(off: Off, model_error: float) -> FloatArray:
    """How often the truth lies in the stated 90 % interval, ``(9,)`` and last of all components together."""
    stated = np.hypot(STATED * off.belief, model_error * MODEL_ERROR)
    inside = np.abs(off.errors) <= INTERVAL_SIGMAS * stated
    return np.append(inside.mean(axis=0), inside.mean())


def show(names: list[str], found: list[Off]) -> None:
    """Print a table, a row for each component and three columns for each dataset."""
    heads = [f"`{name}`: factor | in 90 % | with `model_error=1`" for name in names]
    print(f"| | {' | '.join(heads)} |")
    print("|---|" + "---:|---:|---:|" * len(found))
    columns = [(factor(off), covered(off, 0.0), covered(off, 1.0)) for off in found]
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
