"""``surgbench train keypoints``: it learns, it goes on where it stopped, and says what is wrong in one line."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commandline import surgbench

from surgbench.camera import Camera
from surgbench.cli.training import KeypointTraining
from surgbench.errors import SurgbenchError
from surgbench.generators.tip_masks import HELD_OUT, TipMasks, TipMaskSettings
from surgbench.trackers.keypoints.heatmaps.model import load_network
from surgbench.trackers.keypoints.heatmaps.network import HeatmapNetwork, NetworkSettings
from surgbench.trackers.keypoints.heatmaps.patches import Patches, cut_patches
from surgbench.trackers.keypoints.heatmaps.training import (
    Training,
    TrainingSettings,
    target_heat,
)
from surgbench.trackers.keypoints.resnet18 import MODELS
from surgbench.trackers.learning.course import LEAST_CHANNELS_LAST

NETWORK = NetworkSettings(width=4, head=4, input_px=32)
SHORT = TrainingSettings(epochs=3, batch=8, bfloat16=False)
TINY = """
masks: {training: 16, validation: 8, test: 8}
network: {width: 4, head: 4, input_px: 32}
training: {epochs: 2, batch: 8, bfloat16: false}
"""


@pytest.fixture(scope="module")
def patches() -> Patches:
    return cut_patches(TipMasks(TipMaskSettings(), 24, 0, "training"), NETWORK.input_px, 1, lambda _: None)


def quiet(_: Any) -> None: ...


def trained(folder: Path, patches: Patches, settings: TrainingSettings = SHORT, **identity: Any) -> Training:
    training = Training(folder, NETWORK, settings, 0, "cpu", identity)
    training.run(patches, patches, quiet, quiet)
    return training


@pytest.mark.slow
@pytest.mark.long
def test_it_learns(tmp_path: Path, patches: Patches) -> None:
    trained(tmp_path, patches, SHORT.model_copy(update={"epochs": 40, "learning_rate": 0.01}))
    log = list(csv.DictReader((tmp_path / "log.csv").read_text().splitlines()))
    assert [row["epoch"] for row in log] == [str(number) for number in range(len(log))]
    losses = [float(row["training_loss"]) for row in log]
    assert losses[-1] < 0.75 * losses[0]


@pytest.mark.slow
@pytest.mark.parametrize("width", [NETWORK.width, LEAST_CHANNELS_LAST])
def test_gradients_are_right_in_either_memory_format(tmp_path: Path, patches: Patches, width: int) -> None:
    """Against double precision, which takes other kernels."""
    network = NETWORK.model_copy(update={"width": width})
    training = Training(tmp_path, network, SHORT, 0, "cpu", {})
    exact = HeatmapNetwork(network).double()
    exact.load_state_dict(training._network.state_dict())
    chosen = np.arange(SHORT.batch)
    pictures, tips = patches.looks(chosen, None)
    training._loss(training._logits(pictures), tips).backward()
    training._loss(exact(torch.from_numpy(pictures)[:, None].double() / 255.0), tips).backward()
    for (name, one), other in zip(training._network.named_parameters(), exact.parameters(), strict=True):
        assert one.grad is not None
        assert other.grad is not None
        error = float((one.grad - other.grad).abs().max() / other.grad.abs().max())
        assert error < 1e-3, name


@pytest.mark.slow
@pytest.mark.parametrize("width", [NETWORK.width, LEAST_CHANNELS_LAST])
def test_an_interrupted_training_ends_like_an_uninterrupted_one(tmp_path: Path, patches: Patches, width: int) -> None:
    """To the last bit: the weights, and the log but for its times; in either memory format."""
    network = NETWORK.model_copy(update={"width": width})
    Training(tmp_path / "whole", network, SHORT, 0, "cpu", {}).run(patches, patches, quiet, quiet)
    shares: list[float] = []

    def interrupt(share: float) -> None:
        shares.append(share)
        if sum(shares) > 1.4:  # in the middle of the second epoch
            raise KeyboardInterrupt

    training = Training(tmp_path / "halves", network, SHORT, 0, "cpu", {})
    with pytest.raises(KeyboardInterrupt):
        training.run(patches, patches, interrupt, quiet)
    resumed = Training(tmp_path / "halves", network, SHORT, 0, "cpu", {})
    assert resumed.epoch == 1
    resumed.run(patches, patches, quiet, quiet)
    whole, halves = ((tmp_path / name / "weights.safetensors").read_bytes() for name in ("whole", "halves"))
    assert whole == halves
    logs = [
        [line.rpartition(",")[0] for line in (tmp_path / name / "log.csv").read_text().splitlines()]
        for name in ("whole", "halves")
    ]
    assert logs[0] == logs[1]


@pytest.mark.slow
def test_it_stops_when_the_validation_loss_does_not_fall(tmp_path: Path, patches: Patches) -> None:
    still = SHORT.model_copy(update={"epochs": 30, "patience": 2, "learning_rate": 1e-12})
    training = trained(tmp_path, patches, still)
    assert training.epoch < 30


@pytest.mark.slow
def test_a_folder_of_other_settings_is_refused(tmp_path: Path, patches: Patches) -> None:
    trained(tmp_path, patches, masks=16)
    with pytest.raises(SurgbenchError, match="other settings"):
        Training(tmp_path, NETWORK, SHORT, 0, "cpu", {"masks": 17})


@pytest.mark.slow
def test_it_begins_with_another_models_weights(tmp_path: Path, patches: Patches) -> None:
    trained(tmp_path / "first", patches)
    start = tmp_path / "first" / "weights.safetensors"
    still = SHORT.model_copy(update={"epochs": 1, "learning_rate": 1e-12})
    Training(tmp_path / "second", NETWORK, still, 7, "cpu", {}, start).run(patches, patches, quiet, quiet)
    first, second = (load_network(tmp_path / name / "weights.safetensors")[0] for name in ("first", "second"))
    torch.testing.assert_close(second.heat.weight, first.heat.weight, rtol=1e-3, atol=1e-4)
    with pytest.raises(SurgbenchError, match="other settings"):
        Training(tmp_path / "second", NETWORK, still, 7, "cpu", {})
    larger = NETWORK.model_copy(update={"width": 8})
    with pytest.raises(SurgbenchError, match="a network of width=4"):
        Training(tmp_path / "third", larger, still, 7, "cpu", {}, start)


@pytest.mark.slow
def test_a_damaged_state_is_told(tmp_path: Path, patches: Patches) -> None:
    trained(tmp_path, patches)
    path = tmp_path / "training.safetensors"
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(SurgbenchError, match="damaged") as caught:
        Training(tmp_path, NETWORK, SHORT, 0, "cpu", {})
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_global_randomness_is_left_alone(tmp_path: Path, patches: Patches) -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    trained(tmp_path, patches)
    assert torch.equal(torch.rand(3), expected)


def test_heat_is_one_at_a_tip_and_nowhere_for_tips_outside() -> None:
    heat = target_heat(torch.tensor([[[10.0, 20.0], [torch.nan, torch.nan]]]), 32, 1.5)
    assert heat.shape == (1, 32, 32)
    assert float(heat[0, 20, 10]) == 1.0
    assert float(heat[0, 20, 13]) == pytest.approx(np.exp(-0.5 * 4))
    assert int((heat > 0.01).sum()) < 70


def test_looks_keep_the_tips_where_the_picture_shows_them(patches: Patches) -> None:
    """A mark put at a tip comes out where the tip is said to be, however the look is turned, scaled and mirrored."""
    whole = np.flatnonzero(~np.isnan(patches.tips).any(axis=(1, 2)))
    marked = patches.pictures[whole[:1]].copy()
    marked[:] = 0
    column, row = (round(value) for value in patches.tips[whole[0], 0])
    marked[0, row, column] = 255
    one = Patches(marked, np.array([[[column, row]] * 2], float), np.ones(1, bool), np.ones(1), patches.size)
    for turn, scale, mirror, shift in ((0.0, 1.0, False, (0, 0)), (0.3, 1.1, True, (0.05, -0.04))):
        picture, tips = one.look(0, turn, scale, mirror, np.array(shift, float))
        rows, columns = np.nonzero(picture == picture.max())
        assert abs(columns.mean() - tips[0, 0]) < 1.0
        assert abs(rows.mean() - tips[0, 1]) < 1.0


@pytest.mark.slow
def test_patches_do_not_depend_on_the_number_of_jobs() -> None:
    masks = TipMasks(TipMaskSettings(), 120, 1, "training")
    one, two = (cut_patches(masks, 32, jobs, quiet) for jobs in (1, 2))
    assert np.array_equal(one.pictures, two.pictures)
    assert np.array_equal(one.tips, two.tips, equal_nan=True)


@pytest.mark.slow
def test_the_command_trains_and_its_model_is_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "tiny.yaml").write_text(TINY)
    out = tmp_path / "model"
    surgbench("train", "keypoints", tmp_path / "tiny.yaml", "--out", out, "--jobs", 1)
    assert capsys.readouterr().out.strip().endswith("weights.safetensors")
    found = json.loads((out / "accuracy.json").read_text())
    assert found["masks"] + found["other_masks"] == found["test_masks"] == 8
    assert json.loads((out / "config.json").read_text())["network"]["width"] == 4
    surgbench("train", "keypoints", tmp_path / "tiny.yaml", "--out", out, "--jobs", 1)
    assert "goes on after 2 epochs" in capsys.readouterr().err
    surgbench("train", "keypoints", tmp_path / "tiny.yaml", "--out", out, "--seed", 1, expect=2)
    assert "other settings" in capsys.readouterr().err
    option = f"resnet18.model={out / 'weights.safetensors'}"
    surgbench("bench", "keypoints", "--masks", 5, "--keypoints", "resnet18", "--set", option, "--json")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("training: {epoch: 3}", "did you mean 'epochs'?"),
        ("network: {input_px: 100}", "multiple of 32"),
        ("masks: {training: 0}", "masks.training"),
        ("data: {body_scale: [-1, 0]}", "body_scale"),
        ("data: {instrument: nothing}", "nothing"),
    ],
)
def test_wrong_files_are_told_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, message: str
) -> None:
    (tmp_path / "wrong.yaml").write_text(text)
    surgbench("train", "keypoints", tmp_path / "wrong.yaml", "--out", tmp_path / "model", expect=2)
    complaint = capsys.readouterr().err
    assert message in complaint
    assert complaint.count("\n") == 1
    assert not (tmp_path / "model").exists()


@pytest.mark.slow
def test_a_model_that_is_there_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shipped = MODELS / "resnet18" / "weights.safetensors"
    model = tmp_path / "model" / "weights.safetensors"
    model.parent.mkdir()
    model.write_bytes(shipped.read_bytes())
    (tmp_path / "tiny.yaml").write_text(TINY)
    surgbench("train", "keypoints", tmp_path / "tiny.yaml", "--out", model.parent, "--jobs", 1, expect=2)
    assert "holds a model of other settings" in capsys.readouterr().err
    assert model.read_bytes() == shipped.read_bytes()


def test_masks_without_an_instrument_are_told() -> None:
    masks = TipMasks(TipMaskSettings(distance_m=(60.0, 80.0)), 4, 0, "training")
    with pytest.raises(SurgbenchError, match="no instrument is seen in any of 4 masks"):
        cut_patches(masks, NETWORK.input_px, 1, quiet)


def test_a_model_is_tested_on_its_own_instrument_and_cameras() -> None:
    cameras = (Camera(width=320, height=240, fx=400.0, fy=400.0, cx=159.5, cy=119.5),)
    test = KeypointTraining(data=TipMaskSettings(cameras=cameras, pitch_rad=0.1)).part("test").settings
    assert test.cameras == cameras
    assert test.pitch_rad == HELD_OUT.pitch_rad


@pytest.mark.slow
def test_a_training_that_diverges_is_told(tmp_path: Path, patches: Patches) -> None:
    with pytest.raises(SurgbenchError, match="diverged in epoch 1"):
        trained(tmp_path, patches, SHORT.model_copy(update={"learning_rate": 1e30}))


def test_unknown_files_are_told_with_the_nearest(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("train", "keypoints", "resnet81", "--out", tmp_path, expect=2)
    assert "did you mean 'resnet18'" in capsys.readouterr().err
