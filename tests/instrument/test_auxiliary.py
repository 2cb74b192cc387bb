"""Auxiliary views from the generator to the leaderboard."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commandline import RUN, STRANGERS, records, surgbench

from surgbench.camera import Camera
from surgbench.camera.change_of_view import ChangeOfView
from surgbench.dataset import tables
from surgbench.dataset.open import open_as
from surgbench.dataset.validate import validate
from surgbench.errors import ConfigError, DatasetError
from surgbench.generators.auxiliary import (
    REMOTE_CENTRE_M,
    auxiliary_paths,
    endoscope_pose,
    feature_poses,
    report,
)
from surgbench.generators.generate import Part, generate, plan_dataset
from surgbench.generators.presets import Preset, load_preset
from surgbench.generators.sections import Auxiliary
from surgbench.generators.sequence import make_tables
from surgbench.geometry import FloatArray, inverse_transform, rotation_angle
from surgbench.instrument import load_instrument
from surgbench.records.reader import read_records
from surgbench.registry import create, find
from surgbench.report.rows import derive_rows
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.suite.asked import Conditions
from surgbench.suite.plan import complete
from surgbench.tasks.instrument.asked import InstrumentRow
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.replay import replay_traces
from surgbench.tasks.instrument.units import UnitData
from surgbench.viewpoint.scores import view_errors

SMALL = Camera(width=175, height=123, fx=226.5, fy=224.0, cx=73.2, cy=59.3)
SIDE = Camera(width=128, height=96, fx=96.8, fy=96.4, cx=61.9, cy=47.0)
FEW = Preset(name="few", pairs=1, frames=4, camera=SMALL, auxiliary=Auxiliary(camera=SIDE, views=("static", "gaze")))
OBSERVED = "sequences/000/views/gaze/observations.parquet"
POSES = "truth/000/views/gaze/poses.parquet"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("auxiliary") / "few"
    generate(plan_dataset(FEW), out)
    return out


@pytest.fixture(scope="module")
def path() -> FloatArray:
    """A feature's poses over two seconds."""
    preset = FEW.model_copy(update={"frames": 60})
    instrument = load_instrument("large_needle_driver")
    entry = plan_dataset(preset).sequences[0]
    states = make_tables(preset, entry, instrument, SMALL).states[:, 0]
    poses: FloatArray = feature_poses(Auxiliary(), instrument, states)
    return poses


# --- where the cameras are


@pytest.mark.slow
def test_what_is_followed_lies_between_the_jaws_and_its_normal_is_towards_the_camera_arm(path: FloatArray) -> None:
    instrument = load_instrument("large_needle_driver")
    states = make_tables(FEW, plan_dataset(FEW).sequences[0], instrument, SMALL).states[:, 1]
    states[:, 8] = 0.0
    feature = inverse_transform(endoscope_pose(Auxiliary())) @ feature_poses(Auxiliary(), instrument, states)
    np.testing.assert_allclose(feature[:, :3, 3], instrument.tips_cam(states).mean(axis=1), atol=1e-6)
    jaws = np.diff(instrument.tips_cam(states + 0.3 * np.eye(9)[8]), axis=1)[:, 0]
    jaws /= np.linalg.norm(jaws, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs((feature[:, :3, 1] * jaws).sum(axis=1)), 1.0, atol=1e-6)
    hinge = inverse_transform(endoscope_pose(Auxiliary())) @ feature_poses(Auxiliary(normal="x"), instrument, states)
    np.testing.assert_allclose((hinge[:, :3, 1] * jaws).sum(axis=1), 0.0, atol=1e-6)
    assert path[:, :3, 1].mean(axis=0) @ REMOTE_CENTRE_M > 0


