"""Recordings of masks become datasets without ground truth."""

from __future__ import annotations

import math
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from surgbench.camera import Camera, read_camera
from surgbench.camera.undistortion import COEFFICIENTS, Undistortion, is_distorted
from surgbench.contract import Plugin
from surgbench.dataset import tables
from surgbench.dataset.manifest import MANIFEST_NAME, FileEntry, observations_path
from surgbench.dataset.masks import Mask, decode_png, encode_image, encode_mask, read_bytes
from surgbench.dataset.storage import file_entry, storage_error
from surgbench.dataset.writer import write_files
from surgbench.errors import ConfigError, DatasetError
from surgbench.exchange.beside import Beside, BesideOptions, read_beside
from surgbench.geometry import FloatArray
from surgbench.instrument import load_instrument, save_instrument
from surgbench.tasks.instrument.format import (
    ARM_JOINTS_CONVENTION,
    CONVENTIONS,
    IMAGE_KIND,
    Arm,
    InstrumentManifest,
    SequenceEntry,
    instrument_folder,
    observed_path,
)
from surgbench.tasks.instrument.tables import KEYPOINT_COLUMNS, arm_columns
from surgbench.version import __version__

CAMERA_NAME = "camera"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
SEQUENCE_ID = "000"


@dataclass(frozen=True)
class Recording:
    """What lies in a folder that is to be imported.

    Attributes:
        numbers: Frame numbers in order.
        masks: Files, one per frame.
        images: The same, or ``None``.
        camera: Intrinsics, distortion included.
    """

    numbers: list[int]
    masks: list[Path]
    images: list[Path] | None
    camera: Camera


def import_masks(
    source: Path,
    out: Path,
    *,
    name: str | None = None,
    fps: float = 30.0,
    instrument: str = "large_needle_driver",
    arm: Arm = "left",
    single_images: bool = False,
    beside: BesideOptions | None = None,
    progress: Callable[[float], None] = lambda frames: None,
    say: Callable[[str], None] = lambda line: None,
) -> int:
    """Turn a folder of masks into a dataset without ground truth.

    Args:
        source: Holds ``masks/*.png``, ``camera.json``, and where they exist ``images/``, ``joints.csv``
            (:func:`surgbench.exchange.readings.read_joints`) and ``tips.csv``
            (:func:`surgbench.exchange.tips.read_tips`).
        out: The dataset's folder: new or empty. It appears when the import is complete.
        name: The dataset's name; the source folder's unless told.
        fps: Frames per second.
        instrument: Built-in name or instrument file.
        arm: Which arm the masks show.
        single_images: The masks are unrelated: each becomes a sequence of its own with one frame.
        beside: What is told of ``joints.csv`` and ``tips.csv``.
        progress: Takes the number of frames just done.
        say: Takes a line for each thing that had to be decided.

    Returns:
        Number of frames.

    Raises:
        SurgbenchError: Something in the source is missing or wrong, ``out`` holds something, or the disk is full;
            one line that names it.
    """
    if not (math.isfinite(fps) and fps > 0):
        raise ConfigError(f"--fps: must be greater than 0, not {fps:g}")
    label = re.sub(r"[^A-Za-z0-9_.-]", "-", name or source.resolve().name).lstrip("-_.") or "recording"
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(f"{out}: holds something already; --out needs a new or empty folder")
    model = load_instrument(instrument)
    recording = read_recording(source, single_images=single_images)
    options = beside or BesideOptions()
    found = read_beside(source, recording.numbers, recording.camera, model, options)
    for note in found.notes:
        say(note)
    scratch = out.absolute().with_name(f".{out.absolute().name}.importing")
    try:
        if scratch.exists():
            shutil.rmtree(scratch)  # of an import that was killed
        scratch.mkdir(parents=True)
        folder = instrument_folder(model.name)
        files = {
            path.relative_to(scratch).as_posix(): file_entry(path.read_bytes())
            for path in save_instrument(model, scratch / folder)
        }
        sequences = []
        count = len(recording.numbers)
        for part in ([index] for index in range(count)) if single_images else [list(range(count))]:
            entry = _entry(recording, part, SEQUENCE_ID if not single_images else None, 1.0 / fps, arm, model.name)
            entry = entry.model_copy(update=found.flags)
            sequences.append(entry)
            files |= _write_sequence(recording, found, part, entry, scratch, progress)
        manifest = InstrumentManifest(
            name=label,
            created_by=f"surgbench {__version__}",
            origin="imported",
            configuration={
                "importer": "masks",
                "fps": fps,
                "arm": arm,
                "single_images": single_images,
                **options.model_dump(exclude_defaults=True),
                "undistorted": is_distorted(recording.camera),
                "source_camera": recording.camera.model_dump(mode="json"),
            },
            conventions=CONVENTIONS | (ARM_JOINTS_CONVENTION if options.joints_arm else {}),
            cameras={CAMERA_NAME: recording.camera.model_copy(update={"distortion": ()})},
            instruments={model.name: f"{folder}/instrument.yaml"},
            sequences=tuple(sequences),
            files=files,
        )
        (scratch / MANIFEST_NAME).write_bytes(manifest.to_bytes())
        scratch.rename(out)
    except OSError as error:
        raise storage_error(error, out, "run the same command again") from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return count


