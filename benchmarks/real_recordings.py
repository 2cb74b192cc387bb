"""Keypoints and tracks on a real recording, which has no ground truth: held against marked tips and joint readings.

    surgbench import masks RECORDING --out data/real          (--single-images for frames that do not follow each other)
    surgbench run --dataset data/real --tracker hybrid --tracker cmaes --out runs/real
    python benchmarks/real_recordings.py data/real runs/real
    python benchmarks/real_recordings.py data/real --tracker hybrid --set hybrid.explained=0.8 --seeds 10

Prints, for each keypoint source, how many frames have both tips within 6 px of the marked ones (where tips are marked)
or have a pair at all; and for each row of the runs how far its joints are from the readings (where there are readings),
the 180-degree twin that is nearer counting, and how steady they are: how much they change from frame to frame, and how
much that change changes.

Then one tracker is run in this process without readings, with several seeds (`--seeds 0`: not at all), and what can be
said of it without truth is printed. Of frames that follow each other:

- the mask error, 1 - IoU with the recorded mask, the mean of all frames and seeds;
- the share of frames in which both jaws are explained: at most a third of either, or of the mask's edge around them,
  has no counterpart within 3 px (the predicted contour once moved outward by the median offset of all edges, for a
  mask that is a little large as a whole says nothing against jaws);
- the standard deviation of each joint over the frames, the mean of the seeds. It holds how the instrument really moves,
  the same for every tracker, and what is wrong in different ways in different views;
- that without the frames in which the wrist is seen edge-on, where the jaws move along the line of sight and no outline
  tells yaw from opening. Edge-on is a frame in which the silhouette's information on q2, the integral along the contour
  of its squared speed, is less than 0.3 of its median over the frames (the median of the seeds; that on q3 is the
  same, for yaw and opening move a jaw alike). In the one video that this was tried on it is 0.18 to 0.24 in one stretch
  of 11 frames, and 0.33 or more in all others. What a tracker states is no such measure, for its motion model is in
  it. Neither is the information on q1: it is small in frames here and there in which the jaws show well, and the
  deviations hardly change without them;
- the standard deviation between the seeds, the mean of the frames.

Of two twins the one counts whose roll is nearer to that of the frame before, and of the first seed. Of frames with
readings, single ones too: in how many all joints are within 0.15 rad of the readings, and which the others are, for
each seed.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surgbench.cli.progress import progress
from surgbench.contract import Mask
from surgbench.dataset.open import open_as
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.keypoints.accuracy import pair_errors
from surgbench.keypoints.found import BOTH
from surgbench.metrics import choose_twin, mask_error
from surgbench.registry import create, find
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.state import JOINTS, twin
from surgbench.suite.asked import Conditions
from surgbench.suite.plan import complete_all
from surgbench.suite.plan import jobs as plan_jobs
from surgbench.suite.settings import Job
from surgbench.suite.suites import parse_sets
from surgbench.tasks.instrument.asked import InstrumentRow
from surgbench.tasks.instrument.dataset import InstrumentDataset, InstrumentUnit
from surgbench.tasks.instrument.in_process import answers
from surgbench.tasks.instrument.recorded_on import records_on
from surgbench.tasks.instrument.units import UnitData
from surgbench.trackers.registration.edges import find_edges, missed_edge, missed_lengths
from surgbench.trackers.registration.jaws import JawJudge

NEAR_PX = 6.0
NEAR_RAD = 0.2
NEARER_RAD = 0.15
EXPLAINED = 1.0 / 3.0  # of the jaws unexplained at most
JAW_PX = 3
REACH_PX = 14  # how far edges are looked for
EDGE_ON = 0.3  # of the median information on q2
YAW = JOINTS.start + 1
SEVERAL = 3  # frames that a standard deviation over them is taken of


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--keypoints", action="append", metavar="NAME", help="default: resnet18 and corners")
    parser.add_argument("--tracker", default="hybrid", metavar="NAME", help="run in this process; default: hybrid")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="runs of it; default: 5, 0: none")
    parser.add_argument("--set", action="append", default=[], metavar="NAME.option=value", help="of the tracker's row")
    options = parser.parse_args()
    dataset = open_as(InstrumentDataset, options.dataset)
    for name in options.keypoints or ["resnet18", "corners"]:
        keypoints(dataset, name)
    tracks(dataset, options.runs)
    if options.seeds:
        without_truth(dataset, options.tracker, parse_sets(options.set), options.seeds)
    return 0


def keypoints(dataset: InstrumentDataset, name: str) -> None:
    source = create(find("keypoints", name), {})
    pairs, frames, marked, errors = 0, 0, 0, []
    for unit in dataset.units():
        data = UnitData(dataset, unit, "none")
        marks = data.sequence.keypoints(unit.arms[0])
        source.reset(data.scene())
        for frame in range(data.frames):
            observation = data.observation(frame)
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
    changes: dict[str, list[FloatArray]] = defaultdict(list)
    off: dict[str, list[FloatArray]] = defaultdict(list)
    for record, unit in records_on(dataset, runs):
        row, states = record.spec.row_id, record.frames.states
        if not len(states):
            print(f"{row} {unit.id}: {record.status}: {record.error}")
            continue
        readings = dataset.sequence(unit.sequence).readings(unit.arms[0])
        if readings is not None:
            nearer = off_readings(states, readings[: len(states)])
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


def off_readings(states: FloatArray, readings: FloatArray) -> FloatArray:
    """How far joints are from the readings, ``(T, 3)`` rad, of the twin that is nearer."""
    both = np.abs(np.stack([states, twin(states)])[..., JOINTS] - readings)
    return np.asarray(both[np.argmin(both.max(axis=2), axis=0), np.arange(len(states))])


def without_truth(dataset: InstrumentDataset, tracker: str, options: dict[str, Any], seeds: int) -> None:
    """Run a tracker with several seeds, and print what can be said of it without truth."""
    states = run(dataset, tracker, options, seeds)
    for unit in dataset.units():
        if states[unit.id].shape[1] >= SEVERAL:
            video(UnitData(dataset, unit, "none"), tracker, states[unit.id])
    near_readings(dataset, tracker, states)


def run(dataset: InstrumentDataset, tracker: str, options: dict[str, Any], seeds: int) -> dict[str, FloatArray]:
    """Unit to its ``(seeds, T, 9)`` states."""
    planned = []
    for seed in range(seeds):
        conditions = Conditions(seed=seed)
        row = InstrumentRow(tracker=tracker, initialiser="random")
        (settings,) = complete_all([row], conditions, dataset, options)
        planned.append(plan_jobs(settings, dataset))
    states: dict[str, list[FloatArray]] = defaultdict(list)
    with progress(f"{tracker}, frames", sum(job.frames for jobs in planned for job in jobs)) as bar:
        for jobs in planned:
            for job in jobs:
                states[job.unit.id].append(follow(job, dataset, bar))
    return {unit: np.stack(per_seed) for unit, per_seed in states.items()}


def follow(job: Job, dataset: InstrumentDataset, advance: Callable[[float], None]) -> FloatArray:
    """A job's states, ``(T, 9)``."""
    states = []
    for answer in answers(job, dataset):
        states.append(answer.state)
        advance(1)
    return np.stack(states)


