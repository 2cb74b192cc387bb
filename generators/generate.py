"""The whole job: from a preset to a dataset on disk, resumable after any interruption, the same bytes every time."""

from __future__ import annotations

import ctypes
import fcntl
import hashlib
import json
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import connection, get_context, parent_process
from pathlib import Path
from typing import Any

import yaml

from surgbench import __version__
from surgbench.camera import Camera
from surgbench.change_of_view import ChangeOfView
from surgbench.dataset import tables
from surgbench.dataset.format import (
    ARMS,
    AUXILIARY_CONVENTION,
    CONVENTIONS,
    FORMAT,
    MANIFEST_NAME,
    MARKER_NAME,
    Arm,
    AuxiliaryEntry,
    Manifest,
    MaskKind,
    SequenceEntry,
    clean_mask_path,
    instrument_folder,
    observations_path,
    observed_path,
    poses_path,
    read_manifest,
    sequence_files,
    states_path,
    view_folder,
)
from surgbench.dataset.masks import PNG_END, Mask, encode_mask
from surgbench.dataset.storage import describe_files, storage_error
from surgbench.errors import ConfigError, DatasetError, SurgbenchError, unknown_name
from surgbench.files import PARTIAL_SUFFIX, write_atomic
from surgbench.generators.auxiliary import AUXILIARY_CAMERA, ViewTables, camera_of
from surgbench.generators.corruption import corrupt
from surgbench.generators.lens import Lens
from surgbench.generators.mismatch import NO_MISMATCH, real_camera, real_instrument
from surgbench.generators.presets import Corruption, Preset
from surgbench.generators.render import MaskRenderer
from surgbench.generators.sequence import make_tables
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument, load_instrument, save_instrument
from surgbench.instrument.files import INSTRUMENT_FILE
from surgbench.randomness import generator