def test_the_cameras_are_where_their_controllers_bring_them(path: FloatArray) -> None:
    """All start in one place; one stays there, one keeps looking at the feature from the wanted distance."""
    paths = auxiliary_paths(Auxiliary(views=("static", "gaze")), path, 1 / 30, np.random.default_rng(0))
    assert list(paths) == ["static", "gaze"]
    np.testing.assert_allclose(paths["static"], np.tile(paths["static"][0], (len(path), 1, 1)), atol=1e-12)
    errors = view_errors(paths["gaze"], path, 0.11)
    assert np.median(errors["vva_deg"]) < 0.5
    assert np.median(errors["fd_mm"]) < 5.0
    assert errors["vva_deg"].mean() < view_errors(paths["static"], path, 0.11)["vva_deg"].mean()
    # One more view changes no other.
    alone = auxiliary_paths(Auxiliary(views=("gaze",)), path, 1 / 30, np.random.default_rng(0))
    np.testing.assert_array_equal(alone["gaze"], paths["gaze"])


def test_a_reported_pose_has_a_constant_error_and_jitter() -> None:
    true = np.tile(np.eye(4), (4000, 1, 1))
    settings = Auxiliary(calibration_rad=0.01, calibration_m=0.002, jitter_m=1e-4)
    constant = np.array([1.0, 0.0, 0.0, 0.0, -1.0, 0.0])
    said = report(true, settings, constant, np.random.default_rng(0))
    np.testing.assert_allclose(rotation_angle(said[:, :3, :3]), 0.01, atol=1e-12)
    np.testing.assert_allclose(said[:, :3, 3].mean(axis=0), [0, -0.002, 0], atol=1e-5)
    np.testing.assert_allclose(said[:, :3, 3].std(axis=0), 1e-4, rtol=0.05)
    exact = Auxiliary(calibration_rad=0, calibration_m=0, jitter_m=0)
    np.testing.assert_array_equal(report(true, exact, constant, np.random.default_rng(0)), true)


# --- the dataset


def test_masks_of_an_auxiliary_view_are_those_of_the_true_states_from_its_true_pose(made: Path) -> None:
    assert validate(made) == []
    dataset = open_as(InstrumentDataset, made)
    sequence = dataset.sequences[0]
    instrument = dataset.instrument("large_needle_driver")
    evaluator = SilhouetteEvaluator([instrument], SIDE)
    for name in ("static", "gaze"):
        view = sequence.auxiliary(name)
        for arm in sequence.arms:
            states = sequence.states(arm)
            assert states is not None
            for frame in range(sequence.frames):
                own = ChangeOfView(view.true_T_view_cam(arm)[frame]).states(states[frame])
                clean = view.clean_mask(arm, frame)
                assert clean.any()
                assert (evaluator.mask(own) != clean).sum() <= 2
            error = view.T_view_cam(arm) @ inverse_transform(view.true_T_view_cam(arm))
            assert 0 < np.linalg.norm(error[:, :3, 3], axis=1).mean() < 0.006
            tips = view.keypoints(arm, arm)
            assert np.isnan(tips[~SIDE.contains(tips)]).all()


@pytest.mark.slow
def test_a_part_has_the_same_files_as_the_whole(made: Path, tmp_path: Path) -> None:
    generate(plan_dataset(FEW, Part(("000",), 2)), tmp_path / "part")
    assert validate(tmp_path / "part") == []
    masks = sorted((tmp_path / "part").rglob("*.png"))
    assert sum("views" in path.parts for path in masks) == 2 * 2 * 2 * 2  # views, arms, frames; clean and observed
    for path in masks:
        assert path.read_bytes() == (made / path.relative_to(tmp_path / "part")).read_bytes()
    whole, part = (
        open_as(InstrumentDataset, root).sequences[0].auxiliary("gaze") for root in (made, tmp_path / "part")
    )
    np.testing.assert_array_equal(part.T_view_cam("left"), whole.T_view_cam("left")[:2])


