"""Sequences and runs of the instrument task put on a stage: pictures, outlines, instruments in space, errors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.dataset.masks import read_bytes
from surgbench.errors import NotFoundError, unknown_name
from surgbench.geometry import FloatArray, inverse_transform
from surgbench.instrument import Instrument
from surgbench.report.drawing import REFERENCE_COLOUR, Colour, contours
from surgbench.report.recorded import choose_runs
from surgbench.report.stage import Stage, Subject, others
from surgbench.state import STATE_SIZE
from surgbench.tasks.instrument.dataset import InstrumentDataset, InstrumentUnit
from surgbench.tasks.instrument.dataset import Sequence as Recording
from surgbench.tasks.instrument.records import InstrumentRecord
from surgbench.tasks.instrument.scenery import Scenery, Shot
from surgbench.tasks.instrument.video import make_shots

# How far before a camera its picture hangs: beyond the instruments, so that they stand before it.
PLANE_M = 0.2
TIP_RADIUS_M = 0.0008
TRUTH, ROWS, ERRORS, CAMERA = "truth", "rows", "errors", "camera"


@dataclass(frozen=True)
class Viewed:
    """One unit, and what ran on it.

    Attributes:
        name: Its part of all paths.
        dataset: Of it.
        unit: Which.
        records: Runs on it; none where the dataset is looked at.
    """

    name: str
    dataset: InstrumentDataset
    unit: InstrumentUnit
    records: tuple[InstrumentRecord, ...] = ()

    @cached_property
    def recording(self) -> Recording:
        """Its sequence."""
        return self.dataset.sequence(self.unit.sequence)

    @property
    def instruments(self) -> list[Instrument]:
        """Of its arms."""
        return [self.dataset.instrument(self.recording.entry.instruments[arm]) for arm in self.unit.arms]


def view(subject: Subject, stage: Stage, progress: Callable[[str, float], Any]) -> list[str]:
    """Put what is asked for on a stage; see :meth:`surgbench.task.Task.view`."""
    chosen, names = choose(subject)
    with progress("frames", sum(viewed.recording.frames for viewed in chosen)) as advance:
        for viewed in chosen:
            put(viewed, stage, subject.every, advance)
    return others(names, [viewed.name for viewed in chosen], subject)


def choose(subject: Subject) -> tuple[list[Viewed], list[str]]:
    """What is put on the stage: the units that are asked for, the first one where none is.

    Returns:
        The units, and the ids of all that there are.

    Raises:
        NotFoundError: A unit or row that is not there.
        DatasetError: The dataset of the runs is not there, or has changed.
    """
    if subject.dataset is None:
        records: Sequence[Any] = [record for record in subject.records if record.frames.index]
        jobs = choose_runs(InstrumentDataset, records, subject.units, subject.rows, subject.moved)
        names = [job.name for job in jobs]
        found = [
            Viewed(
                job.name,
                job.dataset,
                InstrumentUnit(spec.unit, spec.sequence, spec.arms, spec.mask_kind),
                job.records,
            )
            for job in jobs
            for spec in [job.records[0].spec]
        ]
        return found if subject.units else found[:1], names
    dataset = subject.dataset
    assert isinstance(dataset, InstrumentDataset)
    units = {unit.id: unit for unit in _units(dataset)}
    for name in subject.units:
        if name not in units:
            raise NotFoundError(unknown_name("unit", name, units))
    chosen = subject.units or tuple(units)[:1]
    return [Viewed(name, dataset, units[name]) for name in chosen], list(units)


def _units(dataset: InstrumentDataset) -> Iterator[InstrumentUnit]:
    """Whole sequences, with both of two arms, before their single arms."""
    for sequence in dataset.sequences:
        arms = sequence.arms
        yield InstrumentUnit(sequence.id, sequence.id, arms, "both" if len(arms) > 1 else arms[0])
        if len(arms) > 1:
            yield from (InstrumentUnit(f"{sequence.id}-{arm}", sequence.id, (arm,), arm) for arm in arms)


def put(viewed: Viewed, stage: Stage, every: int, advance: Callable[[float], None]) -> None:
    """Put a unit on the stage.

    Args:
        viewed: Which, and what ran on it.
        stage: Where.
        every: Every so many frames have pictures and outlines.
        advance: Called with the number of frames just done.
    """
    recording = viewed.recording
    root: list[object] = [viewed.name]
    seconds = recording.timestamps_s
    stage.put(root, stage.rr.ViewCoordinates.RDF)
    stage.camera([*root, CAMERA], recording.camera, PLANE_M)
    stage.space(root, f"{viewed.name}: in space")
    stage.picture([*root, CAMERA], f"{viewed.name}: as the camera saw it")
    truth = [recording.states(arm) for arm in viewed.unit.arms]
    for arm, instrument, states in zip(viewed.unit.arms, viewed.instruments, truth, strict=True):
        if states is not None:
            _put_instrument(stage, [*root, TRUTH, arm], instrument, states, np.arange(len(states)), seconds)
    for name in recording.entry.auxiliary:
        _put_view(stage, root, viewed, name)
    shots = make_shots(viewed.records)
    for shot in shots:
        _put_row(stage, root, viewed, shot)
    if shots:
        for error in _errors(viewed.records):
            stage.curves([*root, ERRORS, error], error)
    _put_pictures(stage, root, viewed, shots, every, advance)


def _put_instrument(
    stage: Stage,
    place: list[object],
    instrument: Instrument,
    states: FloatArray,
    frames: NDArray[np.int64],
    seconds: FloatArray,
    colour: Colour = REFERENCE_COLOUR,
) -> None:
    """Its bodies, which links move, and its tips; in the camera's frame."""
    transforms = instrument.link_transforms(states)
    times = seconds[frames]
    for link, mesh in instrument.meshes.items():
        stage.body([*place, link], mesh.vertices_m, mesh.faces, np.array(colour, dtype=np.uint8))
        stage.poses([*place, link], frames, times, transforms[:, instrument.link_index[link]])
    tips = instrument.tips_cam(states)
    columns = stage.rr.Points3D.columns(
        positions=tips.reshape(-1, 3),
        colors=stage.painted(colour, 2 * len(tips)),
        radii=[TIP_RADIUS_M] * (2 * len(tips)),
    )
    stage.series([*place, "tips"], frames, times, columns.partition([2] * len(tips)))


