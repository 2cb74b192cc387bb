"""Masks as RLE or polygons in a JSON file: a COCO dataset, of videos too, COCO results, or one RLE per frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray
from surgbench.pictures import MAX_SIDE
from surgbench.recordings.coco_video import TRACK_KEYS, by_images
from surgbench.recordings.json_file import read_json
from surgbench.recordings.names import number_files
from surgbench.recordings.rle import decode_segmentation

_SHAPES = (
    "a COCO dataset ('images' and 'annotations'), a list of COCO results ('image_id' and 'segmentation'), or one RLE "
    "('size' and 'counts') per frame, as a list or by name"
)
_MOST_CATEGORIES = (1 << 16) - 1


class Object(NamedTuple):
    """An object in a frame.

    Attributes:
        category: Its kind.
        track: The number that follows it from frame to frame, where it has one.
        segmentation: Polygons or RLE.
    """

    category: int
    track: Any
    segmentation: Any


class MaskJson:
    """A JSON file of masks; see :class:`surgbench.recordings.survey.MaskSource`.

    A pixel's value is the category of the object that is there, the last one of several; 1 where there are no
    categories. Where a frame has several objects of a category, and all objects have a ``track_id``, it is that, so
    that two instruments of a kind are told apart over time. Frames without an object are empty.

    Args:
        path: The file.
        size: Width and height that they must have, pixels; what the file says unless told, if it says it.

    Raises:
        DatasetError: It is missing or something else; one line.
    """

    def __init__(self, path: Path, size: tuple[int, int] | None = None) -> None:
        self.place = path
        self.lossy: str | None = None
        self.times_s: FloatArray | None = None
        try:
            content = by_images(read_json(path))
            frames = _frames(content)
            self.size = size or _stated_size(content, frames)
            if self.size is not None:
                _check_sizes(content, *self.size)
            paths = number_files(map(Path, frames))
        except (KeyError, TypeError, AttributeError):
            raise DatasetError(f"{path}: must be {_SHAPES}") from None
        except ValueError as error:
            raise DatasetError(f"{path}: {error}") from None
        if not paths:
            raise DatasetError(f"{path}: holds no masks; must be {_SHAPES}")
        self.numbers = list(paths)
        self.names = [one.stem for one in paths.values()]
        self._objects = [frames[str(one)] for one in paths.values()]
        self.several = self._several()
        if self.several is not None and all(one.track is not None for one in self._all()):
            self._by_track()

    def pictures(self) -> Iterator[NDArray[Any]]:
        """Each frame's categories, ``(height, width)`` uint16.

        Raises:
            DatasetError: An object is damaged or of another size, or nobody has said which size; one line.
        """
        if self.size is None:
            raise DatasetError(f"{self.place}: says no size of the pictures")
        width, height = self.size
        for number, objects in zip(self.numbers, self._objects, strict=True):
            picture = np.zeros((height, width), np.uint16)
            for one in objects:
                try:
                    picture[decode_segmentation(one.segmentation, height, width)] = one.category
                except ValueError as error:
                    raise DatasetError(f"{self.place}: frame {number}: {error}") from None
            yield picture

    def _all(self) -> Iterator[Object]:
        return (one for objects in self._objects for one in objects)

    def _by_track(self) -> None:
        """Take tracks for categories.

        Raises:
            DatasetError: One cannot be a pixel's value; one line that names the way on.
        """
        tracks = {one.track for one in self._all()}
        wrong = [track for track in tracks if not isinstance(track, int) or not 0 < track <= _MOST_CATEGORIES]
        if wrong:
            told = ",".join(
                f"{track}={arm}" for track, arm in zip(sorted(map(str, tracks)), ("left", "right"), strict=False)
            )
            raise DatasetError(
                f"{self.place}: {self.several}, and the track_id {wrong[0]!r} of one cannot be a pixel's value; "
                f"surgbench import coco --tracks {told} takes such"
            )
        self._objects = [[one._replace(category=one.track) for one in objects] for objects in self._objects]
        self.several = self._several("of track_id")

    def _several(self, of: str = "of category") -> str | None:
        for number, objects in zip(self.numbers, self._objects, strict=True):
            categories = [one.category for one in objects]
            for category in categories:
                if categories.count(category) > 1:
                    return f"frame {number} has {categories.count(category)} objects {of} {category}"
        return None


def _stated_size(content: Any, frames: dict[str, list[Object]]) -> tuple[int, int] | None:
    """Width and height as the first image or RLE that says it has it."""
    for image in content["images"] if isinstance(content, dict) and "images" in content else ():
        if isinstance(image.get("width"), int) and isinstance(image.get("height"), int):
            return image["width"], image["height"]
    for objects in frames.values():
        for one in objects:
            size = one.segmentation.get("size") if isinstance(one.segmentation, dict) else None
            if isinstance(size, list) and len(size) == 2 and all(isinstance(one, int) and one > 0 for one in size):
                return size[1], size[0]
    return None


def _check_sizes(content: Any, width: int, height: int) -> None:
    """See that images are of one size; RLEs are looked at when they are decoded.

    Raises:
        ValueError: One is of another.
    """
    if max(width, height) > MAX_SIDE:
        raise ValueError(f"is of {width}x{height} pixels; at most {MAX_SIDE}x{MAX_SIDE} are read")
    for image in content["images"] if isinstance(content, dict) and "images" in content else ():
        size = (image.get("width", width), image.get("height", height))
        if size != (width, height):
            name = image.get("file_name", image["id"])
            raise ValueError(f"'{name}' is {size[0]}x{size[1]} pixels, not {width}x{height}")


def _frames(content: Any) -> dict[str, list[Object]]:
    """Frames' names to their objects."""
    if isinstance(content, dict) and "images" in content:
        names: dict[Any, str] = {}
        for image in content["images"]:
            names[image["id"]] = str(Path(image.get("file_name", str(image["id"]))))
        frames: dict[str, list[Object]] = {name: [] for name in names.values()}
        for one in content["annotations"]:
            frames[names[one["image_id"]]].append(_object(one))
        return frames
    if isinstance(content, dict):
        return {str(Path(name)): _objects(one) for name, one in content.items()}
    if content and isinstance(content[0], dict) and "image_id" in content[0]:
        frames = {}
        for one in content:
            frames.setdefault(str(one["image_id"]), []).append(_object(one))
        return frames
    return {f"{number:06d}": _objects(one) for number, one in enumerate(content)}


def _object(annotation: dict[str, Any]) -> Object:
    category = annotation.get("category_id", 1)
    if not isinstance(category, int) or not 0 < category <= _MOST_CATEGORIES:
        raise ValueError(f"'category_id' must be 1 to {_MOST_CATEGORIES}, not {category!r}")
    track = next((annotation[key] for key in TRACK_KEYS if key in annotation), None)
    return Object(category, track, annotation["segmentation"])


def _objects(one: Any) -> list[Object]:
    """What a frame has of one RLE, of several, or of none."""
    rles = one if isinstance(one, list) else [] if one is None else [one]
    if not all("counts" in rle for rle in rles):
        raise KeyError("counts")
    return [Object(1, None, rle) for rle in rles]
