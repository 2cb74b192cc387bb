"""What people's camera files say: our JSON, OpenCV's YAML, XML and JSON, ROS's CameraInfo, arrays of NumPy, a bare K.

The content decides what a file is, never its name. Only what is said is taken: the size of the picture and the lens's
model may be missing, and :mod:`surgbench.camera.files` does without them or refuses.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from surgbench.camera.lens import DistortionModel
from surgbench.config import parse_value
from surgbench.errors import ConfigError, DatasetError, unknown_name
from surgbench.geometry import FloatArray
from surgbench.syntax import PARSING, parse_json

KEYS = "width, height, fx, fy, cx, cy"
_INTRINSICS = ("fx", "fy", "cx", "cy")
# By the names that other programs have for them.
MODELS: dict[str, DistortionModel] = {
    **dict.fromkeys(("opencv", "plumb_bob", "rational_polynomial", "radtan"), "opencv"),
    **dict.fromkeys(("fisheye", "equidistant", "equi", "kannala_brandt"), "fisheye"),
}
# Our keys and three more, and what files call them, in small letters and without what separates words.
_NAMES: dict[str, tuple[str, ...]] = {
    "matrix": ("cameramatrix", "k", "intrinsicmatrix", "mtx", "camk"),
    "width": ("width", "imagewidth"),
    "height": ("height", "imageheight"),
    "size": ("imagesize", "resolution"),
    "distortion": (
        *("distortion", "distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoefficients", "distcoeff"),
        *("dist", "d"),
    ),
    "distortion_model": ("distortionmodel",),
    "fisheye": ("fisheyemodel",),
}
# What BOP's camera.json has besides.
_IGNORED = ("depth_scale",)
# A camera that is told again and again is read so often.
_MESSAGES = 20
# Pixels: what a matrix may have where there is nothing.
_NOTHING = 1e-6


@dataclass(frozen=True)
class Stated:
    """What a file says of a camera.

    Attributes:
        form: What kind of file it is, in words.
        keys: Those of :class:`surgbench.camera.Camera` that it says; not yet checked, and unknown ones among them.
        bare: It has a matrix K: the picture's size may be left out.
    """

    form: str
    keys: dict[str, Any]
    bare: bool


def read_stated(path: Path) -> Stated:
    """Read what a file says of a camera.

    Raises:
        DatasetError: It is missing, in none of the formats, or says two things at once; one line.
    """
    try:
        content, form = _content(path)
        if isinstance(content, Mapping):
            return _of_keys({str(key): value for key, value in content.items()}, form)
        return Stated("a matrix K", _intrinsics(content, "K"), bare=True)
    except FileNotFoundError:
        raise DatasetError(f"{path}: camera file is missing (keys: {KEYS})") from None
    except OSError as error:
        raise DatasetError(f"{path}: camera file cannot be read ({error.strerror})") from None
    except (ConfigError, ValueError) as error:
        raise DatasetError(f"{path}: {' '.join(str(error).split())}") from None


def is_stated(path: Path) -> bool:
    """Whether a file has a camera's keys, or is a 3x3 matrix; what is wrong with them is another question."""
    try:
        content, _ = _content(path)
    except (OSError, ValueError):
        return False
    if isinstance(content, Mapping):
        names = {_plain(name) for name in content}
        return bool(names.intersection(_NAMES["matrix"])) or {"fx", "fy"} <= names
    return _is_matrix(content)


def model_named(name: str) -> DistortionModel:
    """A lens's model by our name, ROS's or Kalibr's.

    Raises:
        ConfigError: It is none.
    """
    if name not in MODELS:
        raise ConfigError(unknown_name("distortion_model", name, MODELS))
    return MODELS[name]


