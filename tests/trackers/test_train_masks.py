"""``surgbench train masks``: it learns, it goes on where it stopped, and says what is wrong in one line."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from commandline import surgbench
from hypothesis import given
from hypothesis import strategies as st

from surgbench import open_dataset
from surgbench.camera import Camera
from surgbench.cli.training_masks import load_training, measure
from surgbench.cli.training_pictures import PictureSource
from surgbench.errors import ConfigError, SurgbenchError
from surgbench.generators.generate import generate, plan_dataset
from surgbench.generators.looks.sections import Images
from surgbench.generators.presets import Preset
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.trackers.learning.course import LEAST_CHANNELS_LAST
from surgbench.trackers.masks.learned import MODEL
from surgbench.trackers.masks.unet.looks import LookSettings, Pictures
from surgbench.trackers.masks.unet.model import Segmenter, input_size, load_network
from surgbench.trackers.masks.unet.network import MaskNetwork, NetworkSettings
from surgbench.trackers.masks.unet.pictures import pictures
from surgbench.trackers.masks.unet.training import Training, TrainingSettings, mask_loss, overlap

NETWORK = NetworkSettings(width=4, input_px=64)
SHORT = TrainingSettings(epochs=3, batch=4, looks=2, bfloat16=False)
LOOKS = LookSettings(cut_px=(64, 32))
SMALL = Camera(width=96, height=64, fx=124.0, fy=122.5, cx=42.3, cy=31.1)
TINY = """
set:
  camera: {{width: 96, height: 64, fx: 124.0, fy: 122.5, cx: 42.3, cy: 31.1}}
  images: {{samples: 1, variant: scalar_rgb}}
data: {{tissue: {{preset: endoscope, sequences: 1, frames: 2}}}}
validation: {{made: {{dataset: {made}}}}}
test: {{made: {{dataset: {made}}}}}
network: {{width: 4, input_px: 96}}
looks: {{cut_px: [64, 32]}}
training: {{epochs: 2, batch: 2, looks: 2, bfloat16: false}}
"""


def painted(count: int, width: int = 80, height: int = 60) -> Pictures:
    """Grey bars before something red."""
    rng = np.random.default_rng(3)
    images, masks = [], []
    for _ in range(count):
        image = rng.integers(0, 60, (height, width, 3)).astype(np.uint8) + np.array([120, 20, 10], np.uint8)
        mask = np.zeros((height, width), np.uint8)
        near, far = rng.integers(0, height, 2)
        cv2.line(mask, (width, int(near)), (width // 3, int(far)), 255, 14)
        image[mask > 0] = rng.integers(90, 110, 3)
        images.append(image)
        masks.append(mask)
    return Pictures(images, masks, NETWORK.input_px, LOOKS)


@pytest.fixture(scope="module")
def bars() -> Pictures:
    return painted(8)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of which the left arm is not in the images."""
    out = tmp_path_factory.mktemp("made") / "one-arm"
    images = Images(samples=1, variant="scalar_rgb", arms=("right",), backdrop=("drape",))
    assert generate(plan_dataset(Preset(name="one-arm", pairs=1, frames=2, camera=SMALL, images=images)), out)
    return out


def quiet(_: Any) -> None: ...


def trained(folder: Path, bars: Pictures, settings: TrainingSettings = SHORT, **identity: Any) -> Training:
    training = Training(folder, NETWORK, settings, 0, "cpu", identity)
    training.run(bars, bars, quiet, quiet)
    return training


@pytest.mark.slow
def test_it_learns(tmp_path: Path, bars: Pictures) -> None:
    trained(tmp_path, bars, SHORT.model_copy(update={"epochs": 12, "looks": 4, "learning_rate": 0.01}))
    log = list(csv.DictReader((tmp_path / "log.csv").read_text().splitlines()))
    assert float(log[-1]["training_loss"]) < 0.6 * float(log[0]["training_loss"])
    assert float(log[-1]["iou"]) > 0.8
    network, size = load_network(tmp_path / "weights.safetensors")
    found = Segmenter(network, size, 80, 60).logits(bars.images[0]) > 0
    assert overlap(found, bars.masks[0] > 0) > 0.7


@pytest.mark.slow
@pytest.mark.parametrize("width", [NETWORK.width, pytest.param(LEAST_CHANNELS_LAST, marks=pytest.mark.long)])
def test_gradients_are_right_in_either_memory_format(tmp_path: Path, bars: Pictures, width: int) -> None:
    """Against double precision, which takes other kernels."""
    network = NETWORK.model_copy(update={"width": width})
    training = Training(tmp_path, network, SHORT, 0, "cpu", {})
    exact = MaskNetwork(network).double()
    exact.load_state_dict(training._network.state_dict())
    chosen = np.arange(4)
    training._batch_loss(bars, chosen, np.random.default_rng(0)).backward()
    shown, masks = bars.looks(chosen, np.random.default_rng(0))
    batch = torch.from_numpy(shown).permute(0, 3, 1, 2).double() / 127.5 - 1
    mask_loss(exact(batch), torch.from_numpy(masks).double() / 255, SHORT.edge_weight).backward()
    for (name, one), other in zip(training._network.named_parameters(), exact.parameters(), strict=True):
        assert one.grad is not None
        assert other.grad is not None
        error = float((one.grad - other.grad).abs().max() / other.grad.abs().max())
        assert error < 1e-3, name


