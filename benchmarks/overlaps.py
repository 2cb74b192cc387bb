"""What becomes of two arms that hide each other: which way round tracks come out, and what trackers know meanwhile.

    surgbench generate occlusion-long --out data/occlusion-long
    surgbench run --dataset data/occlusion-long --arms dual --tracker hybrid --out runs/pairs
    surgbench run --dataset data/occlusion-long --arms single --tracker hybrid --sequences 12 --out runs/alone
    python benchmarks/overlaps.py data/occlusion-long runs/pairs --alone runs/alone [--least 60]

An overlap is a stretch of frames, after the first, in which at most a tenth of an arm's wrist and jaws is seen, at
least so long. Tracks are right afterwards by the rule of the column ``right_way_round``. The other arm's error
meanwhile is held against the same arm's in the same frames when it is tracked alone, with masks in which nothing hides
it.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgbench import pair_metrics
from surgbench.dataset.open import open_as
from surgbench.geometry import FloatArray
from surgbench.metrics import RECOVERED_M
from surgbench.records.reader import read_records
from surgbench.state import STATE_SIZE
from surgbench.tasks.instrument.dataset import InstrumentDataset, Sequence
from surgbench.tasks.instrument.records import InstrumentRecord


class Overlaps:
    """What is counted of one row.

    Args:
        least: Frames of the shortest overlap.
    """

    def __init__(self, least: int) -> None:
        self.least = least
        self.right: list[float] = []
        self.recovered: list[float] = []
        self.known: list[FloatArray] = []
        self.doubted: list[FloatArray] = []
        self.pairs: list[tuple[str, FloatArray, FloatArray]] = []

    def add(self, dataset: InstrumentDataset, record: InstrumentRecord, alone: dict[str, InstrumentRecord]) -> None:
        """Count one pair's run."""
        sequence = dataset.sequence(record.spec.sequence)
        frames = record.frames
        errors = record.errors["tip_error_m"]
        lost = np.stack([frames.lost_of(arm) for arm in range(2)], axis=1)
        sure = np.stack([frames.confidence_of(arm) for arm in range(2)], axis=1)
        hidden = _hidden(sequence)[: len(errors)]
        turned = _turned(dataset, sequence, frames.states)
        self.known.append(pair_metrics.hidden_known(errors, lost, hidden))
        self.doubted.append(pair_metrics.far_off_doubted(errors, sure, lost))
        self.right += pair_metrics.right_way_round(turned, hidden, self.least).tolist()
        for arm in range(2):
            self._recoveries(errors[:, arm], hidden[:, arm])
            own = alone.get(sequence.arms[arm])
            if own is not None:
                other = hidden[:, 1 - arm] & ~hidden[:, arm]
                both = errors[other, arm], np.asarray(own.errors["tip_error_m"])[: len(errors)][other]
                self.pairs.append((f"{sequence.id}/{sequence.arms[arm]}", *both))

    def _recoveries(self, errors: FloatArray, hidden: NDArray[np.bool_]) -> None:
        for first, last in pair_metrics.stretches(hidden):
            if first > 0 and last < len(errors) and last - first >= self.least:
                good = np.flatnonzero(errors[last:] <= RECOVERED_M)
                self.recovered.append(float(good[0] if len(good) else len(errors) - last))

    def lines(self) -> list[str]:
        """What was found, for people."""
        waits = np.array(self.recovered or [np.nan], dtype=np.float64)
        known, doubted = (np.concatenate(values).ravel() for values in (self.known, self.doubted))
        hidden, far = np.isfinite(known).sum(), np.isfinite(doubted).sum()
        lines = [
            f"after overlaps of at least {self.least} frames: right way round {_share(np.array(self.right))} "
            f"of {len(self.right)}",
            f"frames until an arm's tips are right again: median {np.median(waits):g}, "
            f"90 % within {np.quantile(waits, 0.9):g}, of {len(self.recovered)}",
            f"hidden arm lost or within 5 mm: {_share(known)} of {hidden} frames",
            f"tips more than 10 mm off: {far} frames, of which lost or doubted: {_share(doubted)}",
        ]
        if self.pairs:
            own, single = (np.concatenate([pair[k] for pair in self.pairs]) for k in (1, 2))
            ratios = {name: pair.mean() / ref.mean() for name, pair, ref in self.pairs if len(pair)}
            worst = max(ratios, key=lambda name: ratios[name])
            lines.append(
                f"seen arm while the other is hidden: tips {1e3 * own.mean():.3f} mm, alone {1e3 * single.mean():.3f} "
                f"({own.mean() / single.mean():.2f} x); medians of frames {1e3 * np.median(own):.3f} and "
                f"{1e3 * np.median(single):.3f}; most of an arm's {ratios[worst]:.2f} x ({worst})"
            )
        return lines


def _share(values: FloatArray) -> str:
    known = values[np.isfinite(values)]
    return f"{100 * known.mean():.1f} %" if len(known) else "none"


def _hidden(sequence: Sequence) -> NDArray[np.bool_]:
    """``(T, 2)`` in which frames wrist and jaws of an arm are hidden."""
    told = [sequence.visibility(arm) for arm in sequence.arms]
    if any(one is None for one in told):
        raise SystemExit(f"sequence '{sequence.id}' does not tell its arms apart")
    return np.stack([one["tool_visible"] <= pair_metrics.HIDDEN_SHARE for one in told if one is not None], axis=1)


def _turned(dataset: InstrumentDataset, sequence: Sequence, states: FloatArray) -> NDArray[np.bool_]:
    """In which frames each estimate is nearer to the other arm."""
    estimate, truth = [], []
    for own, arm in zip(np.moveaxis(states.reshape(-1, 2, STATE_SIZE), 1, 0), sequence.arms, strict=True):
        true = sequence.states(arm)
        if true is None:
            raise SystemExit(f"sequence '{sequence.id}' has no true states")
        instrument = dataset.instrument(sequence.entry.instruments[arm])
        estimate.append(instrument.tips_cam(own))
        truth.append(instrument.tips_cam(true[: len(states)]))
    return pair_metrics.exchanged(pair_metrics.tip_distances(np.stack(estimate, axis=1), np.stack(truth, axis=1)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("runs", type=Path, help="runs on pairs of the dataset")
    parser.add_argument("--alone", type=Path, help="runs on its single arms, by the same trackers")
    parser.add_argument("--least", type=int, default=1, help="frames of the shortest overlap (default: 1)")
    arguments = parser.parse_args()
    dataset = open_as(InstrumentDataset, arguments.dataset)
    alone: dict[tuple[str, str, str], dict[str, InstrumentRecord]] = defaultdict(dict)
    for record in read_records([arguments.alone]) if arguments.alone else ():
        if isinstance(record, InstrumentRecord) and len(record.spec.arms) == 1:
            key = record.spec.tracker.name, record.spec.readings, record.spec.sequence
            alone[key][record.spec.arms[0]] = record
    rows: dict[str, Overlaps] = defaultdict(lambda: Overlaps(arguments.least))
    for record in read_records([arguments.runs]):
        if isinstance(record, InstrumentRecord) and len(record.spec.arms) == 2 and record.status == "ok":
            spec = record.spec
            own = alone.get((spec.tracker.name, spec.readings, spec.sequence), {})
            name = f"{spec.row_id}, readings {spec.readings}, masks {spec.masks}"
            rows[name].add(dataset, record, own)
    for name, found in sorted(rows.items()):
        print("\n  ".join([name, *found.lines()]))


if __name__ == "__main__":
    main()