CAMERA_NAME = "endoscope"
KINDS: tuple[MaskKind, ...] = ("left", "right", "both")
CHUNK_FRAMES = 20
# A file takes at least a block of the disk.
BLOCK_BYTES = 4096
# Of a 1-bit mask's pixels, how many bytes the PNG takes at most, measured with room to spare.
MASK_BYTES_PER_PIXEL = 0.01
TABLE_BYTES_PER_FRAME = 500
MANIFEST_BYTES_PER_FILE = 160


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
    """

    preset: Preset
    instrument: Instrument
    real_instrument: Instrument
    real_camera: Camera
    sequences: tuple[SequenceEntry, ...]
    marker: dict[str, Any]
    instrument_files: dict[str, bytes]

    @property
    def frames(self) -> int:
        """Frames over all sequences."""
        return sum(entry.frames for entry in self.sequences)

    @property
    def paths(self) -> list[str]:
        """Every file but the manifest."""
        return [*self.instrument_files, *(path for entry in self.sequences for path in sequence_files(entry))]

    @property
    def disk_bytes(self) -> int:
        """Disk that the whole dataset takes, an upper estimate."""
        camera, auxiliary = self.preset.camera, self.preset.auxiliary
        mask = _blocks(camera.width * camera.height * MASK_BYTES_PER_PIXEL) * 2 * len(KINDS)
        numbers = TABLE_BYTES_PER_FRAME
        if auxiliary is not None:
            pixels, views = auxiliary.camera.width * auxiliary.camera.height, len(auxiliary.views)
            mask += _blocks(pixels * MASK_BYTES_PER_PIXEL) * 2 * len(ARMS) * views
            numbers += TABLE_BYTES_PER_FRAME * views
        files = len(self.paths)
        return int(self.frames * (mask + numbers) + _blocks(files * MANIFEST_BYTES_PER_FILE))


@dataclass(frozen=True)
class Chunk:
    """Frames that one worker renders: consecutive ones of a sequence.

    Attributes:
        entry: The sequence.
        start: First frame.
        states: ``(n, 2, 9)`` true states.
        views: Auxiliary view and arm to ``(n, 4, 4)`` true T_view_cam.
    """

    entry: SequenceEntry
    start: int
    states: FloatArray
    views: dict[tuple[str, Arm], FloatArray]


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
    fast = int(preset.pairs * preset.motion.fast_share)
    digits = max(3, len(str(preset.pairs - 1)))
    views = () if preset.auxiliary is None else preset.auxiliary.views
    auxiliary = AuxiliaryEntry(camera=AUXILIARY_CAMERA, kinds=ARMS, keypoints=True)
    sequences = tuple(
        SequenceEntry(
            id=f"{index:0{digits}d}",
            frames=preset.frames,
            dt_s=preset.dt_s,
            speed="fast" if index >= preset.pairs - fast else "nominal",
            camera=CAMERA_NAME,
            arms=ARMS,
            instruments=dict.fromkeys(ARMS, instrument.name),
            kinds=KINDS,
            keypoints=True,
            readings=True,
            truth=True,
            auxiliary=dict.fromkeys(views, auxiliary),
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
    return Plan(preset, instrument, real, camera, sequences, marker, files)


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


def generate(
    plan: Plan,
    out: Path,
    *,
    jobs: int = 1,
    say: Callable[[str], None] = lambda line: None,
    progress: Callable[[float], None] = lambda frames: None,
) -> bool:
    """Make a dataset, or finish one that was interrupted.

    Args:
        plan: From :func:`plan_dataset`.
        out: The dataset's folder: new, empty, or one where the same generation was interrupted.
        jobs: Worker processes. The bytes do not depend on it.
        say: Takes a line about what is going to be done.
        progress: Takes the number of frames just done.

    Returns:
        ``False`` if the dataset was complete already and nothing was done.

    Raises:
        ConfigError: The preset's workspace is too tight for its motion.
        DatasetError: The folder holds something else or the same dataset with files missing, or another process is at
            work in it.
        SurgbenchError: The disk lacks room, before or during the work, or a worker died.
    """
    _refuse_other_content(plan, out)
    if _is_complete(out):
        return False
    fresh = not out.exists() or not any(out.iterdir())
    done = {path for path in plan.paths if (out / path).is_file()} if out.is_dir() else set()
    _check_disk(plan, out, len(done) / len(plan.paths), say)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with _locked(out):
            _remove_partial(out)
            write_atomic(out / MARKER_NAME, json.dumps(plan.marker, sort_keys=True, indent=1).encode())
            for path, data in plan.instrument_files.items():
                write_atomic(out / path, data)
            finished = _render_all(plan, out, jobs, progress)
            _remove_partial(out)
            write_atomic(out / MANIFEST_NAME, _manifest(plan, out, finished).to_bytes())
            (out / MARKER_NAME).unlink()
    except ConfigError:
        # These settings can never be finished.
        if fresh:
            shutil.rmtree(out)
        raise
    except OSError as error:
        raise storage_error(error, out, "run the same command again, it goes on from here") from None
    except BrokenProcessPool:
        raise SurgbenchError(
            f"{out}: a worker process was killed (out of memory?); "
            "run the same command again, with fewer --jobs, to go on"
        ) from None
    return True


def _blocks(size: float) -> int:
    return -(-int(size) // BLOCK_BYTES) * BLOCK_BYTES


def _refuse_other_content(plan: Plan, out: Path) -> None:
    """Raise unless the folder is missing, empty, or holds this very dataset, whole or in part."""
    if not out.exists():
        return
    if not out.is_dir():
        raise DatasetError(f"{out}: is a file; --out needs a new or empty folder")
    entries = sorted(path.name for path in out.iterdir() if not path.name.endswith(PARTIAL_SUFFIX))
    if not entries:
        return
    if MANIFEST_NAME in entries:
        manifest, _ = read_manifest(out)
        if manifest.configuration != _configuration(plan):
            raise DatasetError(
                f"{out}: holds another dataset ('{manifest.name}', other settings); choose another --out"
            )
        return
    marker = out / MARKER_NAME
    if not marker.is_file():
        raise DatasetError(f"{out}: holds something else ('{entries[0]}'); --out needs a new or empty folder")
    try:
        same = json.loads(marker.read_bytes()) == plan.marker
    except ValueError:
        raise DatasetError(f"{marker}: damaged; delete the folder {out} and start again") from None
    if not same:
        raise DatasetError(
            f"{out}: an unfinished dataset with other settings lies here; choose another --out or delete it"
        )
    expected = {*plan.paths, MARKER_NAME}
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out).as_posix()
        if path.is_file() and name not in expected and not name.endswith(PARTIAL_SUFFIX):
            raise DatasetError(f"{path}: does not belong to this dataset; move it away, or choose another --out")


def _is_complete(out: Path) -> bool:
    """Whether the dataset was finished; raises if files of it are no longer there."""
    if not (out / MANIFEST_NAME).is_file():
        return False
    manifest, _ = read_manifest(out)
    for name, entry in manifest.files.items():
        path = out / name
        size = path.stat().st_size if path.is_file() else None
        if size != entry.bytes:
            state = "missing from" if size is None else f"{size} instead of {entry.bytes} bytes in"
            raise DatasetError(
                f"{path}: {state} a finished dataset; see 'surgbench validate {out}', or choose another --out"
            )
    # Killed between the manifest and the last step.
    (out / MARKER_NAME).unlink(missing_ok=True)
    return True


def _check_disk(plan: Plan, out: Path, share_done: float, say: Callable[[str], None]) -> None:
    parent = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.is_dir())
    free = shutil.disk_usage(parent).free
    need = int(plan.disk_bytes * (1.0 - share_done))
    resumed = f", {share_done:.0%} of its files are there already" if share_done else ""
    pairs = f"{len(plan.sequences)} {'pair' if len(plan.sequences) == 1 else 'pairs'} of trajectories"
    say(
        f"{plan.preset.name}: {pairs}, {plan.frames} frames, "
        f"about {plan.disk_bytes / 1e6:.0f} MB{resumed}; {free / 1e6:.0f} MB free"
    )
    if free < need:
        raise SurgbenchError(
            f"{out}: the disk has {free / 1e6:.0f} MB free but {need / 1e6:.0f} MB are needed; "
            "make room, choose another --out, or fewer --sequences or --frames"
        )


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Hold the folder against a second generation; the system lets go of it however this process ends."""
    handle = os.open(out, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DatasetError(f"{out}: another 'surgbench generate' is at work here") from None
        yield
    finally:
        os.close(handle)


def _remove_partial(out: Path) -> None:
    for path in out.rglob(f"*{PARTIAL_SUFFIX}"):
        path.unlink(missing_ok=True)


def _render_all(plan: Plan, out: Path, jobs: int, progress: Callable[[float], None]) -> list[SequenceEntry]:
    """Write everything but the manifest; what is there whole stays.

    Returns:
        What the manifest says of the sequences.
    """
    finished: list[SequenceEntry] = []
    if jobs <= 1 and _ctrl_c_raises():
        worker = _Worker(plan, out, threads=None)
        for chunk in _chunks(plan, out, finished):
            worker.render(chunk, progress)
        return finished
    jobs = max(1, jobs)
    context = get_context("spawn")
    # Without a lock, which a killed worker could take along.
    stop = context.RawValue(ctypes.c_bool, False)
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=_start_worker, initargs=(plan, out, stop)) as pool:
        waiting: set[Future[int]] = set()
        try:
            for chunk in _chunks(plan, out, finished):
                # Few at a time, so that the states of a long dataset are not all held at once.
                while len(waiting) >= 2 * jobs:
                    waiting = _collect(waiting, progress)
                # Workers start in here, and keep the block.
                with _without_ctrl_c():
                    waiting.add(pool.submit(_render_chunk, chunk))
            while waiting:
                waiting = _collect(waiting, progress)
        except BaseException:
            stop.value = True
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return finished


