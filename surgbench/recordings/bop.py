"""Scenes in the format of the BOP benchmark: cameras, objects with poses, masks per object, pictures.

``scene_camera.json`` and ``scene_gt.json`` have an entry per image; poses go from an object's model to the camera, in
millimetres. ``mask_visib/000003_000001.png`` is what shows of the second object in image 3, and ``mask/`` the same as
if nothing hid it. A dataset of articulated objects may say beside it which link an object is
(``models/objects.json``) and what joints all poses follow from (``scene_joints.json``), as surgbench's own export does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from surgbench.dataset.masks import read_bytes
from surgbench.errors import ConfigError, DatasetError
from surgbench.geometry import FloatArray
from surgbench.pictures import PICTURE_SUFFIXES, decode_picture
from surgbench.recordings.json_file import read_json

CAMERA_FILE, GT_FILE, JOINTS_FILE = "scene_camera.json", "scene_gt.json", "scene_joints.json"
OBJECTS_FILE = "objects.json"
Layer = Literal["mask_visib", "mask"]
MM = 1e3


@dataclass(frozen=True)
class Link:
    """Which link of which instrument an object is.

    Attributes:
        instrument: Its name.
        link: Its name.
        link_from_model_m: ``(3,)`` the model's origin in the link's frame.
    """

    instrument: str
    link: str
    link_from_model_m: FloatArray


@dataclass(frozen=True)
class Scene:
    """One scene.

    Attributes:
        folder: Where it lies.
        images: Ids, increasing.
        matrix: ``(3, 3)`` intrinsics, the same of all images.
        objects: Of each image the ids of its objects, in the order that masks are numbered in.
        poses: Of each image ``(objects, 4, 4)`` from model to camera, metres.
        joints: Of each image what is said of arms and joints; ``None`` where nothing is.
    """

    folder: Path
    images: list[int]
    matrix: FloatArray
    objects: list[list[int]]
    poses: list[FloatArray]
    joints: list[list[dict[str, Any]]] | None

    def layers(self) -> list[Layer]:
        """Folders of masks that there are."""
        every: tuple[Layer, ...] = ("mask_visib", "mask")
        return [layer for layer in every if (self.folder / layer).is_dir()]

    def mask(self, layer: Layer, image: int, place: int, size: tuple[int, int]) -> NDArray[np.bool_]:
        """The mask of one object, ``(height, width)``.

        Raises:
            DatasetError: It is missing, damaged, or of another size; one line.
        """
        path = self.folder / layer / f"{image:06d}_{place:06d}.png"
        picture = decode_picture(read_bytes(path), str(path), *size, "the scene has")
        return np.asarray((picture if picture.ndim == 2 else picture[..., :3].max(axis=2)) > 0)

    def pictures(self) -> list[Path] | None:
        """Of each image the file in ``rgb/`` or ``gray/``; ``None`` where there are neither.

        Raises:
            DatasetError: Some are missing; one line.
        """
        for name in ("rgb", "gray"):
            place = self.folder / name
            if place.is_dir():
                return [_picture(place, image) for image in self.images]
        return None


def find_scenes(source: Path, split: str | None) -> dict[str, Path]:
    """Folders of scenes by name: the source itself, those in it, or those of one of its splits.

    Raises:
        DatasetError: There are none; one line.
        ConfigError: There are several splits, or not the one that is told; one line.
    """
    if not source.is_dir():
        raise DatasetError(f"{source}: no such folder; expected a dataset of BOP, a split or a scene")
    if (source / CAMERA_FILE).is_file():
        return {source.resolve().name: source}
    scenes = _scenes(source)
    if scenes and split is None:
        return scenes
    splits = {place.name: found for place in sorted(source.iterdir()) if place.is_dir() and (found := _scenes(place))}
    if split is not None and split not in splits:
        raise ConfigError(f"--split {split}: {source} has {', '.join(splits) or 'no splits'}")
    if len(splits) > 1 and split is None:
        raise ConfigError(f"{source}: has the splits {', '.join(splits)}; --split {next(iter(splits))} takes one")
    if not splits:
        raise DatasetError(f"{source}: holds no scenes (folders with {CAMERA_FILE} and {GT_FILE})")
    return splits[split or next(iter(splits))]


def find_links(scene: Path) -> dict[int, Link]:
    """What ``models/objects.json`` says, above a scene; empty where there is none.

    Raises:
        DatasetError: It is something else; one line.
    """
    for place in (scene.resolve(), *scene.resolve().parents[:2]):
        path = place / "models" / OBJECTS_FILE
        if path.is_file():
            try:
                return {
                    int(key): Link(
                        str(one["instrument"]),
                        str(one["link"]),
                        np.array(one["link_from_model_mm"], dtype=np.float64).reshape(3) / MM,
                    )
                    for key, one in _load(path).items()
                }
            except (KeyError, TypeError, ValueError):
                raise DatasetError(f"{path}: must have 'instrument', 'link' and 'link_from_model_mm' of each") from None
    return {}


def read_scene(folder: Path) -> Scene:
    """Read what a scene's files say.

    Raises:
        DatasetError: A file is missing or something else, or the camera changes; one line.
    """
    path, truths = folder / CAMERA_FILE, _by_image(folder / GT_FILE)
    cameras = _by_image(path)
    images = sorted(cameras)
    if not images:
        raise DatasetError(f"{path}: holds no images")
    lacking = [image for image in images if image not in truths]
    if lacking:
        raise DatasetError(f"{folder / GT_FILE}: image {lacking[0]} is missing (an image without objects has [])")
    matrices = np.stack([_numbers(path, image, cameras[image], "cam_K", 9) for image in images]).reshape(-1, 3, 3)
    if not np.allclose(matrices, matrices[0], atol=1e-3):
        raise DatasetError(f"{path}: the camera's matrix changes; a sequence has one camera")
    if abs(matrices[0][0, 1]) > 1e-6:
        raise DatasetError(f"{path}: the camera's axes are skewed, which is not supported")
    objects, poses = [], []
    for image in images:
        entries = truths[image]
        if not isinstance(entries, list):
            raise DatasetError(f"{folder / GT_FILE}: image {image}: must be a list of objects")
        objects.append([_object_id(folder / GT_FILE, image, one) for one in entries])
        poses.append(np.stack([_pose(folder / GT_FILE, image, one) for one in entries] or [np.eye(4)])[: len(entries)])
    joints = None
    if (folder / JOINTS_FILE).is_file():
        by_image = _by_image(folder / JOINTS_FILE)
        joints = [by_image.get(image, []) for image in images]
        if not all(isinstance(own, list) and all(isinstance(one, dict) for one in own) for own in joints):
            raise DatasetError(f"{folder / JOINTS_FILE}: must have a list of 'arm' and 'state' of each image")
    return Scene(folder, images, matrices[0], objects, poses, joints)


def _scenes(place: Path) -> dict[str, Path]:
    return {one.name: one for one in sorted(place.iterdir()) if one.is_dir() and (one / CAMERA_FILE).is_file()}


def _load(path: Path) -> dict[str, Any]:
    content = read_json(path)
    if not isinstance(content, dict):
        raise DatasetError(f"{path}: must be a mapping")
    return content


def _by_image(path: Path) -> dict[int, Any]:
    try:
        return {int(key): value for key, value in _load(path).items()}
    except ValueError:
        raise DatasetError(f"{path}: must be a mapping of images' numbers") from None


def _numbers(path: Path, image: int, entry: Any, key: str, count: int) -> FloatArray:
    try:
        values = np.array(entry[key], dtype=np.float64).reshape(-1)
    except (KeyError, TypeError, ValueError):
        values = np.empty(0)
    if len(values) != count or not np.isfinite(values).all():
        raise DatasetError(f"{path}: image {image}: '{key}' must be {count} numbers")
    return values


def _object_id(path: Path, image: int, entry: Any) -> int:
    if not isinstance(entry, Mapping) or not isinstance(entry.get("obj_id"), int):
        raise DatasetError(f"{path}: image {image}: 'obj_id' is missing")
    return int(entry["obj_id"])


def _pose(path: Path, image: int, entry: Any) -> FloatArray:
    pose = np.eye(4)
    pose[:3, :3] = _numbers(path, image, entry, "cam_R_m2c", 9).reshape(3, 3)
    pose[:3, 3] = _numbers(path, image, entry, "cam_t_m2c", 3) / MM
    return pose


def _picture(place: Path, image: int) -> Path:
    found = [path for suffix in PICTURE_SUFFIXES if (path := place / f"{image:06d}{suffix}").is_file()]
    if not found:
        raise DatasetError(f"{place / f'{image:06d}.png'}: missing")
    return found[0]
