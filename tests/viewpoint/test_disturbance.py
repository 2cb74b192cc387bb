"""Disturbances: nothing at their zero, what their levels say above it, and the same for every controller."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from commandline import STRANGERS, records, surgbench
from hypothesis import given
from hypothesis import strategies as st

from surgbench.geometry import FloatArray, rigid_transform, rotation_from_vector, rotation_vector
from surgbench.report.rows import read_rows
from surgbench.tasks.viewpoint.asked import ViewpointRow
from surgbench.tasks.viewpoint.conformance.worlds import circling
from surgbench.viewpoint.contract import ViewpointObservation
from surgbench.viewpoint.disturbance import Disturbance, displace_base, disturb_trial, earlier, gaps, mislead
from surgbench.viewpoint.placement import naive_pose
from surgbench.viewpoint.registration import residual_m
from surgbench.viewpoint.simulator import Simulation, make_scene

AXES: dict[str, str | int] = {"seed": 0, "unit": "000"}


def shown(steps: int = 400, **levels: float) -> tuple[FloatArray, FloatArray]:
    """A trial's measurements, and what is shown of them."""
    trial = circling(steps)
    return trial.T_world_feature, disturb_trial(trial, Disturbance(**levels), AXES).T_world_feature


def test_no_level_disturbs_nothing() -> None:
    trial, nothing = circling(50), Disturbance()
    scene = make_scene(trial)
    assert disturb_trial(trial, nothing, AXES) is trial
    assert displace_base(scene, nothing, AXES) is scene
    assert mislead(scene, nothing) is scene
    assert nothing.levels() == {}
    assert nothing.words() == []
    assert Disturbance(dropout_s=3.0).levels() == {}  # the length of gaps of which there are none


def test_a_row_may_ask_for_every_level_and_its_defaults_are_none() -> None:
    row = ViewpointRow(tracker="gaze")
    for level in fields(Disturbance):
        assert getattr(row, level.name) == level.default


@given(st.sampled_from([0.0, 2e-4, 1e-3]), st.sampled_from([0.0, 5e-3, 3e-2]))
def test_noise_is_as_large_as_its_level(noise_m: float, noise_rad: float) -> None:
    measured, noisy = shown(noise_m=noise_m, noise_rad=noise_rad)
    moved = noisy[:, :3, 3] - measured[:, :3, 3]
    turned = rotation_vector(np.swapaxes(measured[:, :3, :3], 1, 2) @ noisy[:, :3, :3])
    for found, level in ((moved, noise_m), (turned, noise_rad)):
        np.testing.assert_allclose(found.std(axis=0), level, rtol=0.12, atol=1e-9)
        np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=0.2 * level + 1e-9)
    # White: what comes is not told by what was.
    if noise_m:
        assert abs(np.corrcoef(moved[1:, 0], moved[:-1, 0])[0, 1]) < 0.15


def test_a_higher_level_is_more_of_the_same() -> None:
    measured, little = shown(noise_m=1e-4)
    _, much = shown(noise_m=1e-3)
    np.testing.assert_allclose(much - measured, 10 * (little - measured), atol=1e-12)
    gone = [np.isnan(shown(dropouts=share)[1][:, 0, 0]) for share in (0.1, 0.2, 0.4)]
    assert 0 < gone[0].sum() < gone[1].sum() < gone[2].sum()


@given(st.floats(0.02, 0.5), st.floats(1.0, 40.0), st.integers(0, 99))
def test_gaps_are_as_often_and_as_long_as_told(share: float, length: float, seed: int) -> None:
    count = 40_000
    gone = gaps(count, share, length, np.random.default_rng(seed))
    begins = int((gone[1:] & ~gone[:-1]).sum() + gone[0])
    # So many gaps are expected, and each is as uncertain as it is long.
    spread = 6 / np.sqrt(max(count * share / length, 1.0))
    assert gone.mean() == pytest.approx(share, rel=spread)
    assert gone.sum() / begins == pytest.approx(length, rel=spread)


def test_a_pose_some_time_before_is_between_the_samples() -> None:
    steps, dt_s = np.arange(30), 0.01
    poses = rigid_transform(rotation_from_vector(steps[:, None] * [0.0, 0.0, 0.02]), steps[:, None] * [1e-3, 0, 0])
    late = earlier(poses, dt_s, np.full(30, 0.025))
    np.testing.assert_allclose(late[3:, 0, 3], 1e-3 * (steps[3:] - 2.5), atol=1e-12)
    np.testing.assert_allclose(rotation_vector(late[3:, :3, :3])[:, 2], 0.02 * (steps[3:] - 2.5), atol=1e-12)
    np.testing.assert_allclose(late[:3], np.tile(poses[0], (3, 1, 1)), atol=1e-12)  # and never before the first


def test_measurements_are_late_by_half_the_jitter_in_the_mean_and_never_early() -> None:
    trial = circling(2000)
    late = disturb_trial(trial, Disturbance(jitter_s=0.03), AXES).T_world_feature
    angle = np.unwrap(np.arctan2(late[:, 1, 3], late[:, 0, 3]))
    age_s = trial.timestamps_s - angle * 12.0 / (2 * np.pi)
    assert age_s[3:].min() > -1e-4
    assert age_s.max() < 0.0301
    assert age_s.mean() == pytest.approx(0.015, abs=5e-4)
    assert age_s.std() == pytest.approx(0.03 / np.sqrt(12), rel=0.05)


