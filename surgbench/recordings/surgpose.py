"""SurgPose as it lies on a disk (Wu et al. 2025, arXiv 2502.11534): what its files hold, trajectory by trajectory.

Each folder has ``keypoints_left.yaml`` and ``keypoints_right.yaml`` (frame to id to [x, y] or nothing),
``api_jp_data.yaml`` (frame to arm to six joints), ``StereoCalibrationDVRK.ini`` and ``regular/left_video.mp4``, ...
The jaw comes in a file of its own, ``gripper_angle.yaml``, in the folder (arm to angles) or beside all folders
(trajectory to arm to angles; those that were commanded, 1000 for 1001 frames). PSM1 is the right instrument and PSM3
the left one; ids of the latter are 7 more.
"""

from __future__ import annotations

import configparser
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from surgbench.camera import Camera
from surgbench.config import parse_model
from surgbench.errors import ConfigError, DatasetError
from surgbench.geometry import FloatArray, is_rigid, rigid_transform
from surgbench.syntax import parse_yaml

# Its names of arms to ours, and what is added to the ids of their points.
ARMS = {"left": "PSM3", "right": "PSM1"}
_FIRST_ID = {"left": 8, "right": 1}
LABELS = ("shaft", "wrist", "jaw_pivot", "left_tip", "right_tip", "joint_2", "joint_3")
TIPS = ("left_tip", "right_tip")
FPS = 30.0
JOINTS = 6
JAW_FILE, KEYPOINTS_FILE, JOINTS_FILE = "gripper_angle.yaml", "keypoints_{eye}.yaml", "api_jp_data.yaml"
CALIBRATION_FILE, VIDEO_FILE = "StereoCalibrationDVRK.ini", "regular/{eye}_video.mp4"
EYES = ("left", "right")
# The paper's fast trajectories; all others are at the nominal speed.
FAST = range(30, 34)
# Those that show two Large Needle Drivers; of the others it is not published what they show.
NEEDLE_DRIVERS = (*range(8), *FAST)
_COEFFICIENTS = (4, 5, 8)
# Of a file's entries, those that may lie beyond the video's end: it may lack its last frames.
_BEYOND_SHARE = 0.01
Tell = Callable[[str], None]


@dataclass(frozen=True)
class Stereo:
    """A stereo calibration.

    Attributes:
        cameras: Left and right, lenses included.
        T_right_left: ``(4, 4)`` from the left camera's frame to the right one's, metres.
    """

    cameras: Mapping[str, Camera]
    T_right_left: FloatArray


def find_trajectories(source: Path) -> dict[str, Path]:
    """Folders of trajectories by name: the source itself, or those in it.

    Raises:
        DatasetError: There are none; one line.
    """
    if not source.is_dir():
        raise DatasetError(f"{source}: no such folder; expected SurgPose's, with 000000, 000001, ...")
    if (source / CALIBRATION_FILE).is_file():
        return {source.resolve().name: source}
    found = {path.name: path for path in sorted(source.iterdir()) if path.name.isdecimal() and path.is_dir()}
    if not found:
        raise DatasetError(f"{source}: holds no trajectories of SurgPose (000000, 000001, ..., or one's own files)")
    return found


