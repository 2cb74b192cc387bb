"""What lies in a recording's folder: masks, a camera, and where they exist images, joint readings and marked tips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from surgbench.camera import Camera, read_camera
from surgbench.camera.undistortion import COEFFICIENTS
from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray
from surgbench.leftovers import without_leftovers
from surgbench.recordings.coco import MaskJson
from surgbench.recordings.files import MaskFiles, numbered_pictures
from surgbench.recordings.names import Stamps, Timing, check_stray, time_of_frames
from surgbench.recordings.survey import MaskSource
from surgbench.recordings.tables import read_table
from surgbench.recordings.video import VIDEO_SUFFIXES, MaskVideo

MASKS = "masks"
JOINT_COLUMNS = ("q1", "q2", "q3")
TIP_COLUMNS = ("u1", "v1", "u2", "v2")


@dataclass(frozen=True)
class Recording:
    """What lies in a folder that is to be imported.

    Attributes:
        masks: One per frame, in the frames' order.
        timing: When the frames were taken.
        images: Files, one per frame, or ``None``.
        camera: Intrinsics, distortion included.
        joints: Arm to ``(frames, 3)`` readings, or ``None``.
        tips: Arm to ``(frames, 2, 2)`` tip pixels, NaN where missing, or ``None``.
        notes: What is to be told of it, one line each.
    """

    masks: MaskSource
    timing: Timing
    images: list[Path] | None
    camera: Camera
    joints: dict[str, FloatArray] | None
    tips: dict[str, FloatArray] | None
    notes: list[str] = field(default_factory=list)

    @property
    def numbers(self) -> list[int]:
        """Of the frames, increasing."""
        return self.masks.numbers


def read_recording(
    source: Path,
    *,
    arms: Sequence[str] = ("left",),
    single_images: bool = False,
    stamps: Stamps = "auto",
    fps: float | None = None,
) -> Recording:
    """Read everything of a recording but its pictures, and check that the pictures are all there.

    Args:
        source: The folder, or the file in it that holds the masks (a video, or JSON).
        arms: That the masks show; with two, columns of tables begin with an arm's name (``left_q1``).
        single_images: Frames are unrelated, so that no number is a stray one.
        stamps: What numbers in names count.
        fps: Frames per second.

    Raises:
        DatasetError: Something is missing or wrong; one line that names it.
        ConfigError: Frames per second are told of names that are times.
    """
    if not source.exists():
        raise DatasetError(f"{source}: no such folder; expected one with masks/ and camera.json")
    folder = source if source.is_dir() else source.parent
    place = find_masks(source)
    camera = read_camera(folder / "camera.json")
    if len(camera.distortion) not in COEFFICIENTS:
        raise DatasetError(
            f"{folder / 'camera.json'}: 'distortion' must have 4, 5, 8, 12 or 14 coefficients (OpenCV's order)"
        )
    masks = open_masks(place, camera.width, camera.height)
    numbers = masks.numbers
    if isinstance(masks, MaskFiles) and not single_images:
        check_stray(masks.paths)
    timing = _timing(masks, stamps, fps, single_images=single_images)
    notes = [] if timing.said is None or single_images else [timing.said]
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
    joints = _read_arms(folder / "joints.csv", JOINT_COLUMNS, numbers, arms, maskless, complete=True)
    tips = _read_arms(folder / "tips.csv", TIP_COLUMNS, numbers, arms, maskless, complete=False)
    if tips is not None:
        tips = {arm: _pixels(folder / "tips.csv", values, numbers, camera) for arm, values in tips.items()}
    return Recording(masks, timing, images, camera, joints, tips, notes)


def find_masks(source: Path) -> Path:
    """Where a recording's masks lie: the folder ``masks``, or a video or JSON file.

    Args:
        source: The recording's folder, or the file itself.

    Raises:
        DatasetError: There are none, or it is not clear which; one line.
    """
    if not source.is_dir():
        return source
    if (source / MASKS).is_dir():
        return source / MASKS
    entries = sorted(path for path in without_leftovers(source.iterdir()) if path.is_file())
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


def open_masks(place: Path, width: int, height: int) -> MaskSource:
    """The masks of a folder, a video, or a JSON file of RLE, which have to be of a camera's size.

    Raises:
        DatasetError: There are none, or they are of another size, damaged, or something else; one line.
    """
    if place.is_dir():
        return MaskFiles(place, width, height)
    if place.suffix.lower() == ".json":
        return MaskJson(place, width, height)
    if place.suffix.lower() in VIDEO_SUFFIXES:
        return MaskVideo(place, width, height)
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


def _read_arms(
    path: Path, columns: tuple[str, ...], numbers: list[int], arms: Sequence[str], maskless: set[int], *, complete: bool
) -> dict[str, FloatArray] | None:
    """A table with the columns of each arm, by arm; ``None`` where there is no such file."""
    _check_arms(path, columns, arms)
    names = columns if len(arms) == 1 else tuple(f"{arm}_{column}" for arm in arms for column in columns)
    values = read_table(path, names, numbers, complete=complete, maskless=maskless)
    if values is None:
        return None
    return dict(zip(arms, np.split(values, len(arms), axis=1), strict=True))


def _check_arms(path: Path, columns: tuple[str, ...], arms: Sequence[str]) -> None:
    """See that a table of two arms is not read as one of one, nor the other way round."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            header = [cell.strip() for cell in file.readline().split(",")]
    except (OSError, UnicodeDecodeError):
        return  # who reads it says so
    if len(arms) == 1 and f"left_{columns[0]}" in header:
        raise DatasetError(
            f"{path}: has columns of two arms; say --instances 1=left,2=right or --arms both, as the masks are"
        )
    if len(arms) > 1 and columns[0] in header:
        raise DatasetError(
            f"{path}: has columns of one arm; those of two are {arms[0]}_{columns[0]}, ..., {arms[1]}_{columns[-1]}"
        )


def _pixels(path: Path, values: FloatArray, numbers: list[int], camera: Camera) -> FloatArray:
    """``(frames, 2, 2)`` tips of one arm, NaN where one is not known whole."""
    points = values.reshape(-1, 2, 2)
    points[np.isnan(points).any(axis=2)] = np.nan
    outside = (~camera.contains(points) & ~np.isnan(points[..., 0])).any(axis=1)
    if outside.any():
        frame, size = numbers[int(np.argmax(outside))], f"{camera.width}x{camera.height}"
        raise DatasetError(f"{path}: frame {frame}: a tip lies outside the image of {size} pixels")
    return points
