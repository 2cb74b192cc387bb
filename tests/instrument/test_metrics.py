from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgbench.camera import Camera
from surgbench.geometry import FloatArray, look_at_angles, look_at_rotation, wrap_angle
from surgbench.instrument.model import Instrument
from surgbench.instrument.spec import InstrumentSpec
from surgbench.metrics import (
    POSE_ERRORS,
    choose_twin,
    jitter,
    keypoint_error,
    lag,
    mask_error,
    pose_errors,
    rotation_error,
    translation_error_scaled,
)
from surgbench.randomness import generator
from surgbench.report.summary import summarise
from surgbench.state import BETA, twin
from surgbench.timing import steps_s

CAMERA = Camera(width=700, height=493, fx=905.955, fy=904.820, cx=294.280, cy=238.699)
QUARTER = np.pi / 2


def make_instrument() -> Instrument:
    """The Large Needle Driver's chain without bodies."""
    limits = {"search_rad": (-1.5, 1.5), "generate_rad": (-1.0, 1.0)}
    turned = {"alpha_rad": -QUARTER, "theta_offset_rad": -QUARTER}
    links = [
        {"name": "shaft"},
        {"name": "wrist", "parent": "shaft", "joint": "wrist_pitch", **turned},
        {"name": "yaw", "parent": "wrist", "a_m": 0.0091, "joint": "wrist_yaw", **turned},
        {"name": "jaw_a", "parent": "yaw", "joint": "jaw", "joint_scale": -1.0},
        {"name": "jaw_b", "parent": "yaw", "joint": "jaw", "joint_scale": 1.0},
    ]
    tips = [{"link": name, "point_m": (0.0, 0.0096, 0.0)} for name in ("jaw_a", "jaw_b")]
    bones = [({"link": "shaft", "point_m": (0, 0, -0.1)}, {"link": "wrist", "point_m": (0, 0, 0)})]
    content = {
        "format": "surgbench-instrument-1",
        "name": "stick",
        "title": "test",
        "joints": {name: limits for name in ("wrist_pitch", "wrist_yaw", "jaw")},
        "links": links,
        "tips": tips,
        "skeleton": bones,
    }
    return Instrument(InstrumentSpec.model_validate(content), {})


def random_states(count: int, seed: int = 0) -> FloatArray:
    rng = generator(test="metrics", seed=seed)
    low = [-1.2, -np.pi, -np.pi, -0.02, -0.02, 0.1, -1.3, -1.3, 0.0]
    high = [1.2, np.pi, np.pi, 0.02, 0.02, 0.2, 1.3, 1.3, 0.7]
    return rng.uniform(low, high, (count, 9))


angle = st.floats(-7.0, 7.0)
angles = st.tuples(angle, angle, angle).map(np.array)


@pytest.mark.parametrize("turn", [lambda s: s, twin, lambda s: twin(twin(s))], ids=["itself", "twin", "full turn"])
def test_truth_scores_exactly_zero(turn: Callable[[FloatArray], FloatArray]) -> None:
    truth = random_states(500)
    errors = pose_errors(make_instrument(), CAMERA, turn(truth), truth)
    assert list(errors) == list(POSE_ERRORS)
    for name, values in errors.items():
        assert values.shape == (500,)
        assert (values == 0.0).all(), name


@given(angles, angles)
def test_rotation_error_is_symmetric_and_bounded(a: FloatArray, b: FloatArray) -> None:
    assert rotation_error(a, b) == rotation_error(b, a)
    assert 0.0 <= rotation_error(a, b) <= np.pi


@given(angles, angles, angles)
def test_rotation_error_is_invariant_to_a_common_rotation(a: FloatArray, b: FloatArray, common: FloatArray) -> None:
    turn = look_at_rotation(common)
    turned = [look_at_angles(turn @ look_at_rotation(x)) for x in (a, b)]
    # look_at_angles loses half the digits where alpha is near +-pi/2.
    assert rotation_error(*turned) == pytest.approx(rotation_error(a, b), abs=1e-6)


@given(st.integers(0, 2), st.floats(-np.pi, np.pi))
def test_rotation_error_of_one_turned_axis_is_the_angle(axis: int, turned: float) -> None:
    value = np.zeros(3)
    value[axis] = turned
    assert rotation_error(value, np.zeros(3)) == pytest.approx(abs(turned), abs=1e-12)


@given(st.floats(1e-9, 1e-3))
def test_rotation_error_keeps_small_angles(small: float) -> None:
    base = np.array([0.4, -2.0, 1.0])
    assert rotation_error(base + np.array([0.0, small, 0.0]), base) == pytest.approx(small, rel=1e-6)