@pytest.mark.slow
@pytest.mark.parametrize("width", [NETWORK.width, pytest.param(LEAST_CHANNELS_LAST, marks=pytest.mark.long)])
def test_an_interrupted_training_ends_like_an_uninterrupted_one(tmp_path: Path, bars: Pictures, width: int) -> None:
    """To the last bit: the weights, and the log but for its times; in either memory format."""
    network = NETWORK.model_copy(update={"width": width})
    Training(tmp_path / "whole", network, SHORT, 0, "cpu", {}).run(bars, bars, quiet, quiet)
    shares: list[float] = []

    def interrupt(share: float) -> None:
        shares.append(share)
        if sum(shares) > 1.4:  # in the middle of the second epoch
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Training(tmp_path / "halves", network, SHORT, 0, "cpu", {}).run(bars, bars, interrupt, quiet)
    resumed = Training(tmp_path / "halves", network, SHORT, 0, "cpu", {})
    assert resumed.epoch == 1
    resumed.run(bars, bars, quiet, quiet)
    whole, halves = ((tmp_path / name / "weights.safetensors").read_bytes() for name in ("whole", "halves"))
    assert whole == halves
    logs = [
        [line.rpartition(",")[0] for line in (tmp_path / name / "log.csv").read_text().splitlines()]
        for name in ("whole", "halves")
    ]
    assert logs[0] == logs[1]


@pytest.mark.slow
def test_the_command_trains_and_its_model_is_one(
    tmp_path: Path, made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tiny.yaml").write_text(TINY.format(made=made))
    out = tmp_path / "model"
    surgbench("train", "masks", tmp_path / "tiny.yaml", "--out", out, "--jobs", 1)
    assert capsys.readouterr().out.strip().endswith("weights.safetensors")
    found = json.loads((out / "accuracy.json").read_text())
    assert found["made"]["pictures"] == 2
    assert found["made"] == measure(out / "weights.safetensors", made)
    assert json.loads((out / "config.json").read_text())["network"]["width"] == 4
    weights = (out / "weights.safetensors").read_bytes()
    surgbench("train", "masks", tmp_path / "tiny.yaml", "--out", out, "--jobs", 1)
    assert "goes on after 2 epochs" in capsys.readouterr().err
    assert (out / "weights.safetensors").read_bytes() == weights
    surgbench("train", "masks", tmp_path / "tiny.yaml", "--out", out, "--set", "training.batch=1", expect=2)
    assert "other settings" in capsys.readouterr().err
    assert (out / "weights.safetensors").read_bytes() == weights


@pytest.mark.slow
def test_pictures_show_what_their_masks_say(made: Path) -> None:
    """Where an arm is not in the images, its mask is not learnt; each mask covers what is bright, steel and light."""
    dataset = open_dataset(made)
    assert isinstance(dataset, InstrumentDataset)
    for frame, picture in enumerate(pictures(made)):
        assert np.array_equal(picture.mask, dataset.sequences[0].clean_mask("right", frame))
        # A drape is green: of an instrument, red and green are nearly alike.
        red, green = (picture.image[..., channel].astype(float) for channel in (0, 1))
        assert np.median((green - red)[~picture.mask]) > 20
        assert abs(np.median((green - red)[picture.mask])) < 15


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("data: {a: {preset: endoscope}}", "key 'test' is missing"),
        ("data: {a: {preset: endoscope, dataset: b}}\ntest: {a: {preset: mini}}", "either 'preset' or 'dataset'"),
        ("data: {a: {dataset: b, frames: 3}}\ntest: {a: {preset: mini}}", "no other key beside it"),
        ("data: {a/b: {dataset: b}}\ntest: {a: {preset: mini}}", "'a/b' is no name"),
        ("data: {a: {preset: endoscope}}\ntest: {a: {preset: mini}}\nnetwork: {input_px: 100}", "multiple of 32"),
        ("data: {a: {preset: endoscope}}\ntest: {a: {preset: mini}}\nlooks: {zoom: [2, 1]}", "least <= most"),
        ("data: {a: {preset: endoscpe}}\ntest: {a: {preset: mini}}", "did you mean 'endoscope'"),
        ("data: {a: {preset: endoscope, set: {imges.samples: 1}}}\ntest: {a: {preset: mini}}", "imges"),
        ("data: {a: {dataset: nowhere}}\ntest: {a: {preset: mini}}", "'validation': is needed"),
    ],
)
def test_wrong_files_are_told_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, message: str
) -> None:
    (tmp_path / "wrong.yaml").write_text(text)
    surgbench("train", "masks", tmp_path / "wrong.yaml", "--out", tmp_path / "model", expect=2)
    complaint = capsys.readouterr().err
    assert message in complaint
    assert complaint.count("\n") == 1
    assert not (tmp_path / "model" / "config.json").exists()