def read_recording(source: Path, *, single_images: bool = False) -> Recording:
    """Read everything of a recording but its pictures, and check that the pictures are all there.

    Raises:
        DatasetError: Something is missing or wrong; one line that names it.
    """
    if not source.is_dir():
        raise DatasetError(f"{source}: no such folder; expected one with masks/ and camera.json")
    folder = source / "masks"
    if not folder.is_dir():
        raise DatasetError(f"{folder}: missing; expected a folder of masks (000000.png, 000001.png, ...)")
    masks = _numbered(folder, (".png",))
    if not masks:
        raise DatasetError(f"{folder}: holds no masks; expected 000000.png, 000001.png, ...")
    numbers = sorted(masks)
    if not single_images:
        gaps = sorted(set(range(numbers[0], numbers[-1])) - set(numbers))
        if gaps:
            raise DatasetError(
                f"{folder}: the mask of frame {gaps[0]} is missing (frames {numbers[0]} to {numbers[-1]}); "
                "unrelated images are imported with --single-images"
            )
    camera = read_camera(source / "camera.json")
    if len(camera.distortion) not in COEFFICIENTS:
        raise DatasetError(
            f"{source / 'camera.json'}: 'distortion' must have 4, 5, 8, 12 or 14 coefficients (OpenCV's order)"
        )
    images: list[Path] | None = None
    if (source / "images").is_dir():
        found = _numbered(source / "images", IMAGE_SUFFIXES)
        maskless = sorted(set(found) - set(numbers))
        if maskless:
            missing = _renumbered(masks[numbers[0]], maskless[0])
            raise DatasetError(f"{missing}: the mask of frame {maskless[0]} is missing; every image needs one")
        lacking = [number for number in numbers if number not in found]
        if lacking:
            raise DatasetError(f"{source / 'images'}: the image of frame {lacking[0]} is missing; every mask needs one")
        images = [found[number] for number in numbers]
    return Recording(numbers, [masks[number] for number in numbers], images, camera)


def binarise(picture: NDArray[Any]) -> Mask:
    """The mask that a PNG of any depth shows.

    Args:
        picture: ``(height, width)`` or ``(height, width, channels)``, an alpha channel is ignored.

    Returns:
        ``(height, width)`` bool: above 127 in 8-bit pictures, above 0 in 16-bit ones and in 8-bit ones that hold
        only 0 and 1.
    """
    if picture.ndim == 3:
        picture = picture[..., :3].max(axis=2)
    if picture.dtype == np.uint8 and picture.max() > 1:
        return np.asarray(picture > 127)
    return np.asarray(picture > 0)


def _entry(
    recording: Recording, part: list[int], sequence_id: str | None, dt_s: float, arm: Arm, instrument: str
) -> SequenceEntry:
    stems = tuple(recording.masks[index].stem for index in part)
    return SequenceEntry(
        id=sequence_id or f"{recording.numbers[part[0]]:06d}",
        frames=len(part),
        dt_s=dt_s,
        camera=CAMERA_NAME,
        arms=(arm,),
        instruments={arm: instrument},
        kinds=(arm,),
        images=recording.images is not None,
        source_frames=stems,
    )