def _ctrl_c_raises() -> bool:
    """Whether Ctrl-C ends this thread's work with an exception; only then may it render.

    Mitsuba catches the signal too, and hands back an unfinished image as if it were whole.
    """
    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    return threading.current_thread() is threading.main_thread() and not ignored


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Hold Ctrl-C back until the end, from processes started meanwhile for good.

    To ignore it is not enough for a worker: Mitsuba's own handler would leave the image in hand unfinished.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _collect(waiting: set[Future[int]], progress: Callable[[float], None]) -> set[Future[int]]:
    done, rest = wait(waiting, return_when=FIRST_COMPLETED)
    for future in done:
        progress(future.result())
    return rest


def _chunks(plan: Plan, out: Path, finished: list[SequenceEntry]) -> Iterator[Chunk]:
    """Write each sequence's tables and yield its frames; ``finished`` gets its part of the manifest."""
    for planned in plan.sequences:
        entry, states, views = _write_tables(plan, out, planned)
        finished.append(entry)
        for start in range(0, entry.frames, CHUNK_FRAMES):
            part = slice(start, start + CHUNK_FRAMES)
            poses = {(name, arm): view.T_view_cam[arm][part] for name, view in views.items() for arm in ARMS}
            yield Chunk(entry, start, states[part], poses)


