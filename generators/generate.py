"""The whole job of the instrument task: from a preset to a dataset on disk, the same bytes every time."""

from __future__ import annotations

import ctypes
import hashlib
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from surgbench.camera import Camera
from surgbench.dataset import tables
from surgbench.dataset.manifest import FORMAT, observations_path
from surgbench.dataset.writer import DatasetWriter, collect, read_part
from surgbench.errors import ConfigError, unknown_name
from surgbench.generation import Workers
from surgbench.generators.auxiliary import AUXILIARY_CAMERA, camera_of
from surgbench.generators.frames import KINDS, VISIBLE_KINDS, Chunk, FrameWriter, chunk_part
from surgbench.generators.looks.look import encode_look
from surgbench.generators.looks.markers import with_markers, without_markers
from surgbench.generators.looks.sequence import EYE, EYE_KINDS
from surgbench.generators.looks.variants import pick
from surgbench.generators.mismatch import NO_MISMATCH, real_camera, real_instrument
from surgbench.generators.presets import Preset
from surgbench.generators.resumable import (
    LISTED_BYTES_PER_FILE,
    blocks,
    configuration,
    generate,
    in_this_process,
)
from surgbench.generators.sequence import SequenceTables, ToldApart, make_tables
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument, load_instrument, save_instrument
from surgbench.instrument.files import INSTRUMENT_FILE
from surgbench.processes.ending import end_worker_with_parent
from surgbench.tasks.instrument.format import (
    ARMS,
    AUXILIARY_CONVENTION,
    CONVENTIONS,
    LOOK_CONVENTION,
    VISIBILITY_CONVENTION,
    AuxiliaryEntry,
    InstrumentManifest,
    SequenceEntry,
    instrument_folder,
    look_path,
    poses_path,
    sequence_files,
    states_path,
    view_folder,
    visibility_path,
)
from surgbench.tasks.instrument.tables import SWAPPED, VISIBILITY_COLUMNS
from surgbench.version import DATA_VERSION

__all__ = ["Part", "Plan", "generate", "plan_dataset"]

CAMERA_NAME = "endoscope"
CHUNK_FRAMES = 20
VISIBLE_CHUNK_FRAMES = 20
INSTRUMENTS = "instruments"
# Of a 1-bit mask's pixels, how many bytes the PNG takes at most, measured with room to spare.
MASK_BYTES_PER_PIXEL = 0.01
# The same of an image with noise, and of a depth picture.
IMAGE_BYTES_PER_PIXEL, DEPTH_BYTES_PER_PIXEL = 2.5, 2.0
TABLE_BYTES_PER_FRAME = 500


@dataclass(frozen=True)
class Part:
    """Some sequences of a dataset, and of them the first frames: the same files as in the whole dataset.

    Attributes:
        sequences: Ids.
        frames: At most so many of each; tables are cut likewise.
    """

    sequences: tuple[str, ...]
    frames: int