def test_a_dataset_without_such_views_does_not_know_of_them(tmp_path: Path) -> None:
    """So that its hash, and that of every run on it, is what it was."""
    plain = FEW.model_copy(update={"auxiliary": None, "frames": 2})
    generate(plan_dataset(plain), tmp_path / "plain")
    assert "auxiliary" not in (tmp_path / "plain" / "dataset.json").read_text()
    dataset = open_as(InstrumentDataset, tmp_path / "plain")
    with pytest.raises(DatasetError, match="auxiliary view"):
        dataset.sequences[0].auxiliary("gaze")
    with pytest.raises(ConfigError, match="'few' has no auxiliary views"):
        complete(InstrumentRow(tracker="cmaes", view="gaze"), Conditions(), dataset)
    assert "view" not in complete(InstrumentRow(tracker="cmaes"), Conditions(), dataset).spec()


def damage(root: Path, path: str, change: Callable[[dict[str, Any]], None]) -> None:
    """Edit a table and make the manifest agree with it, as somebody who edits a dataset would."""
    import pyarrow.parquet as parquet

    table = parquet.read_table(root / path)
    columns = {name: table.column(name).to_numpy().copy() for name in table.column_names if name != "frame"}
    change(columns)
    data = tables.encode_table(columns)
    (root / path).write_bytes(data)
    manifest = json.loads((root / "dataset.json").read_text())
    manifest["files"][path] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    (root / "dataset.json").write_text(json.dumps(manifest))


