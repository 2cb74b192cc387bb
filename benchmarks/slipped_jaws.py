"""What part of a row's jaw errors are slips: frames in which a jaw lies where the other is, or on the wrong side of it.

    surgbench reproduce table1 --data data --out reproduced
    python benchmarks/slipped_jaws.py data/paper reproduced/table1/records --row cmaes-3 --row cmaes-5

Prints, for each row, the mean error of q1, q2 and q3 over all frames, the share of frames in which q2 or q3 is off by
more than 0.2 rad, and the mean errors of the others. After the 180-degree rule, as in the tables.

What came out stands in docs/trackers.md.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from surgbench.dataset.open import open_as
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.metrics import choose_twin
from surgbench.state import JOINTS
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.recorded_on import records_on

SLIPPED_RAD = 0.2


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--row", action="append", metavar="ID", help="rows to look at; default: all")
    options = parser.parse_args()
    dataset = open_as(InstrumentDataset, options.dataset)
    off = errors(dataset, options.runs, options.row)
    print("| row | frames | q1, q2, q3 [rad] | slipped | q1, q2, q3 of the others [rad] |")
    print("|---|---:|---|---:|---|")
    for row, parts in off.items():
        every = np.concatenate(parts)
        slipped = (every[:, 1:] > SLIPPED_RAD).any(axis=1)
        print(f"| `{row}` | {len(every)} | {_means(every)} | {slipped.mean():.1%} | {_means(every[~slipped])} |")
    return 0


def errors(dataset: InstrumentDataset, runs: list[Path], rows: list[str] | None) -> dict[str, list[FloatArray]]:
    """Of each row, the joints' absolute errors ``(frames, 3)`` in rad of each of its runs of one arm."""
    off: dict[str, list[FloatArray]] = defaultdict(list)
    for record, unit in records_on(dataset, runs):
        true_states = dataset.sequence(unit.sequence).states(unit.arms[0])
        if (rows and record.spec.row_id not in rows) or true_states is None:
            continue
        states = record.frames.states
        true = true_states[: len(states)]
        off[record.spec.row_id].append(np.abs(choose_twin(states, true) - true)[:, JOINTS])
    return off


def _means(values: FloatArray) -> str:
    return ", ".join(f"{value:.4f}" for value in values.mean(axis=0))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except SurgbenchError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
