"""Keypoint source ``resnet18``: the square, the peaks, the model that comes with the package, and bad input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
import torch
from commandline import records, surgbench
from hypothesis import example, given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file
from support import observe, resting_state, scene_of

from surgbench import extras
from surgbench.camera import Camera
from surgbench.comparison.keypoints import groups, measure, picture, worst
from surgbench.contract import Mask
from surgbench.errors import ConfigError, SurgbenchError
from surgbench.generators.tip_masks import HELD_OUT, TipMasks, TipMaskSettings
from surgbench.geometry import FloatArray
from surgbench.instrument import load_instrument
from surgbench.keypoints.accuracy import accuracy, outcome, pair_errors
from surgbench.registry import configure, create, find
from surgbench.trackers.keypoints.heatmaps.detector import Look, TipDetector
from surgbench.trackers.keypoints.heatmaps.fusion import without_norms
from surgbench.trackers.keypoints.heatmaps.model import load_network, save_network
from surgbench.trackers.keypoints.heatmaps.network import HeatmapNetwork, NetworkSettings
from surgbench.trackers.keypoints.heatmaps.peaks import exactly_two, find_peaks
from surgbench.trackers.keypoints.heatmaps.square import OUTSIDE, Square, find_square
from surgbench.trackers.keypoints.resnet18 import ResNet18Keypoints

SIZE = 128
SMALL = NetworkSettings(width=4, head=4, input_px=64)


@pytest.fixture(scope="module")
def source(camera: Camera) -> ResNet18Keypoints:
    found = ResNet18Keypoints()
    found.reset(scene_of(camera))
    return found


def mask_of(camera: Camera) -> tuple[Mask, FloatArray]:
    """An instrument with open jaws, and its tips."""
    state = resting_state()
    return observe(scene_of(camera), state).mask, camera.project(load_instrument("large_needle_driver").tips_cam(state))


def detect(source: ResNet18Keypoints, mask: Mask, arms: int = 1) -> tuple[FloatArray | None, ...]:
    height, width = mask.shape
    camera = Camera(width=width, height=height, fx=900.0, fy=900.0, cx=width / 2, cy=height / 2)
    scene = scene_of(camera, arms)
    view = replace(scene.views[0], mask=mask)
    frame = replace(observe(scene_of(camera), resting_state()), views=(view,))
    found: tuple[FloatArray | None, ...] = source.detect(frame, view)
    return found


# The square.


def test_the_square_turns_with_the_mask(camera: Camera) -> None:
    mask, _ = mask_of(camera)
    square = find_square(mask)
    turned = find_square(np.ascontiguousarray(np.rot90(mask)))
    assert square is not None
    assert turned is not None
    assert turned.side_px == pytest.approx(square.side_px, rel=0.03)
    # A quarter turn against the clock, in an image whose rows point down.
    assert np.cos(turned.up_rad - square.up_rad + np.pi / 2) == pytest.approx(1.0, abs=0.002)
    one, other = square.cut(mask, SIZE), turned.cut(np.ascontiguousarray(np.rot90(mask)), SIZE)
    assert np.mean((one > 127) != (other > 127)) < 0.02


def test_the_tips_are_in_the_square_and_the_shaft_comes_from_below(camera: Camera) -> None:
    mask, tips = mask_of(camera)
    square = find_square(mask)
    assert square is not None
    affine = square.to_square(SIZE)
    places = tips @ affine[:, :2].T + affine[:, 2]
    assert ((places > 5) & (places < SIZE - 5)).all()
    cut = square.cut(mask, SIZE)
    assert (cut[-8:] > 127).sum() > (cut[:8] > 127).sum()
    assert places[:, 1].max() < SIZE * 0.7


@settings(max_examples=25)
@given(st.lists(st.floats(0, SIZE), min_size=2, max_size=2))
def test_pixels_of_the_square_go_there_and_back(place: list[float]) -> None:
    mask = np.zeros((300, 400), dtype=bool)
    cv2.ellipse(shade := mask.view(np.uint8), (200, 120), (40, 140), 30, 0, 360, 1, -1)
    assert shade.any()
    square = find_square(mask)
    assert square is not None
    point = np.array(place)
    affine = square.to_square(SIZE)
    assert affine[:, :2] @ square.to_image(point, SIZE) + affine[:, 2] == pytest.approx(point, abs=1e-9)


def test_beyond_the_image_is_neither_mask_nor_background() -> None:
    mask = np.zeros((200, 300), dtype=bool)
    mask[:60, 140:160] = True
    square = find_square(mask)
    assert square is not None
    low = replace(square, centre_px=np.array([150.0, 199.0]), side_px=100.0, up_rad=-np.pi / 2)
    cut = low.cut(mask, SIZE)
    assert (cut[:50] == 0).all()
    assert (cut[-50:] == OUTSIDE).all()


# The peaks.


def logits_of(places: FloatArray, sigma: float = 1.25) -> np.ndarray:
    steps = np.arange(SIZE)
    heat = np.zeros((SIZE, SIZE))
    for column, row in places:
        away = (steps[None] - column) ** 2 + (steps[:, None] - row) ** 2
        heat = np.maximum(heat, 0.999 * np.exp(-0.5 * away / sigma**2))
    heat = np.clip(heat, 1e-6, None)
    return np.asarray(np.log(heat / (1 - heat)), dtype=np.float32)


coordinate = st.floats(8, SIZE - 9)


@settings(max_examples=60)
@given(coordinate, coordinate, st.floats(0, 6.28), st.floats(6, 40))
@example(8.0, 8.0, 0.0, 6.5)  # halfway between two pixels, which are equally hot
def test_two_tips_are_found_to_a_fraction_of_a_pixel(u: float, v: float, way: float, apart: float) -> None:
    other = np.clip(np.array([u, v]) + apart * np.array([np.cos(way), np.sin(way)]), 4, SIZE - 5)
    places = np.array([[u, v], other])
    if np.linalg.norm(places[0] - places[1]) < 6:
        return
    found = exactly_two(find_peaks(logits_of(places), 0.3, 2)[0])
    assert found is not None
    assert pair_errors(found, places).max() < 0.05


@pytest.mark.parametrize("count", [0, 1, 3])
def test_other_than_two_peaks_are_no_pair(count: int) -> None:
    places = np.array([[20.0, 20.0], [60.0, 30.0], [90.0, 100.0]])[:count].reshape(-1, 2)
    found, heat = find_peaks(logits_of(places), 0.3, 2)
    assert len(found) == len(heat) == count
    assert exactly_two(found) is None


def test_tips_in_one_place_are_one_peak() -> None:
    assert len(find_peaks(logits_of(np.array([[50.0, 50.0], [50.8, 50.3]])), 0.3, 2)[0]) == 1


def test_a_weak_peak_does_not_stand_out() -> None:
    logits = logits_of(np.array([[20.0, 20.0]])) + np.float32(-8.5)
    assert len(find_peaks(logits, 0.3, 2)[0]) == 0
    assert len(find_peaks(logits, 0.01, 2)[0]) == 1


# The network and its file.


@pytest.mark.slow
def test_normalisations_fold_into_convolutions() -> None:
    torch.manual_seed(0)
    network = HeatmapNetwork(SMALL)
    network.train()
    for _ in range(3):  # so that the normalisations do something
        network(torch.rand(4, 1, 64, 64))
    network.eval()
    pictures = torch.rand(2, 1, 64, 64)
    with torch.inference_mode():
        expected, found = network(pictures), without_norms(network)(pictures)
    assert expected.shape == (2, 64, 64)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_a_network_comes_back_from_its_file_in_half_precision(tmp_path: Path) -> None:
    network = HeatmapNetwork(SMALL).eval()
    save_network(tmp_path / "model.safetensors", network, SMALL)
    found, size = load_network(tmp_path / "model.safetensors")
    assert size == SMALL
    assert not found.training
    for name, tensor in network.state_dict().items():
        if tensor.is_floating_point():
            torch.testing.assert_close(found.state_dict()[name], tensor, rtol=1e-3, atol=1e-6)


def damaged(path: Path) -> None:
    save_network(path, HeatmapNetwork(SMALL), SMALL)
    path.write_bytes(path.read_bytes()[:-100])


def no_safetensors(path: Path) -> None:
    torch.save({"weights": torch.zeros(3)}, path)  # a pickle, which must not be read


def of_something_else(path: Path) -> None:
    save_file({"weight": torch.zeros(3)}, path)


def of_another_width(path: Path) -> None:
    save_network(path, HeatmapNetwork(NetworkSettings(width=8, head=4, input_px=64)), SMALL)


def not_finite(path: Path) -> None:
    network = HeatmapNetwork(SMALL)
    with torch.no_grad():
        network.heat.weight[0] = torch.nan
    save_network(path, network, SMALL)


def of_wrong_settings(path: Path) -> None:
    save_file({"weight": torch.zeros(3)}, path, {"surgbench-tip-heatmaps-1": '{"width": "a"}'})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (damaged, "no readable safetensors file"),
        (no_safetensors, "no readable safetensors file"),
        (of_something_else, "not a model of tip heatmaps"),
        (of_another_width, "not those of a network of width 4"),
        (not_finite, "is not finite"),
        (of_wrong_settings, "'width'"),
    ],
)
def test_a_file_that_is_no_model_is_told_in_one_line(tmp_path: Path, make: object, message: str) -> None:
    path = tmp_path / "model.safetensors"
    make(path)  # type: ignore[operator]
    with pytest.raises(SurgbenchError, match=message) as caught:
        load_network(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_model_that_is_not_there_is_told_with_those_that_are() -> None:
    with pytest.raises(ConfigError, match=r"no model 'resnet81' \(valid: resnet18"):
        configure(find("keypoints", "resnet18"), {"model": "resnet81"})


def test_the_hash_of_the_weights_is_an_option_and_no_change() -> None:
    config = configure(find("keypoints", "resnet18"), {})
    assert config is not None
    options = config.model_dump()
    assert len(options["model_sha256"]) == 16
    assert config.model_dump(exclude_unset=True) == {}
    create(find("keypoints", "resnet18"), options)
    with pytest.raises(ConfigError, match="has changed"):
        configure(find("keypoints", "resnet18"), {**options, "model_sha256": "0" * 16})


# One peak, two, or more.


@pytest.mark.parametrize(
    ("heats", "options", "count"),
    [
        ([0.9], {}, 0),
        ([0.9], {"single_heat": 0.5}, 1),
        ([0.45], {"single_heat": 0.5}, 0),
        ([0.9, 0.8], {}, 2),
        ([0.9, 0.3], {"single_heat": 0.5}, 1),
        ([0.9, 0.8, 0.7], {}, 0),
        ([0.9, 0.8, 0.7], {"single_heat": 0.5}, 0),
        ([0.9, 0.8, 0.7], {"peaks": "top"}, 2),
    ],
)
def test_what_peaks_become(
    monkeypatch: pytest.MonkeyPatch, heats: list[float], options: dict[str, Any], count: int
) -> None:
    square = Square(centre_px=np.array([32.0, 32.0]), side_px=64.0, up_rad=0.0)
    peaks = np.arange(2.0 * len(heats)).reshape(-1, 2)
    look = Look(square, np.zeros((64, 64), np.uint8), np.zeros((64, 64), np.float32), peaks, np.array(heats))
    detector = TipDetector(HeatmapNetwork(SMALL), SMALL, 0.36, 2, **options)
    monkeypatch.setattr(detector, "look", lambda mask: look)
    found = detector.detect(np.zeros((64, 64), dtype=bool))
    assert (0 if found is None else len(found)) == count
    if found is not None:
        np.testing.assert_allclose(found, square.to_image(peaks[:count], SMALL.input_px))


# Engines.


def test_an_engine_that_is_not_installed_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"onnx and onnxruntime are not installed: pip install 'surgbench\[onnx\]'"):
        configure(find("keypoints", "resnet18"), {"engine": "onnxruntime"})
    config = configure(find("keypoints", "resnet18"), {"engine": "auto"})
    assert config is not None
    assert config.model_dump()["engine"] == "torch"


@pytest.mark.extras
@pytest.mark.slow
def test_onnx_runtime_finds_the_same_tips(source: ResNet18Keypoints, camera: Camera) -> None:
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    other = ResNet18Keypoints(ResNet18Keypoints.Config(engine="auto"))
    assert other.config.engine == "onnxruntime"
    other.reset(scene_of(camera))
    answers = 0
    for one in TipMasks(HELD_OUT, 40, seed=5, part="test"):
        (expected,), (found,) = detect(source, one.mask), detect(other, one.mask)
        assert (found is None) == (expected is None)
        if found is not None and expected is not None:
            answers += 1
            np.testing.assert_allclose(found, expected, atol=0.05)
    assert answers > 20


# The model that comes with the package.


def test_the_model_is_small_and_says_where_it_is_from() -> None:
    folder = Path(ResNet18Keypoints().config.path).parent
    assert (folder / "weights.safetensors").stat().st_size <= 6e6
    config = json.loads((folder / "config.json").read_text())
    assert NetworkSettings(**config["network"]) == load_network(folder / "weights.safetensors")[1]
    assert json.loads((folder / "accuracy.json").read_text())["seed"] == config["seed"]
    assert (folder / "log.csv").read_text().startswith("epoch,")


@pytest.mark.slow
def test_it_finds_the_tips_of_masks_that_it_was_not_trained_on(source: ResNet18Keypoints, camera: Camera) -> None:
    """Bounds of the issue, on few masks; results/keypoints has many."""
    published = HELD_OUT.model_copy(update={"corruption": {"published": 1.0}})
    masks = TipMasks(published, 600, seed=11, part="test")
    seen = measure(source, masks, load_instrument("large_needle_driver"), lambda _: None)
    found = accuracy([one.outcome for one in seen])
    assert found.detected_percent is not None
    assert found.detected_percent >= 93
    assert found.median_error_px is not None
    assert found.median_error_px <= 1.5
    assert found.p95_error_px is not None
    assert found.p95_error_px <= 5
    assert found.false_pair_percent is not None
    assert found.false_pair_percent <= 3


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_it_finds_them_at_any_size_of_image(source: ResNet18Keypoints, camera: Camera, scale: float) -> None:
    mask, tips = mask_of(camera)
    size = (round(scale * camera.width), round(scale * camera.height))
    resized = (
        cv2.resize(mask.view(np.uint8), size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST) > 0
    )
    (found,) = detect(source, resized)
    assert found is not None
    # Pixel centres are at whole numbers: the image's corner is at (-0.5, -0.5).
    assert pair_errors(found, (tips + 0.5) * scale - 0.5).max() < 4 * scale


def test_one_thread_and_many_find_the_same(source: ResNet18Keypoints, camera: Camera) -> None:
    mask, _ = mask_of(camera)
    before = torch.get_num_threads()
    (alone,) = detect(source, mask)
    assert torch.get_num_threads() == before
    torch.set_num_threads(2)
    try:
        (together,) = detect(source, mask)
    finally:
        torch.set_num_threads(before)
    assert alone is not None
    assert together is not None
    assert np.array_equal(alone, together)


def blobs() -> Mask:
    image = np.zeros((493, 700), np.uint8)
    for centre in ((100, 100), (400, 80), (600, 400), (300, 300)):
        cv2.circle(image, centre, 25, 1, -1)
    return image.astype(bool)


@pytest.mark.parametrize(
    "mask",
    [
        np.zeros((493, 700), bool),
        np.ones((493, 700), bool),
        blobs(),
        np.zeros((1, 1), bool),
        np.ones((3, 2), bool),
        np.eye(40, dtype=bool),
        np.pad(np.ones((2, 2), bool), 100),
        np.ones((1, 900), bool),
        np.asfortranarray(blobs()),
    ],
    ids=["empty", "full", "blobs", "pixel", "tiny", "line", "speck", "strip", "column-major"],
)
def test_masks_that_show_no_instrument_have_no_tips(source: ResNet18Keypoints, mask: Mask) -> None:
    assert detect(source, mask) == (None,)


def test_each_arm_is_looked_at_in_its_own_part(camera: Camera) -> None:
    scene, source = scene_of(camera, arms=2), ResNet18Keypoints()
    source.reset(scene)
    left, right = resting_state(), resting_state()
    left[[2, 3]], right[[2, 3]] = [0.8, -0.025], [-0.8, 0.04]
    frame = observe(scene, np.concatenate([left, right]))
    found = source.detect(frame, frame.views[0])
    assert len(found) == 2
    for pair, state in zip(found, (left, right), strict=True):
        tips = camera.project(scene.instruments[0].tips_cam(state))
        assert pair is not None
        assert pair_errors(pair, tips).max() < 5


# From the command line.


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "mini"
    surgbench("generate", "mini", "--out", path, "--sequences", 1, "--frames", 3, "--jobs", 1)
    return path


@pytest.mark.slow
def test_it_is_the_default_without_readings_and_its_time_counts(dataset: Path, tmp_path: Path) -> None:
    """Of a tracker that looks at the tips in every frame; hybrid does in the first, and where it needs them."""
    for tracker in ("cmaes", "hybrid"):
        surgbench("run", "--dataset", dataset, "--tracker", tracker, "--sequences", 1, "--out", tmp_path / tracker)
    (record,), (seldom,) = records(tmp_path / "cmaes"), records(tmp_path / "hybrid")
    assert (record["status"], seldom["status"]) == ("ok", "ok")
    waited_ms = seldom["frames"]["latency_keypoints_ms"]
    assert waited_ms[0] > 0
    assert min(waited_ms) == 0
    assert record["spec"]["keypoints"]["name"] == "resnet18"
    assert len(record["spec"]["keypoints"]["options"]["model_sha256"]) == 16
    assert record["variant"] == "default"
    frames = record["frames"]
    for whole, part in zip(frames["latency_ms"], frames["latency_keypoints_ms"], strict=True):
        assert 0 < part < whole


@pytest.mark.slow
def test_with_readings_the_datasets_own_tips_are_the_default(dataset: Path, tmp_path: Path) -> None:
    surgbench("run", "--dataset", dataset, "--tracker", "hybrid", "--joints", "--sequences", 1, "--out", tmp_path)
    assert records(tmp_path)[0]["spec"]["keypoints"]["name"] == "observed"


def test_a_missing_model_is_one_line(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    option = "resnet18.model=nowhere.safetensors"
    surgbench("run", "--dataset", dataset, "--tracker", "cmaes", "--set", option, "--out", tmp_path, expect=2)
    complaint = capsys.readouterr().err
    assert "no model 'nowhere.safetensors'" in complaint
    assert complaint.count("\n") == 1


@pytest.mark.slow
def test_a_damaged_model_costs_its_runs_one_line(dataset: Path, tmp_path: Path) -> None:
    damaged(tmp_path / "broken.safetensors")
    out = tmp_path / "runs"
    option = f"resnet18.model={tmp_path / 'broken.safetensors'}"
    arguments = ("run", "--dataset", dataset, "--tracker", "hybrid", "--sequences", 1, "--set", option, "--out", out)
    surgbench(*arguments, expect=1)
    (record,) = records(out)
    assert record["status"] == "failed"
    assert "no readable safetensors file" in record["error"]


@pytest.mark.slow
def test_sources_are_measured_side_by_side(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("bench", "keypoints", "--masks", 30, "--json", "--out", tmp_path)
    rows = json.loads(capsys.readouterr().out)
    assert {row["keypoints"] for row in rows} == {"resnet18", "corners"}
    assert {row["by"] for row in rows} == {"all", "corruption", "opening"}
    whole = {row["keypoints"]: row for row in rows if row["by"] == "all"}
    assert whole["resnet18"]["detected_percent"] > whole["corners"]["detected_percent"]
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    for key in ("detected_percent", "median_error_px", "p95_error_px", "false_pair_percent", "latency_ms"):
        assert metrics[key] is not None
    for name in ("resnet18-worst.png", "corners-examples.png"):
        assert cv2.imread(str(tmp_path / name)) is not None
    assert len((tmp_path / "accuracy.csv").read_text().splitlines()) == len(rows) + 1


@pytest.mark.slow
def test_the_worst_are_first_and_shown() -> None:
    masks = TipMasks(TipMaskSettings(), 12, seed=2, part="test")

    class Wrong:
        name: ClassVar[str] = "wrong"

        def reset(self, scene: object) -> None: ...

        def detect(self, observation: object, view: object) -> tuple[FloatArray | None, ...]:
            return (np.array([[0.0, 0.0], [5.0, 5.0]]),)

    seen = measure(Wrong(), masks, load_instrument("large_needle_driver"), lambda _: None)
    first = worst(seen, 3)
    assert all(one.outcome.false for one in first)
    for one in first:
        again = outcome(masks[one.index], one.pair)
        assert np.array_equal(one.outcome.errors_px, again.errors_px)  # type: ignore[arg-type]
    assert picture(masks, first).ndim == 3
    assert groups("wrong", seen)[0].found.detected_percent == 0.0