def test_data_without_images_are_told(tmp_path: Path) -> None:
    masks = Preset(name="masks", pairs=1, frames=2, camera=SMALL)
    generate(plan_dataset(masks), tmp_path / "masks")
    with pytest.raises(SurgbenchError, match="sequence '000' has no images to learn from"):
        list(pictures(tmp_path / "masks"))


def test_no_two_parts_or_sources_have_a_look_in_common() -> None:
    source = PictureSource(preset="endoscope")
    seeds = {
        plan.marker["preset"]["seed"]
        for plan in (source.plan(name, part, seed) for name in "ab" for part in ("training", "test") for seed in (0, 1))
        if plan is not None
    }
    assert len(seeds) == 8


def test_the_packages_model_was_trained_on_what_the_file_says() -> None:
    told = json.loads((MODEL.parent / "config.json").read_text())
    file = load_training("masks", {}).model_dump(mode="json")
    # docs/masks.md says what else was set.
    for key in ("seed", "set", "data", "validation_sequences", "network"):
        assert told[key] == file[key]


def test_the_command_line_goes_over_the_file() -> None:
    settings = load_training("masks", {"seed": 3, "training.epochs": 2, "training.batch": 5, "looks.zoom": [1.0, 1.5]})
    assert (settings.seed, settings.training.epochs, settings.training.batch) == (3, 2, 5)
    assert settings.training.learning_rate == load_training("masks", {}).training.learning_rate
    assert settings.looks.zoom == (1.0, 1.5)
    with pytest.raises(ConfigError, match="did you mean 'zoom'"):
        load_training("masks", {"looks.zom": 1})
    with pytest.raises(ConfigError, match="'seed' has no keys"):
        load_training("masks", {"seed.left": 1})


def test_a_loss_of_nothing_wrong_is_nothing() -> None:
    target = torch.zeros(2, 16, 16)
    target[:, 4:12, 4:12] = 1
    assert float(mask_loss(40 * (target - 0.5), target, 2.0)) < 1e-3
    worse, worst = (float(mask_loss(logits, target, 2.0)) for logits in (0 * target, 40 * (0.5 - target)))
    assert 0.5 < worse < worst


def test_pixels_near_an_edge_count_more() -> None:
    target = torch.zeros(1, 32, 32)
    target[:, :, 16:] = 1
    right = 8 * (target - 0.5)
    near, far = right.clone(), right.clone()
    near[0, 10, 15] *= -1
    far[0, 10, 3] *= -1
    assert float(mask_loss(near, target, 2.0)) > float(mask_loss(far, target, 2.0))
    # Alike but for what the Dice coefficient makes of them, which knows no edges.
    assert float(mask_loss(near, target, 0.0)) == pytest.approx(float(mask_loss(far, target, 0.0)), rel=1e-4)


def test_overlap_of_masks() -> None:
    one, other = np.zeros((2, 4, 4), bool)
    assert overlap(one, other) == 1
    one[:2] = True
    other[1:3] = True
    assert overlap(one, other) == pytest.approx(1 / 3)


@given(st.integers(0, 2**32 - 1))
def test_looks_move_picture_and_mask_alike(seed: int) -> None:
    """Of bars that are bright before black and stay so, what is bright is where the mask says."""
    still = LookSettings(
        cut_px=(64, 32), other_backdrop=0, recolour=0, swap_colours=0, shade=0, gamma=1, blur_px=0, noise=0
    )
    bars = painted(2)
    plain = [np.where(mask[..., None] > 0, np.uint8(200), np.uint8(0)).repeat(3, axis=2) for mask in bars.masks]
    image, mask = Pictures(plain, bars.masks, 64, still).look(1, np.random.default_rng(seed))
    assert image.shape == (32, 64, 3)
    inside = cv2.erode(mask, np.ones((3, 3), np.uint8)) > 0
    outside = cv2.dilate(mask, np.ones((3, 3), np.uint8)) == 0
    assert (image[inside] > 100).all()
    assert (image[outside] < 100).all()


def test_another_backdrop_brings_its_instruments_along() -> None:
    both = LookSettings(cut_px=(64, 32), other_backdrop=1, aim=1, turn_rad=0, zoom=(0.5, 0.5))
    alone = both.model_copy(update={"other_backdrop": 0})
    bars = painted(6)
    areas = [
        np.mean(
            [Pictures(bars.images, bars.masks, 64, one).look(0, np.random.default_rng(seed))[1] for seed in range(20)]
        )
        for one in (both, alone)
    ]
    assert areas[0] > 1.2 * areas[1]


@pytest.mark.parametrize(
    ("size", "expected"), [((700, 493), (352, 256)), ((640, 480), (352, 256)), ((352, 64), (352, 64))]
)
def test_a_picture_is_looked_at_in_about_its_shape(size: tuple[int, int], expected: tuple[int, int]) -> None:
    assert input_size(*size, NetworkSettings()) == expected


@pytest.mark.slow
def test_a_training_that_diverges_is_told(tmp_path: Path, bars: Pictures) -> None:
    with pytest.raises(SurgbenchError, match="diverged in epoch 1"):
        trained(tmp_path, bars, SHORT.model_copy(update={"learning_rate": 1e30}))