@settings(max_examples=50)
@given(st.integers(0, 2**30))
def test_choose_twin_takes_the_nearer_beta_and_does_not_care_which_is_given(seed: int) -> None:
    estimate, truth = random_states(20, seed), random_states(20, seed + 1)
    chosen = choose_twin(estimate, truth)
    assert (np.abs(wrap_angle(chosen[:, BETA] - truth[:, BETA])) <= np.pi / 2 + 1e-12).all()
    again = choose_twin(twin(estimate), truth)
    np.testing.assert_allclose(look_at_rotation(again[:, :3]), look_at_rotation(chosen[:, :3]), atol=1e-12)
    np.testing.assert_array_equal(again[:, 3:], chosen[:, 3:])


def test_choose_twin_by_frame_and_reverses_the_wrist() -> None:
    truth = np.array([[0.1, 3.0, 0.2, 0, 0, 0.15, 0.5, -0.4, 0.3]] * 2)
    estimate = truth.copy()
    estimate[1, BETA] += np.pi - 0.2
    estimate[1, 6:8] = [-0.6, 0.4]
    errors = pose_errors(make_instrument(), CAMERA, estimate, truth)
    assert errors["rotation_error_rad"] == pytest.approx([0.0, 0.2], abs=1e-12)
    assert errors["q1_error_rad"] == pytest.approx([0.0, 0.1], abs=1e-12)
    assert errors["q2_error_rad"] == pytest.approx([0.0, 0.0], abs=1e-12)


def test_pose_errors_of_a_shift_and_a_joint() -> None:
    truth = np.array([[0.3, 0.2, -0.1, 0.0, 0.0, 0.15, 0.1, 0.2, 0.3]])
    shifted = truth + np.array([0, 0, 0, 0.003, 0.0, 0.004, 0, 0, 0])
    errors = pose_errors(make_instrument(), CAMERA, shifted, truth)
    assert errors["translation_error_m"] == pytest.approx([0.005])
    assert errors["tip_error_m"] == pytest.approx([0.005])
    assert errors["rotation_error_rad"] == 0.0
    wider = truth + np.array([0, 0, 0, 0, 0, 0, 0, 0, 0.05])
    errors = pose_errors(make_instrument(), CAMERA, wider, truth)
    assert errors["q3_error_rad"] == pytest.approx([0.05])
    # Each tip moves along a circle of 9.6 mm about the yaw axis.
    assert errors["tip_error_m"] == pytest.approx([2 * 0.0096 * np.sin(0.025)])
    assert errors["keypoint_error_px"] > 1.0


def test_keypoint_error_sums_both_tips_and_takes_the_better_assignment() -> None:
    tips = np.array([[10.0, 20.0], [40.0, 60.0]])
    moved = tips + np.array([[3.0, 4.0], [0.0, -2.0]])
    assert keypoint_error(moved, tips) == pytest.approx(7.0)
    assert keypoint_error(moved[::-1], tips) == pytest.approx(7.0)


def test_keypoint_error_of_a_tip_behind_the_camera_is_nan_and_the_rest_is_not() -> None:
    truth = random_states(1)
    behind = truth.copy()
    behind[0, 5] = -0.5
    errors = pose_errors(make_instrument(), CAMERA, behind, truth)
    assert np.isnan(errors["keypoint_error_px"]).all()
    assert np.isfinite(errors["tip_error_m"]).all()


def test_mask_error() -> None:
    values = mask_error(np.array([10, 10, 0, 0, 5]), np.array([10, 20, 7, 0, 5]), np.array([10, 5, 0, 0, 0]))
    assert values == pytest.approx([0.0, 0.8, 1.0, 0.0, 1.0])


@given(st.integers(0, 100), st.integers(0, 100), st.integers(0, 100))
def test_mask_error_is_between_zero_and_one_and_symmetric(only_a: int, only_b: int, both: int) -> None:
    error = mask_error(np.array(only_a + both), np.array(only_b + both), np.array(both))
    assert 0.0 <= error <= 1.0
    assert error == mask_error(np.array(only_b + both), np.array(only_a + both), np.array(both))


def test_jitter_is_the_acceleration_of_the_midpoint() -> None:
    dt_s = 0.05
    time = np.arange(20) * dt_s
    path = np.stack([2.0 * time, 0.5 * 0.3 * time**2, np.full(20, 0.15)], axis=-1)
    spread = np.array([0.004, 0.0, 0.0])
    tips = np.stack([path + spread, path - spread], axis=1)
    assert jitter(tips, dt_s) == pytest.approx(0.3)
    assert jitter(tips[:, ::-1], dt_s) == pytest.approx(0.3)
    assert np.isnan(jitter(tips[:2], dt_s))


