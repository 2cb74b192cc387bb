"""What `surgbench handeye` is worth against the truth of synthetic arms; our forward kinematics against a robot's.

    surgbench generate paper-rcm --sequences 2 --frames 300 --out data/rcm
    surgbench run --dataset data/rcm --suite SUITE.yaml --out runs/rcm       (rows of table1 that get no kinematics)
    python benchmarks/handeye.py data/rcm runs/rcm
    python benchmarks/handeye.py --robot readings.csv --arm classic_400006

Prints Markdown. Of a dataset with truth and of runs on it:

- injected lags: `--count` runs of the row `--row`, its units in turn, with the readings of the arm moved by lags drawn
  evenly from -10 to 10 frames. A tracker does not see these readings, so that each run serves many times. Printed are
  the errors of the lag, how often its interval holds the truth, and how far the hand-eye transform is from the truth,
  as a rotation and at the tool's mean position. The truth is the one constant transform that takes the readings, as
  generated and at their own time, to the true poses, in the sense of most frames (`robust_fit`): what is constant in
  the readings' errors, a bias of an encoder or the mean stretch of a cable, is no tracker's fault and cannot be told
  from the calibration;
- the ranking: of each row the mean over units of the median residuals, the mean over units of the true errors, and
  Spearman's rank correlation of the two. Rows that were given the arm's readings are left out.

Of a CSV of a robot (columns `measured_q1` to `measured_q6`, radians and metres, `measured_x`, `_y`, `_z`, metres, and
`measured_rx`, `_ry`, `_rz`, a rotation vector), how far our forward kinematics is from the pose that it reported.

What came out stands in docs/handeye.md.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from scipy.stats import spearmanr

from surgbench.dataset.open import open_as
from surgbench.errors import SurgbenchError
from surgbench.geometry import (
    FloatArray,
    inverse_transform,
    look_at_rotation,
    rigid_transform,
    rotation_angle,
    rotation_from_vector,
)
from surgbench.handeye import HandEye, ReadingTrack, estimate_hand_eye
from surgbench.handeye.fit import NOMINAL, robust_fit
from surgbench.instrument.arms import load_arm
from surgbench.records.reader import read_records_of
from surgbench.state import ANGLES, POSITION
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.format import Arm
from surgbench.tasks.instrument.judge import was_given
from surgbench.tasks.instrument.records import InstrumentRecord

LAGS_FRAMES = 10.0


class Unit(NamedTuple):
    """An arm of a run, what was estimated, true and read of it."""

    record: InstrumentRecord
    times_s: FloatArray
    dt_s: float
    tracked: FloatArray
    true: FloatArray
    readings: FloatArray

    def judged(self, lag_frames: float) -> HandEye:
        """With readings that are late by so much."""
        late = ReadingTrack(self.times_s, self.readings, self.dt_s).at(self.times_s - lag_frames * self.dt_s)
        counts = ~np.array(self.record.frames.lost, dtype=bool)
        return estimate_hand_eye(self.times_s, self.tracked, late, self.dt_s, counts)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, nargs="?")
    parser.add_argument("runs", type=Path, nargs="*")
    parser.add_argument("--row", default="hybrid")
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--robot", type=Path)
    parser.add_argument("--arm", default="classic_400006")
    asked = parser.parse_args()
    try:
        if asked.robot is not None:
            print_robot(asked.robot, asked.arm)
        if asked.dataset is not None:
            units = list(read_units(open_as(InstrumentDataset, asked.dataset), asked.runs))
            print_lags([unit for unit in units if unit.record.spec.row_id == asked.row], asked.count)
            print_ranking(units)
    except SurgbenchError as error:
        print(f"{error}", file=sys.stderr)
        return 2
    return 0


def read_units(dataset: InstrumentDataset, runs: list[Path]) -> Iterator[Unit]:
    """Sound runs of one arm."""
    for record in read_records_of(InstrumentRecord, runs):
        sequence, arm = dataset.sequence(record.spec.sequence), cast(Arm, record.spec.arms[0])
        true, readings = sequence.states(arm), sequence.kinematics(arm)
        given = was_given(record.spec.readings, record.references)
        if record.status == "ok" and not given and true is not None and readings is not None:
            done = slice(len(record.frames.index))
            states = (record.frames.states, true[done])
            tracked, exact = (rigid_transform(look_at_rotation(one[:, ANGLES]), one[:, POSITION]) for one in states)
            yield Unit(record, sequence.timestamps_s[done], sequence.dt_s, tracked, exact, readings[done])


def print_lags(units: list[Unit], count: int) -> None:
    """Errors of lag and hand-eye transform where lags are injected."""
    rng = np.random.default_rng(0)
    lags, held, turned, moved = [], [], [], []
    for index in range(count):
        unit, lag = units[index % len(units)], rng.uniform(-LAGS_FRAMES, LAGS_FRAMES)
        found = unit.judged(lag)
        true = robust_fit(unit.true, unit.readings, NOMINAL)
        middle = true[:3, :3] @ found.middle_base_m + true[:3, 3]
        change = found.T_cam_base @ inverse_transform(true)
        low, high = found.lag_interval_frames
        lags.append(found.lag_frames - lag)
        held.append(low <= lag <= high)
        turned.append(np.degrees(rotation_angle(change[:3, :3])))
        moved.append(1e3 * np.linalg.norm(change[:3, :3] @ middle + change[:3, 3] - middle))
    print(f"{count} runs of `{units[0].record.spec.row_id}`, lags from {-LAGS_FRAMES:g} to {LAGS_FRAMES:g} frames\n")
    print("| | median | largest |\n|---|---|---|")
    for name, values in (
        ("lag, frames", np.abs(lags)),
        ("hand-eye, degrees", np.array(turned)),
        ("hand-eye at the tool, mm", np.array(moved)),
    ):
        print(f"| {name} | {np.median(values):.2f} | {values.max():.2f} |")
    within = (int((np.abs(lags) <= 0.5).sum()), int(((np.array(turned) <= 1) & (np.array(moved) <= 1)).sum()))
    print(f"\nlag within 0.5 frame: {within[0]}; hand-eye within 1 degree and 1 mm: {within[1]}; ", end="")
    print(f"interval holds the lag: {sum(held)}\n", flush=True)


def print_ranking(units: list[Unit]) -> None:
    """Residuals beside true errors."""
    found = defaultdict(list)
    for unit in units:
        judged, errors = unit.judged(0.0), unit.record.errors
        true = (np.nanmean(errors["rotation_error_rad"]), np.nanmean(errors["translation_error_m"]))
        left = (np.median(judged.rotation_rad), np.median(judged.translation_m), judged.lag_frames)
        found[unit.record.spec.row_id].append(np.array([*true, *left], dtype=np.float64))
    means = {name: np.mean(np.stack(values), axis=0) for name, values in found.items()}
    print("| row | rotation, rad: true | residual | translation, mm: true | residual | lag found, frames |")
    print("|---|---|---|---|---|---|")
    for name, (turn, place, turn_left, place_left, lag) in sorted(means.items(), key=lambda item: item[1][1]):
        print(f"| `{name}` | {turn:.4f} | {turn_left:.4f} | {1e3 * place:.2f} | {1e3 * place_left:.2f} | {lag:.2f} |")
    table = np.array(list(means.values()))
    for name, column in (("rotation", 0), ("translation", 1)):
        print(f"\nSpearman, {name}: {spearmanr(table[:, column], table[:, column + 2])[0]:.3f} ({len(table)} rows)")


def print_robot(path: Path, arm: str) -> None:
    """Our forward kinematics beside the robot's."""
    rows = np.genfromtxt(path, delimiter=",", names=True)
    joints = np.stack([rows[f"measured_q{joint}"] for joint in range(1, 7)], axis=1)
    place = np.stack([rows[f"measured_{axis}"] for axis in "xyz"], axis=1)
    turn = rotation_from_vector(np.stack([rows[f"measured_r{axis}"] for axis in "xyz"], axis=1))
    tip = load_arm(arm).forward_tip(joints)
    moved = 1e3 * np.linalg.norm(tip[:, :3, 3] - place, axis=1)
    turned = rotation_angle(np.swapaxes(tip[:, :3, :3], 1, 2) @ turn)
    print(f"{len(rows)} poses of a robot, `{arm}`: ", end="")
    print(f"median {np.median(moved):.5f} mm and {np.median(turned):.1e} rad, ", end="")
    print(f"largest {moved.max():.3f} mm and {turned.max():.1e} rad\n")


if __name__ == "__main__":
    sys.exit(main())
