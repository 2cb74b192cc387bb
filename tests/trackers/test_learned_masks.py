"""Mask source ``learned``: what it finds with the model that comes with the package, and bad input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.torch import save_file
from support import scene_of

from surgbench.camera import Camera
from surgbench.contract import Mask, Observation
from surgbench.errors import ConfigError, DatasetError, SurgbenchError
from surgbench.mask_sources import FoundMasks, MaskSource
from surgbench.registry import create, find
from surgbench.trackers.keypoints.resnet18 import MODELS
from surgbench.trackers.masks.learned import MODEL, LearnedMasks
from surgbench.trackers.masks.unet.model import load_network, save_network, without_norms
from surgbench.trackers.masks.unet.network import MaskNetwork, NetworkSettings
from surgbench.trackers.masks.unet.training import overlap

SMALL = NetworkSettings(width=4, input_px=64)
LARGEST_BYTES = 3_000_000


def painted(width: int, height: int) -> tuple[NDArray[np.uint8], Mask]:
    """A dark shaft with a bright end before red folds, and where it is."""
    rng = np.random.default_rng(1)
    folds = cv2.resize(rng.uniform(0.6, 1.3, (12, 16)), (width, height), interpolation=cv2.INTER_CUBIC)[..., None]
    image = folds * np.array([150.0, 70.0, 55.0])
    mask = np.zeros((height, width), np.uint8)
    axis = np.array([[1.05, 0.3], [0.55, 0.52], [0.45, 0.56]]) * [width, height]
    for (start, end), half, grey in zip(
        ((axis[0], axis[1]), (axis[1], axis[2])), (0.075 * height, 0.06 * height), (45.0, 150.0), strict=True
    ):
        along = (end - start) / np.linalg.norm(end - start)
        aside = np.array([-along[1], along[0]])
        rows, columns = np.mgrid[:height, :width]
        away = np.stack([columns, rows], -1) - start
        far, off = away @ along, away @ aside / half
        inside = (far >= 0) & (far <= np.linalg.norm(end - start)) & (np.abs(off) <= 1)
        # Round: brightest where it faces the light.
        image[inside] = (grey * (0.35 + 0.65 * np.sqrt(np.clip(1 - off**2, 0, 1))))[inside][:, None]
        mask[inside] = 1
    image = cv2.GaussianBlur(image, (0, 0), width / 700) + rng.normal(0, 3, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8), mask > 0


def frame_of(camera: Camera, image: NDArray[np.uint8] | None) -> Observation:
    view = replace(scene_of(camera).views[0], image=lambda: image)
    return Observation(0, 0.0, (view,), start=np.zeros(9))


def found(source: MaskSource, camera: Camera, image: NDArray[np.uint8] | None) -> FoundMasks:
    frame = frame_of(camera, image)
    source.reset(scene_of(camera, 2), frame.views[0], None)
    answer = source.segment(frame, frame.views[0])
    assert isinstance(answer, FoundMasks)
    return answer


def learned(**options: object) -> LearnedMasks:
    source: LearnedMasks = create(find("mask_source", "learned"), options)
    return source


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model with random weights."""
    path = tmp_path_factory.mktemp("model") / "weights.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        save_network(path, MaskNetwork(SMALL), SMALL)
    return path


def test_the_packages_model_is_small() -> None:
    assert MODEL.stat().st_size <= LARGEST_BYTES


def test_it_finds_a_painted_instrument(camera: Camera) -> None:
    image, mask = painted(camera.width, camera.height)
    answer = found(learned(), camera, image)
    assert answer.mask.shape == mask.shape
    assert overlap(answer.mask, mask) > 0.85
    assert answer.confidence > 0.8