def test_jitter_goes_by_the_time_where_frames_are_missing() -> None:
    """Constant velocity has none, constant acceleration its own, whatever gaps there are."""
    time = np.delete(0.04 * np.arange(40, dtype=np.float64), [3, 4, 11, 25, 26, 27, 28, 39])
    steps = steps_s(time, 0.04)
    even, falling = np.outer(time, [0.3, -0.1, 0.05]), np.outer(time**2 / 2, [0.0, 0.6, 0.8])
    for path, acceleration in ((even, 0.0), (even + falling, 1.0)):
        tips = np.stack([path + 0.004, path - 0.004], axis=1)
        assert jitter(tips, steps) == pytest.approx(acceleration, abs=1e-9)
        tips[7] = np.nan
        assert jitter(tips, steps) == pytest.approx(acceleration, abs=1e-9)
    regular = np.random.default_rng(0).normal(size=(9, 2, 3))
    assert jitter(regular, np.full(8, 0.04)) == jitter(regular, 0.04)


def test_lag_goes_by_the_time_where_frames_are_missing() -> None:
    time = np.delete(0.04 * np.arange(40, dtype=np.float64), [3, 4, 11, 25, 26, 27, 28])[:, None]
    late_s, rate = 0.05, np.array([0.02, -0.01, 0.005])
    assert lag((time - late_s) * rate, time * rate, steps_s(time[:, 0], 0.04)) == pytest.approx(late_s, abs=1e-12)


@pytest.mark.parametrize("frames_late", [-2, 0, 1, 3])
def test_lag_of_a_delayed_trajectory_is_the_delay(frames_late: int) -> None:
    """At constant velocity exactly; errors across the motion do not count."""
    dt_s = 0.04
    time = np.arange(50)[:, None] * dt_s
    velocity = np.array([0.02, -0.01, 0.005])
    truth, late = time * velocity, (time - frames_late * dt_s) * velocity
    assert lag(late, truth, dt_s) == pytest.approx(frames_late * dt_s, abs=1e-12)
    aside = late + np.array([0.01, 0.02, 0.0])
    assert lag(aside, truth, dt_s) == pytest.approx(frames_late * dt_s, abs=1e-12)


def test_lag_of_a_swinging_trajectory_delayed_by_frames() -> None:
    def place(time: Any) -> Any:
        return np.stack([np.sin(time), np.cos(1.3 * time), 0 * time], axis=-1)

    dt_s = 1 / 30
    time = np.arange(300) * dt_s
    shifted = place(time - 2 * dt_s)
    assert lag(shifted, place(time), dt_s) == pytest.approx(2 * dt_s, rel=0.01)
    trembling = shifted + generator(test="lag").normal(0, 1e-2, shifted.shape)
    assert lag(trembling, place(time), dt_s) == pytest.approx(2 * dt_s, rel=0.05)


def test_lag_without_motion_is_none() -> None:
    still = np.ones((10, 3))
    assert np.isnan(lag(still + 0.1, still, 0.05))
    assert np.isnan(lag(still[:2], np.arange(6.0).reshape(2, 3), 0.05))
    assert np.isnan(lag(np.empty((0, 3)), np.empty((0, 3)), 0.05))


def test_summarise_weighs_sequences_equally_and_spreads() -> None:
    summary = summarise([[np.array([1.0, 3.0])], [np.array([[4.0, np.nan]] * 3), np.array([8.0])]])
    assert summary.mean == pytest.approx(4.0)  # (2 + (4 + 8) / 2) / 2
    assert summary.std == pytest.approx(np.std([1, 3, 4, 4, 4, 8]))
    assert summary.sem == pytest.approx(np.std([2, 6], ddof=1) / np.sqrt(2))


def test_summarise_without_values() -> None:
    assert summarise([[np.array([1.0])]]).sem is None
    empty = summarise([[np.array([np.nan])], []])
    assert (empty.mean, empty.std, empty.sem) == (None, None, None)


def test_a_common_factor_in_distance_is_no_scaled_error() -> None:
    """What is left is what the factor cannot mend: a step aside, seen whole; and frames that do not count do not."""
    truth = np.random.default_rng(0).normal([0.0, 0.0, 0.13], 0.01, (50, 3))
    assert translation_error_scaled(0.9 * truth, truth) == pytest.approx(0.0, abs=1e-15)
    aside = 1.05 * truth + np.random.default_rng(1).normal(0.0, 1e-4, (50, 3))
    left = translation_error_scaled(aside, truth)
    assert 5e-5 < left < 3e-4
    assert left == pytest.approx(translation_error_scaled(2.0 * aside, truth))
    gone = np.vstack([aside, np.full((5, 3), np.nan)])
    assert translation_error_scaled(gone, np.vstack([truth, np.zeros((5, 3))])) == pytest.approx(left)
    assert np.isnan(translation_error_scaled(gone[50:], truth[:5]))