def test_what_is_wrong_with_an_auxiliary_view_is_found(made: Path, tmp_path: Path) -> None:
    root = shutil.copytree(made, tmp_path / "few")

    def change(columns: dict[str, Any]) -> None:
        columns["left_view_rx_rad"][1] = 4.0

    def outside(columns: dict[str, Any]) -> None:
        columns["right_u1_px"][2], columns["right_v1_px"][2] = 500.0, 3.0

    damage(root, POSES, change)
    damage(root, OBSERVED, outside)
    (root / "sequences/000/views/static/observed/left/000002.png").unlink()
    problems = validate(root)
    assert len(problems) == 3
    assert any("poses.parquet: frame 1: the view's pose for 'left'" in line for line in problems)
    assert any("frame 2: a keypoint of the right arm lies outside the image" in line for line in problems)
    assert any("static/observed/left/000002.png: missing" in line for line in problems)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera": "nowhere"}, "auxiliary view 'gaze' names the unknown camera 'nowhere'"),
        ({"kinds": ["visible_left"]}, "auxiliary view 'gaze' has the kind 'visible_left', which the sequence has not"),
    ],
)
def test_a_manifest_that_contradicts_itself_is_refused(
    made: Path, tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    manifest = json.loads((made / "dataset.json").read_text())
    manifest["sequences"][0]["auxiliary"]["gaze"].update(change)
    (tmp_path / "dataset.json").write_text(json.dumps(manifest))
    with pytest.raises(DatasetError, match=message):
        open_as(InstrumentDataset, tmp_path)


# --- runs


def test_trackers_are_shown_the_reported_pose_and_not_the_true_one(made: Path) -> None:
    dataset = open_as(InstrumentDataset, made)
    data = UnitData(dataset, dataset.units("single")[1], "none", "gaze")
    sequence = dataset.sequences[0]
    view = sequence.auxiliary("gaze")
    assert [one.camera for one in data.scene().views] == [SMALL, SIDE]
    for frame in range(2):
        seen = data.observation(frame).views
        assert len(seen) == 2
        np.testing.assert_array_equal(seen[1].T_view_cam, view.T_view_cam("right")[frame])
        np.testing.assert_array_equal(seen[1].mask, view.mask("right", frame))


@pytest.mark.slow
def test_a_run_with_a_view_is_a_row_of_its_own(made: Path, tmp_path: Path) -> None:
    surgbench(*RUN, "--dataset", made, "--tracker", "cmaes", "--out", tmp_path)
    surgbench(*RUN, "--dataset", made, "--tracker", "cmaes", "--view", "static", "--out", tmp_path)
    rows = {row["row_id"]: row for row in derive_rows(read_records([tmp_path]))}
    assert {id_: (row["views"], row["status"]) for id_, row in rows.items()} == {
        "cmaes": (1, "ok"),
        "cmaes-static": (2, "ok"),
    }
    assert rows["cmaes-static"]["variant"] == "also the view static, keypoints observed"
    record = next(one for one in records(tmp_path) if one["spec"].get("view") == "static")
    assert replay_traces(record, open_as(InstrumentDataset, made), [1])[1].states


@pytest.mark.slow
def test_gradients_contours_and_particles_take_two_views_too(made: Path, tmp_path: Path) -> None:
    for tracker in ("adam", "hybrid", "particle-filter"):
        surgbench(*RUN, "--dataset", made, "--tracker", tracker, "--joints", "--view", "gaze", "--out", tmp_path)
    found = records(tmp_path)
    assert [record["status"] for record in found] == ["ok"] * 6


def test_what_cannot_be_is_said_in_one_line(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        (("--tracker", "cmaes", "--view", "gaez"), "unknown auxiliary view 'gaez'; did you mean 'gaze'?"),
        (("--tracker", "cmaes", "--view", "gaze", "--arms", "dual"), "shows each arm alone; use --arms single"),
        (("--tracker", f"{STRANGERS}:OneEyed", "--view", "gaze"), "one view alone"),
    ):
        surgbench(*RUN, "--dataset", made, *arguments, "--out", tmp_path, expect=2)
        assert message in capsys.readouterr().err


def test_a_second_view_that_shows_nothing_harms_nobody(made: Path) -> None:
    """The camera has lost the instrument: every tracker goes on with the endoscope."""
    dataset = open_as(InstrumentDataset, made)
    data = UnitData(dataset, dataset.units("single")[0], "none", "gaze")
    assert data.truth is not None
    state = data.truth[0, 0]
    observation = data.observation(0)
    behind = np.diag([1.0, -1.0, -1.0, 1.0])
    behind[2, 3] = -1.0
    lost = replace(observation.views[1], T_view_cam=behind, mask=np.zeros((96, 128), dtype=bool), keypoints=(None,))
    observation = replace(observation, views=(observation.views[0], lost), start=state)
    for name in ("hybrid", "cmaes", "adam"):
        tracker = create(find("tracker", name), {})
        tracker.reset(data.scene(), state.copy(), np.random.default_rng(0))
        answer = tracker.step(observation)
        assert np.isfinite(answer.state).all()
        assert np.linalg.norm(answer.state[3:6] - state[3:6]) < 0.02


@pytest.mark.slow
def test_the_truth_handed_in_scores_zero_beside_a_second_view(made: Path, tmp_path: Path) -> None:
    """But against the masks that trackers see, which are corrupted."""
    surgbench("export", made, "--format", "csv", "--out", tmp_path / "csv")
    surgbench("score", made, tmp_path / "csv/truth.csv", "--name", "mine", "--out", tmp_path / "runs")
    surgbench("report", tmp_path / "runs", "--format", "json", "--out", tmp_path / "board.json")
    (row,) = json.loads((tmp_path / "board.json").read_text())
    wrong = {key for key, value in row.items() if "error" in key and value not in (0.0, None)}
    assert {key for key in wrong if not key.startswith("mask_error") or key.startswith("mask_error_true")} == set()
    assert row["tip_error_m"] == row["mask_error_true"] == 0.0


def test_the_preset_is_there_and_options_that_will_not_do_are_refused() -> None:
    preset = load_preset("auxiliary-view")
    assert preset.auxiliary is not None
    assert preset.auxiliary == Auxiliary(views=("static", "midpoint", "naive", "autocam", "gaze"))
    for wrong, message in (
        ({"views": ["static", "static"]}, "named twice"),
        ({"views": ["nobody"]}, "unknown tracker 'nobody'"),
        ({"views": ["cmaes"]}, "no controller of a camera"),
        ({"camera": {**SIDE.model_dump(), "distortion": [0.1, 0, 0, 0, 0]}}, "undistorted"),
    ):
        with pytest.raises(ValueError, match=message):
            Auxiliary.model_validate(wrong)