@dataclass(frozen=True)
class Plan:
    """What a generation will make.

    Attributes:
        preset: Effective preset.
        instrument: Of both arms, as it is declared.
        real_instrument: What is rendered; the same unless the preset has a mismatch.
        real_camera: What sees it, distortion included; the preset's unless there is a mismatch.
        sequences: The dataset's sequences.
        marker: Effective configuration as it is kept in the folder until the dataset is complete.
        instrument_files: Names and bytes of the instrument's own files.
        variant: Of Mitsuba, for images.
    """

    preset: Preset
    instrument: Instrument
    real_instrument: Instrument
    real_camera: Camera
    sequences: tuple[SequenceEntry, ...]
    marker: dict[str, Any]
    instrument_files: dict[str, bytes]
    variant: str = "scalar_rgb"

    @property
    def name(self) -> str:
        """The dataset's."""
        name: str = self.preset.name
        return name

    @property
    def frames(self) -> int:
        """Frames over all sequences."""
        return sum(entry.frames for entry in self.sequences)

    @property
    def counts(self) -> str:
        """How much there will be, a few words."""
        pairs = f"{len(self.sequences)} {'pair' if len(self.sequences) == 1 else 'pairs'} of trajectories"
        return f"{pairs}, {self.frames} frames"

    @property
    def paths(self) -> list[str]:
        """Every file but the manifest."""
        return [*self.instrument_files, *(path for entry in self.sequences for path in sequence_files(entry))]

    @property
    def parts(self) -> Iterator[str]:
        """Those that are written separately: the instruments, each sequence's tables, and each chunk of its frames."""
        yield INSTRUMENTS
        for entry in self.sequences:
            yield entry.id
            if entry.visibility:
                yield _visibility_part(entry.id)
            yield from (chunk_part(entry.id, start) for start in range(0, entry.frames, CHUNK_FRAMES))

    @property
    def disk_bytes(self) -> int:
        """Disk that the whole dataset takes, an upper estimate."""
        camera, auxiliary = self.preset.camera, self.preset.auxiliary
        mask = blocks(camera.width * camera.height * MASK_BYTES_PER_PIXEL) * 2 * len(self.sequences[0].kinds)
        numbers = TABLE_BYTES_PER_FRAME
        if auxiliary is not None:
            pixels, views = auxiliary.camera.width * auxiliary.camera.height, len(auxiliary.views)
            mask += blocks(pixels * MASK_BYTES_PER_PIXEL) * 2 * len(ARMS) * views
            numbers += TABLE_BYTES_PER_FRAME * views
        images = self.preset.images
        if images is not None:
            eyes = 1 if images.stereo is None else 2
            shown = IMAGE_BYTES_PER_PIXEL * eyes + DEPTH_BYTES_PER_PIXEL * images.depth + MASK_BYTES_PER_PIXEL
            mask += blocks(camera.width * camera.height * shown)
            mask += blocks(camera.width * camera.height * MASK_BYTES_PER_PIXEL) * 2 * len(EYE_KINDS) * (eyes - 1)
            numbers += 2 * TABLE_BYTES_PER_FRAME * (eyes - 1)
        files = len(self.paths)
        return int(self.frames * (mask + numbers) + blocks(files * LISTED_BYTES_PER_FILE))

    def write(self, out: Path, workers: Workers, progress: Callable[[float], None]) -> InstrumentManifest:
        """Write everything but the manifest; see :class:`surgbench.generation.GenerationPlan`."""
        DatasetWriter(out, INSTRUMENTS).write(self.instrument.name, self.instrument_files)
        sequences, rest = _render_all(self, out, workers, progress)
        for entry in sequences:
            if entry.visibility:
                _write_visibility(out, entry, rest[entry.id])
        return _manifest(self, out, sequences)


