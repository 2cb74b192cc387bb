"""What lies in a recording's folder: masks, a camera, and where they exist images, joint readings and marked tips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from surgbench.camera import Camera
from surgbench.camera.options import CameraOptions
from surgbench.camera.undistortion import undistort_points
from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.leftovers import without_leftovers
from surgbench.pictures import PICTURE_SUFFIXES
from surgbench.recordings.beside import BesideOptions, read_beside
from surgbench.recordings.coco import MaskJson
from surgbench.recordings.files import MaskFiles, numbered_pictures
from surgbench.recordings.names import Stamps, Timing, check_stray, time_of_frames
from surgbench.recordings.readings import UntoldJaw
from surgbench.recordings.survey import MaskSource
from surgbench.recordings.video import VIDEO_SUFFIXES, MaskVideo

MASKS = "masks"


@dataclass(frozen=True)
class Recording:
    """What lies in a folder that is to be imported.

    Attributes:
        masks: One per frame, in the frames' order.
        timing: When the frames were taken.
        images: Files, one per frame, or ``None``.
        camera: Intrinsics, distortion included.
        joints: Arm to ``(frames, 3)`` readings, or ``None``.
        arm_joints: Arm to ``(frames, 6)`` readings of all its joints, or ``None``.
        tips: Arm to ``(frames, 2, 2)`` tip pixels, NaN where missing, or ``None``.
        notes: What is to be told of it, one line each.
        jaws: Arm to what is left to be doubted of its readings, by the masks.
    """

    masks: MaskSource
    timing: Timing
    images: list[Path] | None
    camera: Camera
    joints: dict[str, FloatArray] | None
    arm_joints: dict[str, FloatArray] | None
    tips: dict[str, FloatArray] | None
    notes: list[str] = field(default_factory=list)
    jaws: dict[str, UntoldJaw] = field(default_factory=dict)

    @property
    def numbers(self) -> list[int]:
        """Of the frames, increasing."""
        return self.masks.numbers


def read_recording(
    source: Path,
    instrument: Instrument,
    optics: CameraOptions | None = None,
    told: BesideOptions | None = None,
    *,
    arms: Sequence[str] = ("left",),
    single_images: bool = False,
    stamps: Stamps = "auto",
    fps: float | None = None,
) -> Recording:
    """Read everything of a recording but its pictures, and check that the pictures are all there.

    Args:
        source: The folder, or the file in it that holds the masks (a video, or JSON).
        instrument: Of the arms that the masks show.
        optics: Where its camera is, and what the camera's file does not say.
        told: What the tables beside the masks do not say.
        arms: That the masks show; with two, columns of tables begin with an arm's name (``left_q1``).
        single_images: Frames are unrelated, so that no number is a stray one.
        stamps: What numbers in names count.
        fps: Frames per second.

    Raises:
        DatasetError: Something is missing or wrong; one line that names it.
        ConfigError: Frames per second are told of names that are times.
    """
    place = find_masks(source)
    folder = recording_folder(source)
    masks = open_masks(place)
    notes: list[str] = []
    camera = (optics or CameraOptions()).read(folder, masks.size, notes.append)
    if masks.size is None:
        masks = open_masks(place, (camera.width, camera.height))
    numbers = masks.numbers
    if isinstance(masks, MaskFiles) and not single_images:
        check_stray(masks.paths)
    timing = _timing(masks, stamps, fps, single_images=single_images)
    if timing.said is not None and not single_images:
        notes.append(timing.said)
    images: list[Path] | None = None
    maskless: set[int] = set()
    if (folder / "images").is_dir():
        found = numbered_pictures(folder / "images", "images")
        lacking = [number for number in numbers if number not in found]
        if lacking:
            raise DatasetError(f"{folder / 'images'}: the image of frame {lacking[0]} is missing; every mask needs one")
        maskless = set(found) - set(numbers)
        if maskless:
            notes.append(f"{len(maskless)} of {len(found)} images have no mask, and are left out")
        images = [found[number] for number in numbers]
    beside = read_beside(folder, numbers, camera, instrument, told or BesideOptions(), arms=arms, maskless=maskless)
    notes += beside.notes
    lost = sum(_lost(points, camera) for points in (beside.tips or {}).values())
    if lost:
        notes.append(f"tips.csv: {lost} tips lie outside of what an undistorted picture holds, and are left out")
    return Recording(masks, timing, images, camera, beside.joints, beside.arm_joints, beside.tips, notes, beside.jaws)


def recording_folder(source: Path) -> Path:
    """The folder of a recording: where its camera, images and tables are looked for.

    Args:
        source: It, or the folder or file in it that holds the masks.
    """
    inside = not source.is_dir() or (source.name.lower() == MASKS and not (source / MASKS).is_dir())
    return source.parent if inside else source


def find_masks(source: Path) -> Path:
    """Where a recording's masks lie: the folder ``masks``, or a video or JSON file.

    Args:
        source: The recording's folder, or the folder or file itself.

    Raises:
        DatasetError: There are none, or it is not clear which; one line.
    """
    if not source.exists():
        raise DatasetError(f"{source}: no such folder; expected one with masks/ and a camera file")
    if not source.is_dir():
        return source
    if (source / MASKS).is_dir():
        return source / MASKS
    entries = sorted(path for path in without_leftovers(source.iterdir()) if path.is_file())
    if any(path.suffix.lower() in PICTURE_SUFFIXES for path in entries):
        return source
    known = [path for path in entries if path.suffix.lower() in (*VIDEO_SUFFIXES, ".json")]
    named = [path for path in known if path.stem.lower() == MASKS]
    if len(named) == 1:
        return named[0]
    if named:
        raise DatasetError(f"{named[0]}: and so is {named[1].name}; say which holds the masks: import masks {named[0]}")
    videos = [path for path in known if path.suffix.lower() in VIDEO_SUFFIXES]
    hint = f"; if they are in '{videos[0].name}', import masks {videos[0]}" if videos else ""
    raise DatasetError(
        f"{source / MASKS}: missing; expected a folder of masks (000000.png, 000001.png, ...), or masks.mp4, or "
        f"masks.json{hint}"
    )


def open_masks(place: Path, size: tuple[int, int] | None = None) -> MaskSource:
    """The masks of a folder, a video, or a JSON file of RLE.

    Args:
        place: It.
        size: Width and height that they must have, pixels; the first one's unless told.

    Raises:
        DatasetError: There are none, or they are of another size, damaged, or something else; one line.
    """
    if place.is_dir():
        return MaskFiles(place, size)
    if place.suffix.lower() == ".json":
        return MaskJson(place, size)
    if place.suffix.lower() in VIDEO_SUFFIXES:
        return MaskVideo(place, size)
    raise DatasetError(f"{place}: must be a folder, a video ({', '.join(VIDEO_SUFFIXES)}) or a .json file of RLE")


def _timing(masks: MaskSource, stamps: Stamps, fps: float | None, *, single_images: bool) -> Timing:
    if single_images:
        rate = 30.0 if fps is None else fps
        return Timing(np.zeros(len(masks.numbers)), 1.0 / rate, rate)
    if masks.times_s is None or fps is not None:
        return time_of_frames(masks.numbers, masks.place, stamps, fps)
    steps = np.diff(masks.times_s)
    dt_s = float(np.median(steps)) if len(steps) else 1.0 / 30.0
    return Timing(masks.times_s, dt_s, 1.0 / dt_s, f"{1.0 / dt_s:.5g} frames per second, as the video says")


def _lost(points: FloatArray, camera: Camera) -> int:
    """How many tips the undistorted pictures do not hold."""
    held = np.isfinite(undistort_points(points, camera))
    return int((np.isfinite(points) & ~held)[..., 0].sum())
