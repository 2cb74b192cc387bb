"""``surgbench handeye``: recorded runs held against the readings of their recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

from surgbench.dataset.open import open_as
from surgbench.dataset.storage import check_new
from surgbench.errors import DatasetError, SurgbenchError
from surgbench.handeye import TooLittleMotionError
from surgbench.handeye.table import Judged
from surgbench.state import split_arms
from surgbench.tasks.instrument.aligned import write_aligned
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.format import Arm
from surgbench.tasks.instrument.judge import frames_that_count, judge, was_given
from surgbench.tasks.instrument.records import InstrumentRecord

GIVEN = "was given the arm's readings (--joints) and names them in its code: it can't be judged by them"


def hand_eye(
    records: Sequence[InstrumentRecord],
    dataset: Path | None,
    fix_lag: Path | None,
    progress: Callable[[str, float], Any],
) -> list[Judged]:
    """Judge runs, and where asked to write their dataset with its readings where they belong.

    Args:
        records: Of one dataset where ``dataset`` or ``fix_lag`` is given.
        dataset: Where it is; where each record says, unless told.
        fix_lag: Folder to write to.
        progress: Takes a description and a number; gives what takes the part just done.

    Returns:
        One entry for each run and arm, in the order of the records.

    Raises:
        SurgbenchError: The dataset is not there, another one or without readings, or no run says anything of it; one
            line.
    """
    if fix_lag is not None:
        check_new(fix_lag, "--fix-lag")
    opened: dict[str, InstrumentDataset] = {}
    sound = [record for record in records if record.frames.index]
    if not sound:
        raise DatasetError(f"{records[0].path}: failed, like all runs here; nothing to judge")
    judged: list[Judged] = []
    with progress("runs", len(sound)) as advance:
        for record in sound:
            sha256 = record.spec.dataset.sha256
            if sha256 not in opened:
                opened[sha256] = _open(record, dataset)
            judged += _judge_run(record, opened[sha256])
            advance(1)
    if all(one.found is None for one in judged):
        raise SurgbenchError(judged[0].note)
    if fix_lag is not None:
        if len(opened) > 1:
            raise SurgbenchError("--fix-lag: runs of several datasets; give the runs of one")
        (source,) = opened.values()
        write_aligned(source, best_lags(judged, sound, source), fix_lag)
    return judged


def best_lags(
    judged: Sequence[Judged], records: Sequence[InstrumentRecord], dataset: InstrumentDataset
) -> dict[tuple[str, Arm], float]:
    """The lag of each sequence and arm: that of the run which leaves least, relative to the others, between the two.

    A tracker that trails behind the pictures makes readings look early; the one that fits best does so least.

    Raises:
        SurgbenchError: Nothing is known of one; one line that names it.
    """
    sequence_of = {(record.spec.unit): record.spec.sequence for record in records}
    best: dict[tuple[str, Arm], Judged] = {}
    for one in judged:
        if one.found is not None:
            place = (sequence_of[one.unit], cast(Arm, one.arm))
            if place not in best or _left(one) < _left(best[place]):
                best[place] = one
    for sequence in dataset.sequences:
        for arm in sequence.arms:
            if (sequence.id, arm) not in best:
                why = next((f": {one.note}" for one in judged if sequence_of[one.unit] == sequence.id and one.note), "")
                raise SurgbenchError(
                    f"--fix-lag: no run tells the lag of sequence '{sequence.id}', {arm} arm{why or '; run one there'}"
                )
    return {place: one.found.lag_frames for place, one in best.items() if one.found is not None}


def _left(one: Judged) -> float:
    assert one.found is not None
    return float(one.found.translation_m.mean())


def _open(record: InstrumentRecord, dataset: Path | None) -> InstrumentDataset:
    place = dataset or (None if record.dataset_path is None else Path(record.dataset_path))
    if place is None or not place.is_dir():
        raise DatasetError(f"{place or record.path}: the runs' dataset is not there; tell where with --dataset PATH")
    opened = open_as(InstrumentDataset, place)
    if opened.hash != record.spec.dataset.sha256:
        raise DatasetError(f"{place}: not the dataset of the run '{record.spec.row_id}' (another hash)")
    return opened


def _judge_run(record: InstrumentRecord, dataset: InstrumentDataset) -> list[Judged]:
    spec, sequence = record.spec, dataset.sequence(record.spec.sequence)
    states = split_arms(record.frames.states)
    shown = record.errors.get("mask_error", [0.0] * len(states))
    counts = frames_that_count(record.frames.lost or [False] * len(states), shown)
    found = []
    for index, name in enumerate(spec.arms):
        arm, estimate, note = cast(Arm, name), None, ""
        if was_given(spec.readings, record.references):
            note = f"{spec.row_id}, {spec.unit}: {GIVEN}"
        else:
            try:
                estimate = judge(
                    sequence, arm, dataset.instrument(sequence.entry.instruments[arm]), states[:, index], counts
                )
            except TooLittleMotionError as error:
                note = str(error)
        found.append(Judged(spec.row_id, spec.unit, arm, spec.repeat, sequence.dt_s, estimate, note))
    return found