class Seen(NamedTuple):
    """What a mask says of a state."""

    mask_error: float
    jaws_unexplained: float
    yaw_information: float


def video(data: UnitData, tracker: str, states: FloatArray) -> None:
    """Print how well and how steadily ``(seeds, T, 9)`` states follow a unit's masks."""
    masks = [data.sequence.mask(data.unit.kind, frame) for frame in range(states.shape[1])]
    judge = Judge(data)
    seen = [[judge(state, mask) for state, mask in zip(track, masks, strict=True)] for track in states]
    errors, unexplained, information = np.moveaxis(np.array(seen), 2, 0)
    edge_on = seen_edge_on(information)
    joints = same_twins(states)[..., JOINTS]
    who = f"{tracker} {data.unit.id}"
    print(f"{who}: mask error {errors.mean():.4f}, of each seed {np.round(errors.mean(axis=1), 4).tolist()}")
    explained = (unexplained <= EXPLAINED).mean(axis=1)
    print(f"{who}: both jaws explained in {explained.mean():.1%} of frames, of each seed {_percent(explained)}")
    print(f"{who}: seen edge-on in {edge_on.sum()} of {len(edge_on)} frames: {_stretches(edge_on)}")
    print(f"{who}: standard deviation of q1, q2, q3 over the frames {_joints(joints.std(axis=1))} rad")
    print(f"{who}: and without those seen edge-on {_joints(joints[:, ~edge_on].std(axis=1))} rad")
    if len(states) > 1:
        between = joints.std(axis=0, ddof=1)
        print(
            f"{who}: between {len(states)} seeds {_joints(between)} rad, "
            f"and without those seen edge-on {_joints(between[~edge_on])} rad"
        )


