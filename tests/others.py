"""Recordings in others' formats, made small for tests, and imported by the command as a user types it."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from commandline import surgbench

from surgbench.camera import Camera
from surgbench.dataset.open import open_as
from surgbench.dataset.validate import validate
from surgbench.instrument import load_instrument
from surgbench.tasks.instrument.dataset import InstrumentDataset

WIDTH, HEIGHT = 64, 48
CAMERA = Camera(width=WIDTH, height=HEIGHT, fx=80.0, fy=80.0, cx=31.5, cy=23.5)
# A true state of each arm in two frames, for scenes of BOP.
DRIVER = load_instrument("large_needle_driver")
LINKS = list(DRIVER.meshes)
STATES = {
    "left": np.array([[0.3, 0.4, 0.8, -0.01, 0, 0.13, 0.3, -0.2, 0.3], [0.3, 0.5, 0.8, -0.01, 0, 0.13, 0.3, 0.2, 0.1]]),
    "right": np.array([[-0.2, -2.5, -0.9, 0.02, 0.0, 0.14, -0.1, 0.4, 0.1]] * 2),
}  # fmt: skip


def bar(frame: int, top: int = 8) -> np.ndarray:
    """A mask ``(HEIGHT, WIDTH)`` bool of something that enters from the left and grows."""
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[top : top + 8, : 24 + 2 * frame] = True
    return mask


def grey(frame: int) -> np.ndarray:
    """A picture ``(HEIGHT, WIDTH, 3)`` whose brightness tells its frame."""
    return np.full((HEIGHT, WIDTH, 3), 20 + 10 * frame, np.uint8)


def put(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix, picture)[1].tobytes())


def put_camera(folder: Path, camera: Camera = CAMERA) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "camera.json"
    path.write_text(camera.model_dump_json())
    return path


def put_video(path: Path, pictures: Iterable[np.ndarray], fps: float = 30.0, codec: str = "FFV1") -> None:
    """A video without loss, so that frames can be told apart."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = None
    for picture in pictures:
        shown = picture if picture.ndim == 3 else np.repeat(picture.astype(np.uint8)[..., None] * 255, 3, axis=2)
        if writer is None:
            size = (shown.shape[1], shown.shape[0])
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, size)
            if not writer.isOpened():
                pytest.skip(f"this OpenCV has no encoder for {codec}")
        writer.write(shown)
    assert writer is not None
    writer.release()


def put_json(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def imported(importer: str, source: Path, *options: object, out: Path) -> InstrumentDataset:
    """What the command makes of it; sound, and without anything left beside it."""
    surgbench("import", importer, source, *options, "--out", out)
    assert validate(out) == []
    assert not list(out.parent.glob(".*"))
    return open_as(InstrumentDataset, out)


def refused(capsys: pytest.CaptureFixture[str], importer: str, source: Path, *options: object, out: Path) -> str:
    """The one line that the command says, having left nothing behind."""
    capsys.readouterr()
    surgbench("import", importer, source, *options, "--out", out, expect=2)
    assert not out.exists()
    assert not list(out.parent.glob(".*"))
    said = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("frames: ")]
    assert len(said) == 1
    return said[0]


def put_scene(folder: Path, objects: list[list[int]], *, layer: str = "mask_visib") -> Path:
    """Of each image the ids of its objects; their masks are bars, further down the later they come."""
    entries: dict[str, list[dict[str, Any]]] = {}
    for image, own in enumerate(objects):
        entries[str(image)] = [
            {"obj_id": one, "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, 130]} for one in own
        ]
        for place in range(len(own)):
            put(folder / layer / f"{image:06d}_{place:06d}.png", 255 * bar(image, 4 + 10 * place).astype(np.uint8))
    put_json(folder / "scene_gt.json", entries)
    matrix = {"cam_K": CAMERA.matrix.ravel().tolist(), "depth_scale": 1.0}
    put_json(folder / "scene_camera.json", {str(image): matrix for image in range(len(objects))})
    return folder


def put_articulated(root: Path) -> Path:
    """Both arms, each of the driver's links an object; models have their origin away from the link's."""
    moved = np.array([1.0, -2.0, 3.0])
    folder = put_scene(root / "test/000000", [[*range(1, len(LINKS) + 1)] * 2] * 2, layer="mask")
    about = {
        str(number): {"instrument": DRIVER.name, "link": link, "link_from_model_mm": moved.tolist()}
        for number, link in enumerate(LINKS, start=1)
    }
    put_json(root / "models/objects.json", about)
    joints: dict[str, Any] = {}
    entries: dict[str, list[dict[str, Any]]] = {}
    for frame in range(2):
        joints[str(frame)] = [{"arm": arm, "state": STATES[arm][frame].tolist()} for arm in ("right", "left")]
        entries[str(frame)] = []
        for arm in ("right", "left"):
            for number, link in enumerate(LINKS, start=1):
                pose = DRIVER.link_transforms(STATES[arm][frame])[DRIVER.link_index[link]]
                entries[str(frame)].append(
                    {
                        "obj_id": number,
                        "cam_R_m2c": pose[:3, :3].ravel().tolist(),
                        "cam_t_m2c": (1e3 * pose[:3, 3] + pose[:3, :3] @ moved).tolist(),
                    }
                )
    put_json(folder / "scene_joints.json", joints)
    put_json(folder / "scene_gt.json", entries)
    return root