def _content(path: Path) -> tuple[Any, str]:
    """Keys and values, or an array; and what kind of file it is.

    Raises:
        ValueError: It is neither; the message says what is wrong.
    """
    data = path.read_bytes()
    if data.startswith((b"\x93NUMPY", b"PK")):
        try:
            with PARSING:  # as NumPy does a file's header
                loaded = np.load(io.BytesIO(data), allow_pickle=False)
            return (dict(loaded.items()) if isinstance(loaded, Mapping) else loaded), "arrays of NumPy"
        except Exception as error:  # whatever a damaged archive makes of it
            raise ValueError(f"not valid NumPy ({error})") from None
    try:
        text = data.decode("utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig").strip()
    except UnicodeDecodeError:
        raise ValueError(f"no camera file: neither text nor arrays of NumPy (keys: {KEYS})") from None
    if text.startswith(("%YAML:", "<?xml", "<opencv_storage")) or "!!opencv-matrix" in text:
        return _storage(text), "OpenCV's calibration"
    numbers = _matrix_text(text)
    if numbers is not None:
        return numbers, ""
    if text.startswith(("{", "[")):
        try:
            return parse_json(text), "JSON"
        except ValueError as error:
            raise ValueError(f"not valid JSON ({error})") from None
    try:
        content = _message(text)
    except ValueError as error:
        raise ValueError(f"not valid YAML ({error})") from None
    if not isinstance(content, (Mapping, list)):
        raise ValueError(f"no camera file (keys: {KEYS}; or camera_matrix; or nine numbers of K)")
    return content, "YAML"


def _message(text: str) -> Any:
    """A YAML document; of several messages, as `rostopic echo` prints them with ``---`` behind each, the camera of all.

    Raises:
        ValueError: It is none, or the messages tell different cameras.
    """
    documents = [one for one in re.split(r"(?m)^---\s*$", text) if re.sub(r"(?m)^%.*", "", one).strip()]
    if len(documents) < 2:
        return parse_value(documents[0]) if documents else None
    if documents[-1].count("\n") < documents[0].count("\n"):
        documents.pop()  # the last one may have been cut off
    said = [parse_value(one) for one in documents[:_MESSAGES]]
    cameras = [{k: v for k, v in one.items() if k != "header"} if isinstance(one, Mapping) else one for one in said]
    if any(one != cameras[0] for one in cameras[1:]):
        raise ValueError("holds several cameras, one after the other; leave only the one that is meant")
    return cameras[0]


def _matrix_text(text: str) -> FloatArray | None:
    """Nine numbers, whatever stands between them; ``None`` for anything else."""
    words = re.sub(r"[\[\](),;]", " ", re.sub(r"#.*", "", text)).split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        return None
    return numbers.reshape(3, 3) if numbers.size == 9 else None


def _storage(text: str) -> dict[str, Any]:
    """What OpenCV wrote, read by OpenCV."""
    if not text.startswith(("%YAML", "<")):
        text = "%YAML:1.0\n---\n" + text.removeprefix("---")
    storage = cv2.FileStorage()
    try:
        if not storage.open(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY):
            raise ValueError("not valid YAML or XML of OpenCV")
        root = storage.root()
        return {name: _node(root.getNode(name)) for name in root.keys()} if root.isMap() else {}  # noqa: SIM118
    except (cv2.error, SystemError) as error:
        raise ValueError(f"not valid YAML or XML of OpenCV ({error})") from None
    finally:
        storage.release()


def _node(node: Any) -> Any:
    if node.isMap():
        return {name: _node(node.getNode(name)) for name in node.keys()}  # noqa: SIM118
    if node.isSeq():
        return [_node(node.at(index)) for index in range(node.size())]
    if node.isInt() or node.isReal():
        return int(node.real()) if node.isInt() else node.real()
    return node.string() if node.isString() else None


