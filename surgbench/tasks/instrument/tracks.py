"""States of single arms over time, from a dataset's truth or from the records of a run, in one shape for exporters."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray, rigid_transform
from surgbench.instrument import Instrument
from surgbench.report.recorded import open_recorded
from surgbench.state import STATE_SIZE
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.format import ARMS, Arm
from surgbench.tasks.instrument.records import InstrumentRecord

# What rows are named by: the first of these under which no two are named alike.
NAMES = ("{row}", "{row}-r{repeat}", "{row}-{settings}-r{repeat}", "{dataset}-{row}-{settings}-{arms}-r{repeat}")


@dataclass(frozen=True)
class Track:
    """The states of one arm in one sequence, frame by frame.

    Attributes:
        sequence: The sequence's id.
        place: Its place in the dataset, from 0.
        arm: Which arm.
        instrument: What it holds.
        camera: The view that states are given in.
        frames: ``(T,)`` frame numbers.
        timestamps_s: ``(T,)`` seconds since the sequence's first frame.
        states: ``(T, 9)``.
        confidence: ``(T,)``; ``None`` for the truth, and so are all that follow.
        lost: ``(T,)`` bool: the tracker thinks that it has lost the instrument.
        latency_ms: ``(T,)``, NaN where it was not measured.
        deviations: ``(T, 9)`` standard deviations, NaN where a frame has none.
    """

    sequence: str
    place: int
    arm: Arm
    instrument: Instrument
    camera: Camera
    frames: NDArray[np.int64]
    timestamps_s: FloatArray
    states: FloatArray
    confidence: FloatArray | None = None
    lost: NDArray[np.bool_] | None = None
    latency_ms: FloatArray | None = None
    deviations: FloatArray | None = None

    def tips(self) -> FloatArray:
        """``(T, 2, 4, 4)`` T_cam_tip: the two tips, each turned as the link that it is fixed to."""
        transforms = self.instrument.link_transforms(self.states)
        places = self.instrument.tips_cam(self.states)
        links = [self.instrument.link_index[tip.link] for tip in self.instrument.tips]
        return rigid_transform(transforms[:, links, :3, :3], places)


@dataclass(frozen=True)
class Row:
    """What one tracker with its settings estimated in one repeat, over all units that there are records of.

    Attributes:
        name: Tells it apart from the others; fit for a file.
        dataset: What it was made on.
        records: One per unit.
    """

    name: str
    dataset: InstrumentDataset
    records: tuple[InstrumentRecord, ...]

    def tracks(self) -> list[Track]:
        """All arms of all units."""
        return [track for record in self.records for track in record_tracks(record, self.dataset)]


def rows_of(records: Iterable[InstrumentRecord], moved: Path | None = None) -> list[Row]:
    """Records sorted by rows.

    Args:
        records: In a fixed order.
        moved: Where their dataset is, if not where they say.

    Returns:
        In the order of their first records. A row is named by its row id; by more where two would be named alike.

    Raises:
        DatasetError: A dataset is not there, or not as it was; a record does not fit it.
    """
    groups: dict[tuple[str, str, str, str, int], list[InstrumentRecord]] = {}
    for record in records:
        spec = record.spec
        arms = "single" if len(spec.arms) == 1 else "dual"
        key = (spec.dataset.sha256, spec.row_id, record.settings_hash, arms, spec.repeat)
        groups.setdefault(key, []).append(record)
    datasets = open_recorded(InstrumentDataset, (group[0] for group in groups.values()), moved)
    groups = {key: group for key, group in groups.items() if key[0] in datasets}
    for form in NAMES:
        names = [
            form.format(dataset=datasets[sha256].name, row=row, settings=settings[:8], arms=arms, repeat=repeat)
            for sha256, row, settings, arms, repeat in groups
        ]
        if len(set(names)) == len(names):
            break
    return [Row(name, datasets[key[0]], tuple(groups[key])) for name, key in zip(names, groups, strict=True)]


def truth_tracks(dataset: InstrumentDataset) -> list[Track]:
    """The truth of all arms of a dataset; sequences that have none are left out."""
    tracks = []
    for place, sequence in enumerate(dataset.sequences):
        for arm in sequence.arms:
            states = sequence.states(arm)
            if states is not None:
                instrument = dataset.instrument(sequence.entry.instruments[arm])
                frames = np.arange(sequence.frames)
                tracks.append(
                    Track(sequence.id, place, arm, instrument, sequence.camera, frames, sequence.timestamps_s, states)
                )
    return tracks


def record_tracks(record: InstrumentRecord, dataset: InstrumentDataset) -> list[Track]:
    """The estimates of one run, arm by arm.

    Raises:
        DatasetError: The record has frames or arms that the dataset has not.
    """
    spec, frames = record.spec, record.frames
    sequence = dataset.sequence(spec.sequence)
    index = np.array(frames.index, dtype=np.int64)
    if index.size and not (index.min() >= 0 and index.max() < sequence.frames):
        raise DatasetError(f"{record.path}: has frame {index.max()}; sequence '{sequence.id}' has {sequence.frames}")
    arms = [arm for arm in ARMS if arm in spec.arms]
    states = frames.states.reshape(len(index), len(arms), STATE_SIZE)
    deviations = _deviations(frames.standard_deviations, states.shape)
    place = [one.id for one in dataset.sequences].index(sequence.id)
    tracks = []
    for number, arm in enumerate(arms):
        if arm not in sequence.arms:
            raise DatasetError(f"{record.path}: has a {arm} arm; sequence '{sequence.id}' has none")
        tracks.append(
            Track(
                sequence=sequence.id,
                place=place,
                arm=arm,
                instrument=dataset.instrument(sequence.entry.instruments[arm]),
                camera=sequence.camera,
                frames=index,
                timestamps_s=sequence.timestamps_s[index],
                states=states[:, number],
                confidence=frames.confidence_of(number),
                lost=frames.lost_of(number),
                latency_ms=_numbers(frames.latency_ms, len(index)),
                deviations=None if deviations is None else deviations[:, number],
            )
        )
    return tracks


def _numbers(values: Sequence[float | None], count: int) -> FloatArray:
    return np.array([np.nan if value is None else value for value in values or [None] * count], dtype=np.float64)


def _deviations(given: Sequence[list[float] | None], shape: tuple[int, ...]) -> FloatArray | None:
    if all(one is None for one in given):
        return None
    unknown = [np.nan] * int(np.prod(shape[1:]))
    return np.array([unknown if one is None else one for one in given], dtype=np.float64).reshape(shape)
