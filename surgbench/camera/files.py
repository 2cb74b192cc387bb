"""Camera files: found, read, held against the pictures they are for, and told in one line."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path

from surgbench.camera.formats import KEYS, Stated, is_stated, read_stated
from surgbench.camera.lens import DistortionModel
from surgbench.camera.pinhole import Camera
from surgbench.camera.plausible import beyond, implausible
from surgbench.config import parse_model
from surgbench.errors import ConfigError, DatasetError

NAME = "camera.json"
SUFFIXES = (".json", ".yaml", ".yml", ".xml", ".txt", ".npy", ".npz")
# What a lab calls such files; others are looked into too, and passed over if they are something else.
_OWN_NAME = re.compile(r"camera|cam\b|calib|intrinsic|ost$", re.IGNORECASE)
_LARGEST_BYTES = 1 << 20
# A matrix without a size is believed to be that of the pictures if its principal point is so far within them.
_MIDDLE = 0.25
# Tangent of the angle from the axis to the corner, 40 degrees, beyond which four coefficients may well be a fisheye's.
_WIDE = math.tan(math.radians(40))


def find_camera(folder: Path) -> Path:
    """The camera file of a recording: ``camera.json``, or the one file in its folder that holds a camera.

    Raises:
        DatasetError: There is none, or several; one line that names the option.
    """
    if (folder / NAME).exists():
        return folder / NAME
    files = [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()
    ]
    small = [path for path in files if path.stat().st_size <= _LARGEST_BYTES]
    found = [path for path in small if is_stated(path)] or [path for path in small if _OWN_NAME.search(path.stem)]
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise DatasetError(f"{folder}: holds {len(found)} cameras ({names}); say which with --camera FILE")
    if not found:
        raise DatasetError(
            f"{folder / NAME}: camera file is missing (keys: {KEYS}; or OpenCV's or ROS's YAML, or a matrix K; "
            "one that lies elsewhere: --camera FILE)"
        )
    return found[0]


def read_camera(
    path: Path,
    pictures: tuple[int, int] | None = None,
    *,
    calibrated_at: tuple[int, int] | None = None,
    model: DistortionModel | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> Camera:
    """Read a camera file of any of the formats of :mod:`surgbench.camera.formats`.

    Args:
        path: The file.
        pictures: Width and height of the pictures that it is wanted for. A calibration of another size is scaled if
            the aspect ratio is the same.
        calibrated_at: Width and height that it was calibrated at, where the file does not say.
        model: Of the lens, where the file does not say.
        say: Takes lines that tell what was read, and what was made of it.

    Returns:
        The camera of the pictures.

    Raises:
        DatasetError: It is missing, in none of the formats, lacks something, is ambiguous, implausible, or of pictures
            with another aspect ratio; one line that names it and the option that makes it right.
    """
    stated = read_stated(path)
    try:
        told = _size(stated, pictures, calibrated_at)
        camera = parse_model(Camera, {**stated.keys, **told, **_model(stated, model)}, "")
    except ConfigError as error:
        raise DatasetError(f"{path}: {str(error).removeprefix(': ')}") from None
    problem = implausible(camera)
    if problem is not None:
        raise DatasetError(f"{path}: {problem}")
    assumed = bool(told) and calibrated_at is None
    if assumed:
        _check_middle(path, camera)
    if _may_be_fisheye(stated, camera, model):
        raise DatasetError(
            f"{path}: four distortion coefficients of a wide lens: k1, k2, p1, p2, or k1 to k4 of a fisheye? Say "
            "--distortion-model opencv or fisheye, or distortion_model in it"
        )
    say(
        f"{path.name}: {_description(stated, camera, model)}"
        + (" (the pictures' size: it says none)" if assumed else "")
    )
    if pictures is not None and pictures != (camera.width, camera.height):
        camera = _scaled(path, camera, pictures, say)
    if camera.is_distorted:
        seen, kept = camera.lens.shares()
        if seen < 1:
            say(f"{path.name}: the lens reaches {_percent(seen)} of the picture{beyond(camera)}; no more is used")
        if kept < seen:
            say(f"{path.name}: undistorted pictures of that size hold {_percent(kept / seen)} of what the lens sees")
    return camera


def _scaled(path: Path, camera: Camera, pictures: tuple[int, int], say: Callable[[str], None]) -> Camera:
    """The camera of pictures of another size: scaled, or with an odd row or column less or more.

    Raises:
        DatasetError: Their aspect ratio is another.
    """
    size = f"{camera.width}x{camera.height}"
    even = _evened(camera, pictures)
    if even is not None:
        say(
            f"{path.name}: calibrated at {size}, and the pictures are {even.width}x{even.height}, as encoders want "
            "even sizes: the same camera, with a row or column less or more at the end"
        )
        return even
    try:
        scaled = camera.resized(*pictures)
    except ConfigError:
        raise DatasetError(
            f"{path}: calibrated at {size}, and the pictures are {pictures[0]}x{pictures[1]}: another aspect ratio "
            "(give the camera of the pictures as they are, with --camera FILE)"
        ) from None
    numbers = ", ".join(f"{key} {getattr(scaled, key):.2f}" for key in ("fx", "fy", "cx", "cy"))
    say(f"{path.name}: calibrated at {size}, scaled to the pictures' {scaled.width}x{scaled.height}: {numbers}")
    return scaled


def _evened(camera: Camera, pictures: tuple[int, int]) -> Camera | None:
    """The camera of pictures that an encoder made even: many cut off the last row or column, or add one.

    Returns:
        ``None`` where that is not what they differ by.
    """
    sizes = ((camera.width, pictures[0]), (camera.height, pictures[1]))
    if any(ours != theirs and not (ours % 2 == 1 and abs(theirs - ours) == 1) for ours, theirs in sizes):
        return None
    return camera.model_copy(update={"width": pictures[0], "height": pictures[1]})


def _size(stated: Stated, pictures: tuple[int, int] | None, calibrated_at: tuple[int, int] | None) -> dict[str, int]:
    """Width and height, where the file does not say.

    Raises:
        ConfigError: Nor does anything else, or they differ from what was told.
    """
    said = tuple(stated.keys[name] for name in ("width", "height") if name in stated.keys)
    if calibrated_at is not None:
        if said not in ((), calibrated_at):
            raise ConfigError(
                f"says {'x'.join(map(str, said))} pixels, and --camera-size {calibrated_at[0]}x{calibrated_at[1]}"
            )
        return dict(zip(("width", "height"), calibrated_at, strict=True))
    if said or not stated.bare:
        return {}
    if pictures is None:
        raise ConfigError("says no size of the pictures; say it with --camera-size WIDTHxHEIGHT")
    return dict(zip(("width", "height"), pictures, strict=True))


def _model(stated: Stated, model: DistortionModel | None) -> dict[str, str]:
    """The lens's model, where it is told.

    Raises:
        ConfigError: The file says another.
    """
    said = stated.keys.get("distortion_model")
    if model is not None and said not in (None, model):
        raise ConfigError(f"says distortion_model '{said}', and --distortion-model says '{model}'")
    return {} if model is None else {"distortion_model": model}


def _check_middle(path: Path, camera: Camera) -> None:
    """Refuse a matrix without a size whose principal point is that of another one's.

    Raises:
        DatasetError: It is.
    """
    across, down = (camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height
    if not all(_MIDDLE <= share <= 1 - _MIDDLE for share in (across, down)):
        raise DatasetError(
            f"{path}: says no size, and its principal point ({camera.cx:g}, {camera.cy:g}) is far from the middle of "
            f"pictures of {camera.width}x{camera.height}; say what it was calibrated at with --camera-size WIDTHxHEIGHT"
        )


def _may_be_fisheye(stated: Stated, camera: Camera, model: DistortionModel | None) -> bool:
    """Whether four coefficients of no model that is told are of a lens so wide that they may be a fisheye's."""
    if model is not None or "distortion_model" in stated.keys or len(camera.distortion) != 4 or not camera.is_distorted:
        return False
    return math.hypot(camera.width / camera.fx, camera.height / camera.fy) / 2 > _WIDE


def _description(stated: Stated, camera: Camera, model: DistortionModel | None) -> str:
    """What was read, in one line."""
    count = len(camera.distortion)
    if camera.distortion_model == "fisheye":
        lens = "fisheye lens, k1 to k4"
    elif not camera.is_distorted:
        lens = "no distortion"
    elif count == 4 and model is None and "distortion_model" not in stated.keys:
        lens = "4 coefficients taken as k1, k2, p1, p2 (of a fisheye: --distortion-model fisheye)"
    else:
        lens = f"{count} coefficients in OpenCV's order"
    numbers = f"fx {camera.fx:.2f}, fy {camera.fy:.2f}, cx {camera.cx:.2f}, cy {camera.cy:.2f}"
    return f"{stated.form}, {camera.width}x{camera.height} pixels, {numbers}, {lens}"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