def read_stereo(path: Path) -> Stereo:
    """Read ``StereoCalibrationDVRK.ini``; lengths are millimetres.

    Raises:
        DatasetError: It is missing, or lacks a key; one line that names it.
    """
    parser = configparser.ConfigParser(interpolation=None)
    try:
        with path.open(encoding="utf-8-sig") as file:
            parser.read_file(file)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    except (configparser.Error, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: not a calibration ({' '.join(str(error).split())})") from None
    cameras = {eye: _camera(path, parser, f"Stereo{eye.capitalize()}") for eye in EYES}
    turn = [_number(path, parser, "StereoRight", f"R_{k}") for k in range(9)]
    shift_mm = [_number(path, parser, "StereoRight", f"T_{k}") for k in range(3)]
    transform = rigid_transform(np.reshape(turn, (3, 3)), np.array(shift_mm) / 1e3)
    if not is_rigid(transform, 1e-4):
        raise DatasetError(f"{path}: R_0 ... R_8 of [StereoRight] are no rotation")
    return Stereo(cameras, transform)


def read_keypoints(path: Path, frames: int, tell: Tell = lambda line: None) -> dict[str, dict[str, FloatArray]]:
    """Read ``keypoints_left.yaml`` or ``keypoints_right.yaml``.

    Args:
        path: The file.
        frames: Of the video.
        tell: Takes what had to be decided, line by line.

    Returns:
        Label to arm to ``(frames, 2)`` pixels, NaN where one is not marked; but for the tips, those that somewhere are.

    Raises:
        DatasetError: It is missing or something else, or of another number of frames; one line.
    """
    by_frame = _numbered(path, _load(path), frames, tell)
    points = {label: {arm: np.full((frames, 2), np.nan) for arm in ARMS} for label in LABELS}
    place = {first + k: (label, arm) for arm, first in _FIRST_ID.items() for k, label in enumerate(LABELS)}
    for frame, marked in by_frame.items():
        for key, point in _mapping(path, frame, marked).items():
            if point is None or point == "None":
                continue
            if not str(key).isdecimal() or int(key) not in place:
                raise DatasetError(f"{path}: frame {frame}: no point {key} (PSM1 has 1 to 7, PSM3 8 to 14)")
            label, arm = place[int(key)]
            points[label][arm][frame] = _floats(path, frame, point, 2)
    return {
        label: by_arm
        for label, by_arm in points.items()
        if label in TIPS or not all(np.isnan(own).all() for own in by_arm.values())
    }


def read_joints(path: Path, frames: int, tell: Tell = lambda line: None) -> dict[str, FloatArray]:
    """Read ``api_jp_data.yaml``: arm to ``(frames, 6)`` readings (rad, the third m), NaN where there is none.

    Raises:
        DatasetError: It is missing or something else, or of another number of frames; one line.
    """
    joints = {arm: np.full((frames, JOINTS), np.nan) for arm in ARMS}
    for frame, read in _numbered(path, _load(path), frames, tell).items():
        by_arm = _mapping(path, frame, read)
        for arm, theirs in ARMS.items():
            if by_arm.get(theirs) is not None:
                joints[arm][frame] = _floats(path, frame, by_arm[theirs], JOINTS)
    return joints


def read_jaws(folder: Path, frames: int, tell: Tell = lambda line: None) -> dict[str, FloatArray] | None:
    """Arm to ``(frames,)`` whole angles between the jaws, rad, from the file in a folder or the one beside it.

    A list that is one shorter than the frames begins with the second in the folder's own file, and with the first in
    the one beside it, as those read them who use them. ``None`` where there is no list of this trajectory.

    Args:
        folder: Of the trajectory.
        frames: Of the video.
        tell: Takes what had to be decided, line by line.

    Raises:
        DatasetError: It is something else, or of another number of frames; one line.
    """
    own, common, name = folder / JAW_FILE, folder.parent / JAW_FILE, folder.resolve().name
    path = own if own.is_file() else common
    content: Any = _load(path) if path.is_file() else {}
    if path == common:
        keyed = {str(key): value for key, value in content.items()}
        content = keyed.get(name, keyed.get(str(int(name)) if name.isdecimal() else name))
    if content is None or not path.is_file():
        lack = f"{path.name} has no trajectory {name}" if path.is_file() else f"no {JAW_FILE}"
        tell(f"{name}: {lack}, so no readings of q3; the arm's joints are kept")
        return None
    jaws = {}
    for arm, theirs in ARMS.items():
        angles = content.get(theirs) if isinstance(content, dict) else None
        least, most = frames - 1, frames + int(_BEYOND_SHARE * frames)
        if not isinstance(angles, list) or not least <= len(angles) <= most:
            count = f"{len(angles)} angles" if isinstance(angles, list) else "no angles"
            raise DatasetError(f"{path}: {name}: {count} of {theirs}; expected {frames} or {frames - 1}")
        values = _floats(path, 0, angles, len(angles))[:frames]
        first = frames - len(values) if path == own else 0
        jaws[arm] = np.full(frames, np.nan)
        jaws[arm][first : first + len(values)] = values
        if len(angles) != frames:
            begin = "second" if first else "first"
            tell(
                f"{name}: {path.name}: {len(angles)} angles of {theirs} for {frames} frames, taken from the {begin} on"
            )
    return jaws


def _camera(path: Path, parser: configparser.ConfigParser, section: str) -> Camera:
    names = {"width": "res_x", "height": "res_y", "fx": "fc_x", "fy": "fc_y", "cx": "cc_x", "cy": "cc_y"}
    content: dict[str, Any] = {key: _number(path, parser, section, name) for key, name in names.items()}
    # Sizes may be written with a point; a broken pixel is refused.
    content |= {key: int(content[key]) for key in ("width", "height") if content[key].is_integer()}
    coefficients: list[float] = []
    while parser.has_option(section, f"kc_{len(coefficients)}"):
        coefficients.append(_number(path, parser, section, f"kc_{len(coefficients)}"))
    while len(coefficients) > _COEFFICIENTS[1] and coefficients[-1] == 0.0:
        coefficients.pop()
    size = next((count for count in _COEFFICIENTS if count >= len(coefficients)), len(coefficients))
    coefficients += [0.0] * (size - len(coefficients))
    try:
        return parse_model(Camera, {**content, "distortion": coefficients}, f"{path}: [{section}]")
    except ConfigError as error:
        raise DatasetError(str(error)) from None


def _number(path: Path, parser: configparser.ConfigParser, section: str, name: str) -> float:
    try:
        return parser.getfloat(section, name)
    except (configparser.Error, ValueError):
        raise DatasetError(f"{path}: '{name}' of [{section}] is missing or not a number") from None


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The C loader, for these files have tens of thousands of entries; 000010 is 10, and not octal."""


_Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(loader.construct_scalar(node)))


def _load(path: Path) -> dict[Any, Any]:
    try:
        content = parse_yaml(path.read_bytes(), _Loader)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise DatasetError(f"{path}: not valid YAML ({error})") from None
    if not isinstance(content, dict):
        raise DatasetError(f"{path}: must be a mapping")
    return content


def _numbered(path: Path, content: dict[Any, Any], frames: int, tell: Tell) -> dict[int, Any]:
    """What a file has by frame; frames are numbers or texts. A few may lie beyond the video's end."""
    numbered: dict[int, Any] = {}
    for key, value in content.items():
        if not str(key).isdecimal():
            raise DatasetError(f"{path}: '{key}' is not a frame's number")
        numbered[int(key)] = value
    last = max(numbered, default=-1)
    if last >= frames + int(_BEYOND_SHARE * frames):
        raise DatasetError(
            f"{path}: has frame {last}, the video has {frames} frames; its frames must be those of {FPS:g} a second"
        )
    if last >= frames:
        tell(f"warning: {path}: has frames up to {last}, the video {frames}; those beyond its end are left out")
    return {frame: value for frame, value in numbered.items() if frame < frames}


def _mapping(path: Path, frame: int, value: Any) -> dict[Any, Any]:
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise DatasetError(f"{path}: frame {frame}: must be a mapping")
    return value


def _floats(path: Path, frame: int, value: Any, count: int) -> FloatArray:
    try:
        numbers = np.array(value, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if len(numbers) != count or np.isinf(numbers).any():
        raise DatasetError(f"{path}: frame {frame}: expected {count} numbers, not {str(value)[:40]}")
    return numbers