def _write_tables(
    plan: Plan, out: Path, entry: SequenceEntry
) -> tuple[SequenceEntry, FloatArray, dict[str, ViewTables]]:
    """Write a sequence's observations, states, and poses of auxiliary views.

    Returns:
        Its part of the manifest, now with the places of the arms' bases, its ``(frames, 2, 9)`` states, and its
        auxiliary views.
    """
    # Of the whole sequence, also where a part of it is made: what moves or errs slowly depends on its length.
    whole = entry.model_copy(update={"frames": plan.preset.frames})
    made = make_tables(plan.preset, whole, plan.real_instrument, plan.real_camera).first(entry.frames)
    write_atomic(out / observations_path(entry.id), tables.encode_table(made.observed))
    write_atomic(out / states_path(entry.id), tables.encode_table(made.truth))
    for name, view in made.views.items():
        folder = view_folder(entry.id, name)
        write_atomic(out / observations_path(folder), tables.encode_table(view.observed))
        write_atomic(out / poses_path(folder), tables.encode_table(view.truth))
    return entry.model_copy(update={"T_cam_base": made.T_cam_base}), made.states, made.views


class _Worker:
    """Renders and corrupts frames; one Mitsuba scene per camera and arm, kept over all frames.

    Args:
        plan: The job.
        out: The dataset's folder.
        threads: Of Mitsuba; ``None`` leaves them as they are.
        stop: Once true, no further frame is rendered.
    """

    def __init__(self, plan: Plan, out: Path, threads: int | None, stop: ctypes.c_bool | None = None) -> None:
        self.seed = plan.preset.seed
        self.settings: Corruption = plan.preset.corruption
        self.out = out
        self._stop = stop
        self._lens = Lens(plan.real_camera)
        self._renderers = {arm: MaskRenderer([plan.real_instrument], self._lens.pinhole, threads) for arm in ARMS}
        self._auxiliary = [
            MaskRenderer([plan.real_instrument], camera, threads) for camera in camera_of(plan.preset).values()
        ]

    def render(self, chunk: Chunk, progress: Callable[[float], None] = lambda frames: None) -> int:
        """Write a chunk's masks, those that are not there; returns its number of frames."""
        for offset, states in enumerate(chunk.states):
            if self._stop is not None and self._stop.value:
                return offset
            self._frame(chunk.entry.id, chunk.start + offset, states)
            for (view, arm), poses in chunk.views.items():
                own = ChangeOfView(poses[offset]).states(states[ARMS.index(arm)])
                self._auxiliary_frame(chunk.entry.id, view, chunk.start + offset, arm, own)
            progress(1)
        return len(chunk.states)

    def _frame(self, sequence: str, frame: int, states: FloatArray) -> None:
        paths = {kind: (clean_mask_path(sequence, kind, frame), observed_path(sequence, kind, frame)) for kind in KINDS}
        if all(_is_whole_png(self.out / path) for pair in paths.values() for path in pair):
            return
        masks: dict[str, Mask] = {
            arm: self._lens.see(self._renderers[arm].mask(states[index])) for index, arm in enumerate(ARMS)
        }
        # A ray meets one of the two if it meets either, so that the union needs no rendering of its own.
        masks["both"] = masks["left"] | masks["right"]
        for kind, (clean, observed) in paths.items():
            rng = generator(dataset=self.seed, sequence=sequence, frame=frame, kind=kind, purpose="corruption")
            write_atomic(self.out / clean, encode_mask(masks[kind]))
            write_atomic(self.out / observed, encode_mask(corrupt(masks[kind], self.settings, rng)))

    def _auxiliary_frame(self, sequence: str, view: str, frame: int, arm: Arm, state: FloatArray) -> None:
        folder = view_folder(sequence, view)
        clean, observed = self.out / clean_mask_path(folder, arm, frame), self.out / observed_path(folder, arm, frame)
        if _is_whole_png(clean) and _is_whole_png(observed):
            return
        mask = self._auxiliary[0].mask(state)
        axes: dict[str, str | int] = {"sequence": sequence, "view": view, "frame": frame, "kind": arm}
        rng = generator(dataset=self.seed, **axes, purpose="corruption")
        write_atomic(clean, encode_mask(mask))
        write_atomic(observed, encode_mask(corrupt(mask, self.settings, rng)))