def _of_keys(content: dict[str, Any], form: str) -> Stated:
    """What keys tell, under our names.

    Raises:
        ConfigError: The lens's model is unknown.
        ValueError: A thing is there twice, or what should be numbers is not.
    """
    rest, keys = dict(content), dict[str, Any]()
    for ours, names in _NAMES.items():
        found = [name for name in content if _plain(name) in names]
        if any(repr(content[name]) != repr(content[found[0]]) for name in found[1:]):
            raise ValueError(f"has both '{found[0]}' and '{found[1]}', and they differ; leave one out")
        for name in found:
            keys[ours] = rest.pop(name)
    size, is_fisheye, matrix = (keys.pop(name, None) for name in ("size", "fisheye", "matrix"))
    if size is not None and not {"width", "height"} & set(keys):
        keys["width"], keys["height"] = _array(size, 2, "image_size").tolist()
    for name in {"width", "height"} & set(keys):
        value = keys[name].item() if isinstance(keys[name], np.ndarray | np.generic) else keys[name]
        keys[name] = int(value) if isinstance(value, float) and value.is_integer() else value
    if "distortion" in keys:
        keys["distortion"] = _array(keys["distortion"], None, "distortion").tolist()
    model = keys.pop("distortion_model", None) or ("fisheye" if is_fisheye else None)
    if model is not None:
        keys["distortion_model"] = model_named(str(model))
    if matrix is not None:
        intrinsics = _intrinsics(matrix, "camera_matrix")
        _check_left_out(rest, intrinsics)
        return Stated("ROS's CameraInfo" if model and form == "YAML" else form, keys | intrinsics, bare=True)
    others = [name for name, value in rest.items() if _is_matrix(value)]
    if others and not set(_INTRINSICS) & set(rest):
        raise ValueError(f"has {' and '.join(others)}, but no 'camera_matrix': say by that name which one is meant")
    return Stated(form, keys | {name: value for name, value in rest.items() if name not in _IGNORED}, bare=False)


def _check_left_out(rest: Mapping[str, Any], intrinsics: Mapping[str, float]) -> None:
    """Of keys beside K that would be left out, refuse those that mean something.

    Raises:
        ValueError: One says what the lens does, what part of the sensor the pictures are, or contradicts K.
    """
    for name, value in rest.items():
        plain = _plain(name)
        if "distor" in plain or "distco" in plain:
            raise ValueError(f"unknown key '{name}'; did you mean 'distortion_coefficients'?")
        if plain in ("binningx", "binningy") and value not in (None, 0, 1):
            raise ValueError(f"'{name}' is {value}: pictures are not those of K (write K of the pictures as they are)")
        if plain == "roi" and isinstance(value, Mapping) and any(value.get(one) for one in ("x_offset", "y_offset")):
            raise ValueError(f"'{name}' is a part of the picture (write K of the pictures as they are)")
        if name in intrinsics and value != intrinsics[name]:
            raise ValueError(f"'{name}' is {value}, and {intrinsics[name]:g} in K; leave one out")


def _intrinsics(value: Any, name: str) -> dict[str, float]:
    """fx, fy, cx and cy of a matrix K.

    Raises:
        ValueError: It is no matrix of a camera with rectangular pixels.
    """
    K = _array(value, 9, name).reshape(3, 3)
    if np.abs(K[:2, 2]).max() <= _NOTHING < np.abs(K[2, :2]).max():
        raise ValueError(f"'{name}' is transposed: cx and cy must be in its last column")
    if np.abs(K[2] - [0, 0, 1]).max() > _NOTHING or max(abs(K[0, 1]), abs(K[1, 0])) > _NOTHING * abs(K[0, 0]):
        rows = "; ".join(" ".join(f"{number:g}" for number in row) for row in K)
        raise ValueError(f"'{name}' must be [fx 0 cx; 0 fy cy; 0 0 1], not [{rows}]")
    return dict(zip(_INTRINSICS, (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])), strict=True))


def _is_matrix(value: Any) -> bool:
    if isinstance(value, str):
        return False
    try:
        _array(value, 9, "")
    except ValueError:
        return False
    return True


def _array(value: Any, count: int | None, name: str) -> FloatArray:
    """Numbers of a list, an array, or a mapping with ``data`` as OpenCV and ROS write them; of nothing, none.

    Raises:
        ValueError: They are not finite numbers, or not so many.
    """
    if isinstance(value, Mapping):
        value = value.get("data")
    try:
        numbers = np.asarray([] if value is None else value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        raise ValueError(f"'{name}' must be numbers") from None
    if count is not None and numbers.size != count:
        raise ValueError(f"'{name}' must be {count} numbers, not {numbers.size}")
    if not np.isfinite(numbers).all():
        raise ValueError(f"'{name}' must be finite numbers, not {numbers[~np.isfinite(numbers)][0]}")
    return numbers


def _plain(name: Any) -> str:
    """A key in small letters and without what separates words."""
    return re.sub(r"[\s_.-]", "", str(name)).lower()
