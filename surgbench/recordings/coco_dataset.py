"""COCO datasets with their pictures: which images follow one another, and what each object is."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.errors import ConfigError, DatasetError
from surgbench.recordings.coco_video import by_images
from surgbench.recordings.endovis import label_name
from surgbench.recordings.json_file import read_json
from surgbench.recordings.names import number_files
from surgbench.recordings.rle import decode_segmentation

TIME_KEY = "timestamp_s"
_FRAME_KEYS = ("frame", "frame_id", "frame_index")


@dataclass(frozen=True)
class CocoImage:
    """An image with its objects.

    Attributes:
        name: As ``file_name`` has it.
        number: Of the frame in its sequence.
        size: Width and height.
        time_s: When it was taken, where it says so.
        objects: Annotations.
    """

    name: str
    number: int
    size: tuple[int, int]
    time_s: float | None = None
    objects: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True)
class CocoDataset:
    """What a file holds.

    Attributes:
        path: The file.
        sequences: Id to images in order.
        categories: Id to name.
        keypoints: Id of a category to the names of its keypoints.
    """

    path: Path
    sequences: dict[str, list[CocoImage]]
    categories: dict[int, str]
    keypoints: dict[int, list[str]]

    @property
    def objects(self) -> list[dict[str, Any]]:
        """All annotations."""
        return [one for images in self.sequences.values() for image in images for one in image.objects]

    @property
    def labels(self) -> list[str]:
        """Names of all keypoints."""
        return list(dict.fromkeys(name for names in self.keypoints.values() for name in names))

    def mask(self, image: CocoImage, one: Mapping[str, Any]) -> NDArray[np.bool_]:
        """An object's mask, ``(height, width)``.

        Raises:
            DatasetError: It has none, or one of another size; one line.
        """
        try:
            return decode_segmentation(one.get("segmentation") or None, image.size[1], image.size[0])
        except ValueError as error:
            raise DatasetError(f"{self.path}: annotation {one.get('id')} of '{image.name}': {error}") from None

    def points(self, one: Mapping[str, Any], *, hidden: bool) -> dict[str, tuple[float, float]]:
        """An object's keypoints that are marked, or only those that are not hidden.

        Raises:
            DatasetError: They are other than its category says; one line.
        """
        names, values = self.keypoints.get(one["category_id"], []), one.get("keypoints") or []
        if not values:
            return {}
        try:
            rows = np.array(values, dtype=np.float64).reshape(len(names), 3)
        except (TypeError, ValueError):
            raise DatasetError(
                f"{self.path}: annotation {one.get('id')}: 'keypoints' must be x, y, v of each of {', '.join(names)}"
            ) from None
        return {
            name: (u, v) for name, (u, v, flag) in zip(names, rows.tolist(), strict=True) if flag > (0 if hidden else 1)
        }


def read_coco(path: Path) -> CocoDataset:
    """Read a COCO dataset.

    Images of one ``sequence`` or ``video_id``, or else of one folder, follow one another by ``frame``, ``frame_id`` or
    the number in their names. Datasets of YouTube-VIS are read too (:mod:`surgbench.recordings.coco_video`).

    Raises:
        DatasetError: It is something else; one line.
    """
    try:
        content = by_images(read_json(path))
        categories = {one["id"]: str(one["name"]) for one in content.get("categories", [])}
        keypoints = {
            one["id"]: list(map(label_name, one.get("keypoints", []))) for one in content.get("categories", [])
        }
        objects: dict[Any, list[dict[str, Any]]] = {one["id"]: [] for one in content["images"]}
        for one in content["annotations"]:
            if one["category_id"] not in categories:
                raise DatasetError(f"{path}: annotation {one.get('id')} is of category {one['category_id']}: no such")
            objects[one["image_id"]].append(one)
        sequences = _sequences(path, content, objects)
    except KeyError as error:
        raise DatasetError(f"{path}: a COCO dataset must have {error} (images, annotations, categories)") from None
    except (TypeError, AttributeError):
        raise DatasetError(f"{path}: must be a COCO dataset (a mapping with images, annotations, categories)") from None
    except ValueError as error:
        raise DatasetError(f"{path}: {error}") from None
    if not sequences:
        raise DatasetError(f"{path}: holds no images")
    return CocoDataset(path, sequences, categories, keypoints)


def by_name_or_id(text: str, option: str, categories: Mapping[Any, str], arms: tuple[str, ...]) -> dict[Any, str]:
    """Categories to arms, as in ``scissors=left,2=right``; several may be of one arm.

    Raises:
        ConfigError: It is something else; one line with an example.
    """
    ids = {name: number for number, name in categories.items()} | {str(number): number for number in categories}
    found = {}
    for part in text.split(","):
        name, _, arm = (word.strip() for word in part.rpartition("="))
        if name not in ids or arm not in arms:
            named = ", ".join(f"{number} ({name})" for number, name in categories.items())
            raise ConfigError(f"{option}: must be like 1=left,2=right of {named}, not '{text}'")
        found[ids[name]] = arm
    return found


def _sequences(path: Path, content: Any, objects: dict[Any, list[dict[str, Any]]]) -> dict[str, list[CocoImage]]:
    videos = {one["id"]: str(one.get("name", one["id"])) for one in content.get("videos", [])}
    folders = {str(Path(one["file_name"]).parent) for one in content["images"]}
    grouped: dict[str, list[dict[str, Any]]] = {}
    for one in content["images"]:
        if "sequence" in one or "video_id" in one:
            key = str(one.get("sequence", videos.get(one.get("video_id"), one.get("video_id"))))
        else:
            key = str(Path(one["file_name"]).parent) if len(folders) > 1 else "000"
        grouped.setdefault(key, []).append(one)
    return {_sequence_id(key, grouped): _in_order(path, images, objects) for key, images in sorted(grouped.items())}


def _sequence_id(key: str, grouped: Mapping[str, Any]) -> str:
    """The shortest end of a folder's path that tells it from the others."""
    parts = Path(key).parts
    for count in range(1, len(parts) + 1):
        if sum(Path(other).parts[-count:] == parts[-count:] for other in grouped) == 1:
            return re.sub(r"[^A-Za-z0-9_.-]", "-", "-".join(parts[-count:])).lstrip("-_.") or "000"
    return "000"