@pytest.mark.parametrize("levels", [{"jitter_s": 0.02}, {"noise_m": 1e-3}, {"dropouts": 0.3}])
def test_what_was_not_measured_stays_so(levels: dict[str, float]) -> None:
    trial = circling(200)
    trial.T_world_feature[50:80] = np.nan
    trial.T_world_feature[0] = np.nan
    poses = disturb_trial(trial, Disturbance(**levels), AXES).T_world_feature
    whole = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    assert not whole[50:80].any()
    assert not whole[0]
    assert (whole | np.isnan(poses).all(axis=(1, 2))).all()  # all of a pose is there, or nothing of it
    if "dropouts" not in levels:
        assert whole.sum() == 169


def test_a_trial_without_a_measurement_is_left_alone() -> None:
    trial = circling(20)
    trial.T_world_feature[:] = np.nan
    every = Disturbance(jitter_s=0.02, noise_m=1e-3, dropouts=0.3)
    assert np.isnan(disturb_trial(trial, every, AXES).T_world_feature).all()


def test_the_base_is_off_by_its_level_and_the_registration_does_not_know() -> None:
    trial = circling(20)
    scene = make_scene(trial)
    moved = displace_base(scene, Disturbance(registration_error_m=4e-3), AXES)
    assert np.linalg.norm(moved.T_world_base[:3, 3] - scene.T_world_base[:3, 3]) == pytest.approx(4e-3)
    np.testing.assert_array_equal(moved.T_world_base[:3, :3], scene.T_world_base[:3, :3])
    assert moved.registration_error_m == residual_m(scene.T_world_base, trial.touches)


class Listening:
    """Notes what it is told, and looks straight at the ring."""

    def reset(self, scene: object, joints: FloatArray, rng: np.random.Generator) -> None:
        self.lag_s = getattr(scene, "servo_lag_s", None)

    def step(self, observation: ViewpointObservation) -> FloatArray:
        return naive_pose(observation.T_world_feature)


def test_a_lag_that_is_told_wrongly_is_not_the_joints() -> None:
    trial, listening = circling(100), Listening()
    scene = make_scene(trial)
    told = mislead(scene, Disturbance(told_lag=1.5))
    plain = Simulation(Listening(), trial, scene, np.random.default_rng(0)).run()
    misled = Simulation(listening, trial, told, np.random.default_rng(0), servo_lag_s=scene.servo_lag_s).run()
    assert listening.lag_s == pytest.approx(1.5 * scene.servo_lag_s)
    np.testing.assert_array_equal(misled.joints, plain.joints)
    slower = Simulation(Listening(), trial, replace(scene, servo_lag_s=0.05), np.random.default_rng(0)).run()
    assert (slower.joints != plain.joints).any()


# As a user types it.


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short trial."""
    folder = tmp_path_factory.mktemp("chaser") / "mini"
    surgbench("generate", "wire-chaser-mini", "--sequences", 1, "--frames", 160, "--out", folder)
    return folder


@pytest.mark.slow
def test_disturbed_runs_are_rows_of_their_own(dataset: Path, tmp_path: Path) -> None:
    command = ("run", "--dataset", dataset, "--tracker", "static", "--out", tmp_path)
    surgbench(*command)
    surgbench(
        *(*command, "--tracker", f"{STRANGERS}:Watching", "--told-lag", 1.5, "--jitter-s", 0.02, "--dropouts", 0.3),
        *("--noise-m", 0.001, "--noise-rad", 0.02, "--registration-error-m", 0.005),
    )
    plain, *disturbed = sorted(records(tmp_path), key=lambda record: "disturbance" in record["spec"])
    assert "disturbance" not in plain["spec"]
    assert plain["variant"] == "default"
    said = (
        "told 1.5 x the lag, measured up to 0.02 s late, 0.3 of the measurements missing, gaps of 0.1 s, "
        "noise 0.001 m, noise 0.02 rad, base 0.005 m off"
    )
    assert [record["variant"] for record in disturbed] == [said, said]
    assert set(disturbed[0]["spec"]["disturbance"]) == {level.name for level in fields(Disturbance)}
    # Every controller is disturbed alike.
    one, other = (record["frames"]["asked"] for record in disturbed)
    assert one == other
    assert not all(one)
    # Errors are those against what was measured, in the gaps too: of a camera that stays, the disturbed are the same
    # but for the base, which is reported elsewhere.
    still = next(record for record in disturbed if record["spec"]["row_id"] == "static")
    assert None not in still["errors"]["vva_deg"]
    assert np.ptp(np.subtract(still["errors"]["fd_signed_mm"], plain["errors"]["fd_signed_mm"])) < 5.0
    rows = [row for row in read_rows([tmp_path]) if row["subset"] == "all" and not row["camera"]]
    assert {(row["row_id"], row["disturbance"], row["samples"]) for row in rows} == {
        ("static", None, 160), ("static", said, 160), ("watching", said, 160)
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--dropouts", 0.7], "dropouts"),
        (["--noise-m", -0.001], "noise_m"),
        (["--told-lag", "nan"], "told_lag"),
    ],
)
def test_levels_that_are_none_are_told_in_one_line(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[object], message: str
) -> None:
    surgbench("run", "--dataset", dataset, "--tracker", "gaze", *arguments, "--out", tmp_path / "runs", expect=2)
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1