def plan_dataset(preset: Preset, part: Part | None = None) -> Plan:
    """Work out what a preset makes, without making it.

    Args:
        preset: The whole dataset.
        part: What is to be made of it; ``None``: all.

    Raises:
        ConfigError: The part names a sequence that the preset has not.
        SurgbenchError: The preset's instrument is unknown or its file is wrong.
    """
    instrument = load_instrument(preset.instrument)
    digits = max(3, len(str(preset.pairs - 1)))
    views = () if preset.auxiliary is None else preset.auxiliary.views
    auxiliary = dict.fromkeys(views, AuxiliaryEntry(camera=AUXILIARY_CAMERA, kinds=ARMS, keypoints=True))
    images = preset.images
    if images is not None:
        # Trackers are told what is painted, and of nothing that is not.
        instrument = with_markers(instrument) if images.markers else without_markers(instrument)
    if images is not None and images.stereo is not None:
        auxiliary[EYE] = AuxiliaryEntry(camera=CAMERA_NAME, kinds=EYE_KINDS, keypoints=True, images=True)
    sequences = tuple(
        SequenceEntry(
            id=f"{index:0{digits}d}",
            frames=preset.length(index),
            dt_s=preset.dt_s,
            speed=preset.motion.speed(preset.half(index)),
            camera=CAMERA_NAME,
            arms=ARMS,
            instruments=dict.fromkeys(ARMS, instrument.name),
            kinds=KINDS if preset.instances is None else (*KINDS, *VISIBLE_KINDS),
            keypoints=True,
            readings=True,
            truth=True,
            visibility=preset.instances is not None,
            auxiliary=auxiliary,
            images=images is not None,
            look=images is not None,
            depth=images is not None and images.depth,
            links=images is not None and images.links,
        )
        for index in range(preset.pairs)
    )
    if part is not None:
        sequences = _of_part(sequences, part)
    files = _instrument_files(instrument)
    marker: dict[str, Any] = {
        "format": FORMAT,
        # By name: the bytes must not depend on where an instrument file lies.
        "preset": {**preset.model_dump(mode="json"), "instrument": instrument.name},
        "instrument_sha256": _hashes(files),
    }
    real, camera = real_instrument(instrument, preset.mismatch), real_camera(preset.camera, preset.mismatch)
    if preset.mismatch != NO_MISMATCH:
        rendered = _instrument_files(real)
        marker["rendered"] = {
            "camera": camera.model_dump(mode="json"),
            "instrument": yaml.safe_load(rendered[f"{instrument_folder(real.name)}/{INSTRUMENT_FILE}"]),
            "instrument_sha256": _hashes(rendered),
        }
    if part is not None:
        marker["part"] = {"sequences": [entry.id for entry in sequences], "frames": part.frames}
    variant = "scalar_rgb"
    if images is not None:
        marker["images_variant"] = variant = pick(images.variant)
    return Plan(preset, instrument, real, camera, sequences, marker, files, variant)


def _instrument_files(instrument: Instrument) -> dict[str, bytes]:
    """The files that an instrument has in a dataset, by their place in it."""
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch)
        written = sorted(save_instrument(instrument, root / instrument_folder(instrument.name)))
        return {path.relative_to(root).as_posix(): path.read_bytes() for path in written}


def _hashes(files: dict[str, bytes]) -> dict[str, str]:
    return {path: hashlib.sha256(data).hexdigest() for path, data in files.items()}


def _of_part(sequences: tuple[SequenceEntry, ...], part: Part) -> tuple[SequenceEntry, ...]:
    ids = [entry.id for entry in sequences]
    for wanted in part.sequences:
        if wanted not in ids:
            raise ConfigError(unknown_name("sequence", wanted, ids))
    return tuple(
        entry.model_copy(update={"frames": min(part.frames, entry.frames)})
        for entry in sequences
        if entry.id in part.sequences
    )


def _render_all(
    plan: Plan, out: Path, workers: Workers, progress: Callable[[float], None]
) -> tuple[list[SequenceEntry], dict[str, ToldApart]]:
    """Write everything but the manifest and how much is visible; what is there whole stays.

    Returns:
        What the manifest says of the sequences, and how their arms are told apart.
    """
    finished: list[SequenceEntry] = []
    apart: dict[str, ToldApart] = {}
    if in_this_process(workers):
        worker = _frame_writer(plan, out, threads=None)
        for chunk in _chunks(plan, out, finished, apart):
            worker.render(chunk, progress)
    else:
        chunks = _chunks(plan, out, finished, apart)
        workers.do(chunks, _render_chunk, _start_worker, (plan, out), progress)
    return finished, apart


def _chunks(plan: Plan, out: Path, finished: list[SequenceEntry], apart: dict[str, ToldApart]) -> Iterator[Chunk]:
    """Write each sequence's tables and yield its frames; ``finished`` gets its part of the manifest."""
    for planned in plan.sequences:
        entry, made = _write_tables(plan, out, planned)
        finished.append(entry)
        if made.apart is not None:
            apart[entry.id] = made.apart
        for start in range(0, entry.frames, CHUNK_FRAMES):
            part = slice(start, start + CHUNK_FRAMES)
            held = {name: view for name, view in made.views.items() if name != EYE}
            poses = {(name, arm): view.T_view_cam[arm][part] for name, view in held.items() for arm in ARMS}
            yield Chunk(entry, start, made.states[part], poses, made.apart, made.look)