def _time(image: Mapping[str, Any]) -> float | None:
    """In seconds, as surgbench's own export says it."""
    time_s = image.get(TIME_KEY)
    return float(time_s) if isinstance(time_s, int | float) and np.isfinite(time_s) else None


def _size(path: Path, image: dict[str, Any]) -> tuple[int, int]:
    size = image.get("width"), image.get("height")
    if not all(isinstance(side, int | float) and float(side).is_integer() and side > 0 for side in size):
        raise DatasetError(f"{path}: '{image['file_name']}': 'width' and 'height' must be pixels, not {size}")
    return int(image["width"]), int(image["height"])


def _in_order(path: Path, images: list[dict[str, Any]], objects: dict[Any, list[dict[str, Any]]]) -> list[CocoImage]:
    key = next((key for key in _FRAME_KEYS if all(isinstance(one.get(key), int) for one in images)), None)
    if key is None:
        by_name = {str(Path(one["file_name"])): one for one in images}
        numbered = {number: by_name[str(name)] for number, name in number_files(map(Path, by_name)).items()}
    else:
        numbered = {one[key]: one for one in sorted(images, key=lambda one: int(one[key]))}
    if len(numbered) < len(images):
        raise DatasetError(f"{path}: two images are the same frame of '{images[0]['file_name']}' and those beside it")
    return [
        CocoImage(str(one["file_name"]), number, _size(path, one), _time(one), objects[one["id"]])
        for number, one in numbered.items()
    ]