def _write_sequence(
    recording: Recording,
    beside: Beside,
    part: list[int],
    entry: SequenceEntry,
    root: Path,
    progress: Callable[[float], None],
) -> dict[str, FileEntry]:
    """Write a sequence's pictures and table; returns what the manifest says of them."""
    (arm,) = entry.arms
    camera = recording.camera
    lens = Undistortion(camera)
    columns: dict[str, FloatArray] = {tables.TIMESTAMP: np.arange(len(part), dtype=np.float64) * entry.dt_s}
    if beside.tips is not None and beside.tips.points is not None:
        tips = beside.tips.points[part]
        tips = _undistort_points(tips, camera) if is_distorted(camera) else tips
        columns |= dict(zip(arm_columns(arm, KEYPOINT_COLUMNS), tips.reshape(-1, 4).T, strict=True))
    if beside.readings is not None:
        columns |= beside.readings.columns(arm, part)
    files = write_files(root, {observations_path(entry.id): tables.encode_table(columns)})
    for frame, index in enumerate(part):
        mask = binarise(_read_picture(recording.masks[index], camera))
        mask = lens(mask.astype(np.uint8), cv2.INTER_NEAREST) > 0
        contents = {observed_path(entry.id, arm, frame): encode_mask(mask)}
        if recording.images is not None:
            image = lens(_as_rgb(_read_picture(recording.images[index], camera)))
            contents[observed_path(entry.id, IMAGE_KIND, frame)] = encode_image(image)
        files |= write_files(root, contents)
        progress(1)
    return files


def _read_picture(path: Path, camera: Camera) -> NDArray[Any]:
    data = read_bytes(path)
    if path.suffix.lower() == ".png":
        picture = decode_png(data, str(path))
    else:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
        if decoded is None:
            raise DatasetError(f"{path}: truncated or damaged image")
        picture = decoded
    if picture.shape[:2] != (camera.height, camera.width):
        raise DatasetError(
            f"{path}: is {picture.shape[1]}x{picture.shape[0]} pixels; camera.json says {camera.width}x{camera.height}"
        )
    return picture


def _as_rgb(picture: NDArray[Any]) -> NDArray[np.uint8]:
    if picture.dtype == np.uint16:
        picture = (picture // np.uint16(257)).astype(np.uint8)
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=2)
    return np.ascontiguousarray(picture[..., 2::-1], dtype=np.uint8)


def _undistort_points(points: FloatArray, camera: Camera) -> FloatArray:
    """Where ``(..., 2)`` pixels lie in the undistorted image; NaN outside of it and where they are NaN already."""
    flat = points.reshape(-1, 1, 2)
    moved = np.asarray(
        cv2.undistortPoints(np.nan_to_num(flat), camera.matrix, np.array(camera.distortion), P=camera.matrix),
        np.float64,
    )
    moved[np.isnan(flat)] = np.nan
    moved[~camera.contains(moved)] = np.nan
    return moved.reshape(points.shape)


def _numbered(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Pictures of a folder by the number their name ends in.

    Raises:
        DatasetError: A name has no number, or two have the same.
    """
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        digits = re.search(r"(\d+)$", path.stem)
        if digits is None:
            raise DatasetError(f"{path}: its name must end in the frame's number, for example 000012{path.suffix}")
        number = int(digits[1])
        if number in found:
            raise DatasetError(f"{path}: is frame {number}, and so is {found[number].name}")
        found[number] = path
    return found


def _renumbered(path: Path, number: int) -> Path:
    """The same name with another frame's number in as many digits."""
    return path.with_name(re.sub(r"\d+$", lambda old: f"{number:0{len(old[0])}d}", path.stem) + path.suffix)


def _say(line: str) -> None:
    print(line, file=sys.stderr)


class MasksImporter(Plugin):
    """A folder of masks with its camera; what it may hold besides, :func:`import_masks` says."""

    name: ClassVar[str] = "masks"
    summary: ClassVar[str] = "masks/*.png and camera.json; optional images/, joints.csv, tips.csv"

    class Config(BesideOptions):
        """Options."""

        name: Annotated[str | None, Field(description="The dataset's name; the source folder's unless told.")] = None
        fps: Annotated[float, Field(description="Frames per second; default: 30.")] = 30.0
        instrument: Annotated[
            str, Field(description="Instrument: a name, or an instrument file; default: large_needle_driver.")
        ] = "large_needle_driver"
        arm: Annotated[Arm, Field(description="Which arm the masks show; default: left.")] = "left"
        single_images: Annotated[
            bool, Field(description="The masks are unrelated: each becomes a sequence of one frame.")
        ] = False

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

    def frames(self, source: Path) -> int:
        """How many masks there are."""
        return len(read_recording(source, single_images=self.config.single_images).numbers)

    def run(self, source: Path, out: Path, progress: Callable[[float], None]) -> None:
        """Make the dataset."""
        told = self.config.model_dump()
        beside = BesideOptions.model_validate({name: told.pop(name) for name in BesideOptions.model_fields})
        import_masks(source, out, **told, beside=beside, progress=progress, say=_say)