def _is_whole_png(path: Path) -> bool:
    """Whether the file ends as a PNG does: after a power cut a file may be there and empty."""
    try:
        with path.open("rb") as file:
            file.seek(-len(PNG_END), os.SEEK_END)
            return file.read() == PNG_END
    except OSError:
        return False


_worker: _Worker | None = None


def _start_worker(plan: Plan, out: Path, stop: ctypes.c_bool) -> None:
    """Prepare a worker process: it ends with its parent, also when that is killed.

    Args:
        plan: The job.
        out: The dataset's folder.
        stop: Shared; once true, the worker renders nothing after the frame in hand.
    """
    global _worker
    parent = parent_process()
    if parent is not None:
        sentinel = parent.sentinel

        def follow() -> None:
            connection.wait([sentinel])
            os._exit(1)

        threading.Thread(target=follow, daemon=True).start()
    _worker = _Worker(plan, out, threads=1, stop=stop)


def _render_chunk(chunk: Chunk) -> int:
    assert _worker is not None
    return _worker.render(chunk)


def _configuration(plan: Plan) -> dict[str, Any]:
    """What the manifest says of how the dataset was made."""
    return {key: value for key, value in plan.marker.items() if key != "format"}


def _manifest(plan: Plan, out: Path, sequences: list[SequenceEntry]) -> Manifest:
    name = plan.instrument.name
    return Manifest(
        name=plan.preset.name,
        created_by=f"surgbench {__version__}",
        origin="generated",
        seed=plan.preset.seed,
        configuration=_configuration(plan),
        conventions=CONVENTIONS if plan.preset.auxiliary is None else CONVENTIONS | AUXILIARY_CONVENTION,
        cameras={CAMERA_NAME: plan.preset.camera, **camera_of(plan.preset)},
        instruments={name: f"{instrument_folder(name)}/instrument.yaml"},
        sequences=tuple(sequences),
        files=describe_files(out, plan.paths),
    )