def _write_tables(plan: Plan, out: Path, entry: SequenceEntry) -> tuple[SequenceEntry, SequenceTables]:
    """Write a sequence's observations, states, and poses of auxiliary views.

    Returns:
        Its part of the manifest, now with the places of the arms' bases, and what was made of it.
    """
    # Of the whole sequence, also where a part of it is made: what moves or errs slowly depends on its length.
    whole = entry.model_copy(update={"frames": plan.preset.length(int(entry.id))})
    made = make_tables(plan.preset, whole, plan.real_instrument, plan.real_camera).first(entry.frames)
    contents = {observations_path(entry.id): made.observed, states_path(entry.id): made.truth}
    for name, view in made.views.items():
        folder = view_folder(entry.id, name)
        contents |= {observations_path(folder): view.observed, poses_path(folder): view.truth}
    files = {path: tables.encode_table(columns) for path, columns in contents.items()}
    images = plan.preset.images
    if made.look is not None and images is not None:
        files[look_path(entry.id)] = encode_look(made.look.look, images, plan.variant)
    DatasetWriter(out, entry.id).write("tables", files)
    return entry.model_copy(update={"T_cam_base": made.T_cam_base}), made


def _write_visibility(out: Path, entry: SequenceEntry, apart: ToldApart) -> None:
    """Write how much of each arm is seen, which was noted beside the frames' masks."""
    noted: dict[str, Any] = {}
    for start in range(0, entry.frames, CHUNK_FRAMES):
        noted |= {key: one.about for key, one in read_part(out, chunk_part(entry.id, start)).items()}
    columns: dict[str, FloatArray] = {}
    for arm in ARMS:
        for name in VISIBILITY_COLUMNS:
            if name != SWAPPED:
                shares = [noted[str(frame)][arm][name] for frame in range(entry.frames)]
                columns[f"{arm}_{name}"] = np.array(shares, dtype=np.float64)  # None becomes NaN
            else:
                columns[f"{arm}_{name}"] = apart.swapped[: entry.frames].astype(np.float64)
    path = visibility_path(entry.id)
    DatasetWriter(out, _visibility_part(entry.id)).write("table", {path: tables.encode_table(columns)})


def _frame_writer(plan: Plan, out: Path, threads: int | None, stop: ctypes.c_bool | None = None) -> FrameWriter:
    return FrameWriter(plan.preset, plan.real_instrument, plan.real_camera, out, threads, stop, plan.variant)


def _visibility_part(sequence: str) -> str:
    return f"{sequence}-visibility"


_worker: FrameWriter | None = None


def _start_worker(plan: Plan, out: Path, stop: ctypes.c_bool) -> None:
    """Prepare a worker process: it ends with its parent, also when that is killed.

    Args:
        plan: The job.
        out: The dataset's folder.
        stop: Shared; once true, the worker renders nothing after the frame in hand.
    """
    global _worker
    end_worker_with_parent()
    _worker = _frame_writer(plan, out, threads=1, stop=stop)


def _render_chunk(chunk: Chunk) -> int:
    assert _worker is not None
    frames: int = _worker.render(chunk)
    return frames


def _manifest(plan: Plan, out: Path, sequences: list[SequenceEntry]) -> InstrumentManifest:
    name = plan.instrument.name
    return InstrumentManifest(
        name=plan.preset.name,
        created_by=f"surgbench {DATA_VERSION}",
        origin="generated",
        seed=plan.preset.seed,
        configuration=configuration(plan),
        conventions=CONVENTIONS
        | (AUXILIARY_CONVENTION if any(entry.auxiliary for entry in sequences) else {})
        | ({} if plan.preset.images is None else LOOK_CONVENTION)
        | ({} if plan.preset.instances is None else VISIBILITY_CONVENTION),
        cameras={CAMERA_NAME: plan.preset.camera, **camera_of(plan.preset)},
        instruments={name: f"{instrument_folder(name)}/instrument.yaml"},
        sequences=tuple(sequences),
        files=collect(out, plan.parts, plan.paths),
    )