def _put_view(stage: Stage, root: list[object], viewed: Viewed, name: str) -> None:
    """An auxiliary camera where it really was, or where that is reported to be."""
    view, kind = viewed.recording.auxiliary(name), viewed.unit.kind
    kind = kind if kind in view.entry.kinds else view.entry.kinds[0]
    known = viewed.recording.entry.truth
    poses = view.true_T_view_cam(kind) if known else view.T_view_cam(kind)
    place = [*root, "views", name]
    frames = np.arange(len(poses))
    stage.poses(place, frames, viewed.recording.timestamps_s, np.array([inverse_transform(pose) for pose in poses]))
    stage.camera(place, view.camera, PLANE_M)


def _put_row(stage: Stage, root: list[object], viewed: Viewed, shot: Shot) -> None:
    """What a tracker estimated, and how far off that is."""
    kept = shot.record.frames
    last = viewed.recording.frames
    frames = np.array([frame for frame in kept.index[: len(kept.state)] if 0 <= frame < last], dtype=np.int64)
    if not len(frames):
        return
    states = np.array([shot.state(int(frame)) for frame in frames], dtype=np.float64)
    for number, (arm, instrument) in enumerate(zip(viewed.unit.arms, viewed.instruments, strict=True)):
        own = states[:, STATE_SIZE * number : STATE_SIZE * (number + 1)]
        place = [*root, ROWS, shot.title, arm]
        _put_instrument(stage, place, instrument, own, frames, viewed.recording.timestamps_s, shot.colour)
    for error in _errors([shot.record]):
        values = _values(shot.record, error)[: len(frames)]
        if len(values) < len(frames):
            continue
        seconds = viewed.recording.timestamps_s[frames]
        for number, column in enumerate(values.T):
            title = shot.title if values.shape[1] == 1 else f"{shot.title}, {viewed.unit.arms[number]}"
            stage.numbers([*root, ERRORS, error, title], frames, seconds, column, title, shot.colour)


def _values(record: InstrumentRecord, error: str) -> FloatArray:
    """``(frames, arms)``, one column where there is one value for all arms."""
    found = np.asarray(record.errors[error], dtype=np.float64)
    return found.reshape(len(found), -1)


def _errors(records: Sequence[InstrumentRecord]) -> list[str]:
    """Names of the errors that have a value for each frame, of any of the runs."""
    names: dict[str, None] = {}
    for record in records:
        for name, values in record.errors.items():
            if name in record.whole or len(values) != len(record.frames.state):
                continue
            if np.isfinite(np.asarray(values, dtype=np.float64)).any():
                names[name] = None
    return list(names)


def _put_pictures(
    stage: Stage, root: list[object], viewed: Viewed, shots: list[Shot], every: int, advance: Callable[[float], None]
) -> None:
    """Picture, mask and outlines of every frame that has them; those of estimates by exact silhouettes."""
    recording, unit = viewed.recording, viewed.unit
    scenery = Scenery(viewed.dataset, viewed.records[0]) if viewed.records else None
    place = [*root, CAMERA]
    marked = {arm: recording.keypoints(arm) for arm in unit.arms}
    for frame in range(0, recording.frames, every):
        stage.at(frame, float(recording.timestamps_s[frame]))
        picture = recording.image_path(frame)
        if picture is not None:
            recording.image(frame)  # refuses what is none before a viewer is given it
            stage.png([*place, "image"], read_bytes(picture))
        if scenery is not None:
            reference = scenery.reference(frame)
        elif unit.kind in recording.entry.kinds:
            reference = recording.mask(unit.kind, frame)
        else:
            reference = np.zeros((recording.camera.height, recording.camera.width), dtype=bool)
        stage.mask([*place, "mask"], reference)
        stage.contours([*place, "reference"], contours(reference), REFERENCE_COLOUR)
        seen = np.concatenate([points[frame] for points in marked.values()])
        stage.dots([*place, "tips"], seen[np.isfinite(seen).all(axis=1)], REFERENCE_COLOUR)
        for shot in shots:
            state = shot.state(frame)
            outline = [] if state is None or scenery is None else contours(scenery.silhouette(state, frame))
            stage.contours([*place, ROWS, shot.title], outline, shot.colour)
        advance(min(every, recording.frames - frame))