def test_it_finds_nothing_before_bare_tissue(camera: Camera) -> None:
    image, _ = painted(camera.width, camera.height)
    # What is left of the instrument, and its mirror image.
    half = image[:, : int(0.4 * camera.width)]
    bare = np.ascontiguousarray(np.concatenate([half, half[:, ::-1], half], axis=1)[:, : camera.width])
    answer = found(learned(), camera, bare)
    assert answer.mask.mean() < 0.01


def test_a_higher_threshold_finds_less(camera: Camera) -> None:
    image, _ = painted(camera.width, camera.height)
    sizes = [int(found(learned(threshold=share), camera, image).mask.sum()) for share in (0.1, 0.5, 0.9)]
    assert sizes[0] > sizes[1] > sizes[2] > 0


def test_where_nothing_is_found_it_is_sure_of_nothing(weights: Path, small_camera: Camera) -> None:
    image = np.zeros((small_camera.height, small_camera.width, 3), np.uint8)
    answer = found(learned(model=str(weights), threshold=1 - 1e-9), small_camera, image)
    assert not answer.mask.any()
    assert answer.confidence == 0


def test_a_fused_network_gives_the_same_answers() -> None:
    network, size = load_network(MODEL)
    image, _ = painted(size.input_px, 256)
    picture = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 127.5 - 1
    with torch.inference_mode():
        torch.testing.assert_close(without_norms(network)(picture), network(picture), rtol=1e-3, atol=1e-3)


def test_an_image_of_another_size_is_told_in_one_line(weights: Path, small_camera: Camera) -> None:
    for shape in ((10, 20, 3), (small_camera.width, small_camera.height, 3)):
        with pytest.raises(DatasetError, match=r"frame 0: the image is .* pixels, not 88 x 62 as its camera's are$"):
            found(learned(model=str(weights)), small_camera, np.zeros(shape, np.uint8))


def test_data_without_images_are_told(weights: Path, small_camera: Camera) -> None:
    with pytest.raises(DatasetError, match="frame 0 has no image"):
        found(learned(model=str(weights)), small_camera, None)


def test_weights_that_are_none_are_told_in_one_line(tmp_path: Path, weights: Path, small_camera: Camera) -> None:
    data = weights.read_bytes()
    with safe_open(weights, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no dictionary)
    save_file(tensors, tmp_path / "wider.safetensors", size_of(8))
    blank = {**tensors, "mask.bias": torch.full((4,), torch.nan)}
    save_file(blank, tmp_path / "nan.safetensors", size_of(4))
    (tmp_path / "short.safetensors").write_bytes(data[:-100])
    (tmp_path / "text.safetensors").write_text("weights")
    for name, message in {
        "wider": "not those of a network of width 8: 'stem.convolution.weight' is",
        "nan": "'mask.bias' is not finite",
        "short": "no readable safetensors file",
        "text": "no readable safetensors file",
    }.items():
        path = tmp_path / f"{name}.safetensors"
        with pytest.raises(SurgbenchError, match=message) as caught:
            found(learned(model=str(path)), small_camera, np.zeros((62, 88, 3), np.uint8))
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


def size_of(width: int) -> dict[str, str]:
    return {"surgbench-instrument-masks-1": json.dumps({"width": width, "input_px": 64})}


def test_a_model_of_something_else_is_told(small_camera: Camera) -> None:
    other = MODELS / "resnet18" / "weights.safetensors"
    with pytest.raises(SurgbenchError, match="not a model of instrument masks"):
        found(learned(model=str(other)), small_camera, np.zeros((62, 88, 3), np.uint8))


def test_a_record_says_which_weights_there_were(weights: Path, tmp_path: Path) -> None:
    one, own = (learned(**options).config for options in ({"model": str(weights)}, {}))
    assert len(one.model_sha256) == 16
    assert one.model_sha256 != own.model_sha256
    with pytest.raises(ConfigError, match="has changed"):
        learned(model=str(weights), model_sha256="0" * 16)
    with pytest.raises(ConfigError, match="no model"):
        learned(model=str(tmp_path / "none.safetensors"))
