"""Keypoints and tracks on a real recording, which has no ground truth: held against marked tips and joint readings.

    surgbench import masks RECORDING --out data/real          (--single-images for frames that do not follow each other)
    surgbench run --dataset data/real --tracker hybrid --tracker cmaes --out runs/real
    python benchmarks/real_recordings.py data/real runs/real

Prints, for each keypoint source, how many frames have both tips within 6 px of the marked ones (where tips are marked)
or have a pair at all; and for each row of the runs how far its joints are from the readings (where there are readings),
the 180-degree twin that is nearer counting, and how steady they are: how much they change from frame to frame, and how
much that change changes.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from surgbench.dataset.open import open_as
from surgbench.geometry import FloatArray
from surgbench.keypoints.accuracy import pair_errors
from surgbench.keypoints.found import BOTH
from surgbench.records.reader import read_records
from surgbench.registry import create, find
from surgbench.state import JOINTS, twin
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.records import InstrumentRecord
from surgbench.tasks.instrument.units import UnitData

NEAR_PX = 6.0
NEAR_RAD = 0.2


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--keypoints", action="append", metavar="NAME", help="default: resnet18 and corners")
    options = parser.parse_args()
    dataset = open_as(InstrumentDataset, options.dataset)
    for name in options.keypoints or ["resnet18", "corners"]:
        keypoints(dataset, name)
    tracks(dataset, options.runs)
    return 0


def keypoints(dataset: InstrumentDataset, name: str) -> None:
    source = create(find("keypoints", name), {})
    pairs, frames, marked, errors = 0, 0, 0, []
    for unit in dataset.units():
        data = UnitData(dataset, unit, "none")
        marks = data.sequence.keypoints(unit.arms[0])
        source.reset(data.scene())
        for frame in range(data.frames):
            observation = data.observation(frame, data.sequence.mask(unit.kind, frame))
            (tips,) = source.detect(observation, observation.views[0])
            pair = tips if tips is not None and len(tips) == BOTH else None
            frames += 1
            pairs += pair is not None
            if np.isfinite(marks[frame]).all():
                marked += 1
                if pair is not None:
                    errors.append(pair_errors(pair, marks[frame]))
                    print(f"{name} {unit.id} frame {frame}: {np.round(errors[-1], 1).tolist()} px from the marks")
                else:
                    print(f"{name} {unit.id} frame {frame}: no pair")
    print(f"{name}: a pair in {pairs} of {frames} frames")
    if marked:
        near = sum(bool((error <= NEAR_PX).all()) for error in errors)
        print(f"{name}: both tips within {NEAR_PX:g} px of the marks in {near} of {marked} frames")


def tracks(dataset: InstrumentDataset, runs: list[Path]) -> None:
    units = {unit.id: unit for unit in dataset.units()}
    changes: dict[str, list[FloatArray]] = defaultdict(list)
    off: dict[str, list[FloatArray]] = defaultdict(list)
    for record in read_records(runs) if runs else []:
        if not isinstance(record, InstrumentRecord) or record.spec.dataset.sha256 != dataset.hash:
            continue
        row, unit = record.spec.row_id, units[record.spec.unit]
        states = record.frames.states
        if not len(states):
            print(f"{row} {unit.id}: {record.status}: {record.error}")
            continue
        readings = dataset.sequence(unit.sequence).readings(unit.arms[0])
        if readings is not None:
            both = np.abs(np.stack([states, twin(states)])[..., JOINTS] - readings[: len(states)])
            nearer = both[np.argmin(both.max(axis=2), axis=0), np.arange(len(states))]
            off[row].append(nearer)
            print(f"{row} {unit.id}: {np.round(nearer.max(axis=0), 3).tolist()} rad from the readings")
        if len(states) > 2:
            changes[row].append(states[:, JOINTS])
    for row, parts in off.items():
        every = np.concatenate(parts)
        inside = int((every <= NEAR_RAD).all(axis=1).sum())
        print(
            f"{row}: all joints within {NEAR_RAD:g} rad of the readings in {inside} of {len(every)} frames; "
            f"mean {np.round(every.mean(axis=0), 3).tolist()}, most {np.round(every.max(axis=0), 3).tolist()} rad"
        )
    for row, parts in changes.items():
        first = np.concatenate([np.abs(np.diff(part, axis=0)) for part in parts])
        second = np.concatenate([np.abs(np.diff(part, 2, axis=0)) for part in parts])
        print(
            f"{row}: from frame to frame joints change by {np.round(np.median(first, axis=0), 4).tolist()} rad "
            f"(median), {np.round(np.percentile(first, 95, axis=0), 4).tolist()} (95 %), {first.max():.3f} (most); "
            f"that change by {np.round(np.median(second, axis=0), 4).tolist()} (median)"
        )


if __name__ == "__main__":
    sys.exit(main())