class Judge:
    """Holds states of a unit of one arm against its masks."""

    def __init__(self, data: UnitData) -> None:
        self._evaluator = SilhouetteEvaluator(data.instruments, data.camera)
        self._jaws = JawJudge(data.instruments, data.camera)
        self._links = (1, len(data.instruments[0].spec.links))

    def __call__(self, state: FloatArray, mask: Mask) -> Seen:
        """Of one ``(9,)`` state and the mask of its frame."""
        evaluator = self._evaluator
        reference = Reference(mask)
        score = evaluator.score(state[None], reference)
        contour = evaluator.contour_points(state, 1)
        offsets = find_edges(contour, mask, REACH_PX)
        found = offsets[np.isfinite(offsets)]
        common_px = float(np.median(found)) if len(found) else 0.0
        missed_px, length_px = missed_lengths(contour, offsets, common_px, float(JAW_PX), self._links)
        missed = missed_edge(mask, evaluator.mask(state), JAW_PX, JAW_PX)
        return Seen(
            mask_error=float(mask_error(score.area[0], reference.area, score.overlap[0])),
            jaws_unexplained=self._jaws(state, missed_px, length_px, missed),
            yaw_information=float(contour.lengths_px @ contour.jacobian[:, YAW] ** 2),
        )


def seen_edge_on(information: FloatArray) -> NDArray[np.bool_]:
    """In which of T frames the wrist is seen edge-on, by ``(seeds, T)`` information on q2."""
    typical = np.median(information, axis=0)
    return np.asarray(typical < EDGE_ON * np.median(typical))


def same_twins(states: FloatArray) -> FloatArray:
    """``(seeds, T, 9)`` states, of each that twin which goes on from the first seed's frame before."""
    first = states[0].copy()
    for frame in range(1, len(first)):
        first[frame] = choose_twin(first[frame], first[frame - 1])
    return np.asarray(choose_twin(states, np.broadcast_to(first, states.shape)))


def near_readings(dataset: InstrumentDataset, tracker: str, states: dict[str, FloatArray]) -> None:
    """Print, for each seed, in which frames with readings a joint is far from them."""
    units = [(unit, readings_of(dataset, unit)) for unit in dataset.units()]
    read = [(unit, readings) for unit, readings in units if readings is not None]
    if not read:
        return
    for seed in range(len(next(iter(states.values())))):
        frames, far = 0, []
        for unit, readings in read:
            most = off_readings(states[unit.id][seed], readings).max(axis=1)
            frames += int(np.isfinite(most).sum())
            single = len(most) == 1
            far += [
                f"{unit.id}{'' if single else f' frame {frame}'} ({most[frame]:.2f})"
                for frame in np.flatnonzero(most > NEARER_RAD)
            ]
        print(
            f"{tracker}, seed {seed}: all joints within {NEARER_RAD:g} rad of the readings in {frames - len(far)} of "
            f"{frames} frames" + (f"; not in {', '.join(far)}" if far else "")
        )


def readings_of(dataset: InstrumentDataset, unit: InstrumentUnit) -> FloatArray | None:
    """``(T, 3)`` joint readings of a unit of one arm, NaN where a frame has none; ``None`` where none has."""
    readings = dataset.sequence(unit.sequence).readings(unit.arms[0])
    return None if readings is None or not np.isfinite(readings).any() else readings


def _joints(values: FloatArray) -> list[float]:
    """Means of ``(n, 3)`` values."""
    return [float(value) for value in np.round(values.mean(axis=0), 4)]


def _percent(shares: FloatArray) -> str:
    return ", ".join(f"{share:.1%}" for share in shares)


def _stretches(flags: NDArray[np.bool_]) -> str:
    """Frames with a flag, as ``3-7, 12``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    pairs = [(first, end - 1) for first, end in zip(edges[::2], edges[1::2], strict=True)]
    return ", ".join(f"{first}-{last}" if last > first else f"{first}" for first, last in pairs) or "none"


if __name__ == "__main__":
    try:
        sys.exit(main())
    except SurgbenchError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
