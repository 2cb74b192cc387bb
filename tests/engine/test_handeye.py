"""Hand-eye transform and lag: what is known comes back, through noise, twins, outliers and gaps; rest is refused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgbench.geometry import (
    FloatArray,
    inverse_transform,
    rigid_transform,
    rotation_angle,
    rotation_from_vector,
)
from surgbench.handeye import ReadingTrack, TooLittleMotionError, estimate_hand_eye
from surgbench.handeye.fit import NOMINAL, closed_form, nearest_alike, robust_fit
from surgbench.instrument.arm import CLASSIC_400006

DT_S = 1 / 30
FRAMES = np.arange(240.0)
MAX_LAG = 15  # as far as these tests look
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
T_CAM_BASE = rigid_transform(rotation_from_vector(np.array([2.0, -0.4, 0.9])), np.array([0.03, -0.05, 0.25]))


def joints(frame: FloatArray) -> FloatArray:
    """Of an arm that never does the same twice, ``(n, 4)``."""
    yaw = 0.15 * np.sin(0.071 * frame) + 0.08 * np.cos(0.113 * frame)
    pitch = 0.12 * np.cos(0.053 * frame) + 0.07 * np.sin(0.129 * frame)
    insertion = 0.14 + 0.015 * np.sin(0.061 * frame + 1.0)
    return np.stack([yaw, pitch, insertion, 0.6 * np.sin(0.089 * frame)], axis=-1)


def arm(frame: FloatArray) -> FloatArray:
    return CLASSIC_400006.forward(joints(frame))


def noisy(poses: FloatArray, rad: float, metres: float, rng: np.random.Generator) -> FloatArray:
    """Turned and moved in the camera's frame, each frame for itself."""
    changed = poses.copy()
    changed[:, :3, :3] = rotation_from_vector(rad * rng.standard_normal((len(poses), 3))) @ poses[:, :3, :3]
    changed[:, :3, 3] += metres * rng.standard_normal((len(poses), 3))
    return changed


@dataclass(frozen=True)
class Apart:
    """Two transforms at a place."""

    rotation_rad: float
    translation_m: float


def apart(found: FloatArray, true: FloatArray, middle_base: FloatArray) -> Apart:
    change = found @ inverse_transform(true)
    middle = true[:3, :3] @ middle_base + true[:3, 3]
    moved = change[:3, :3] @ middle + change[:3, 3] - middle
    return Apart(float(rotation_angle(change[:3, :3])), float(np.linalg.norm(moved)))


turns = st.tuples(*[st.floats(-2.0, 2.0)] * 3).map(np.array)
places = st.tuples(*[st.floats(-0.3, 0.3)] * 3).map(np.array)


@settings(max_examples=4)
@given(turns, places, st.integers(-10, 10), st.booleans())
def test_a_known_transform_and_lag_come_back_exactly(
    turn: FloatArray, place: FloatArray, lag: int, turned: bool
) -> None:
    true = rigid_transform(rotation_from_vector(turn), place)
    tracked = true @ arm(FRAMES) @ (HALF_TURN if turned else np.eye(4))
    found = estimate_hand_eye(FRAMES * DT_S, tracked, arm(FRAMES - lag), DT_S, max_lag_frames=MAX_LAG)
    assert found.lag_frames == pytest.approx(lag, abs=1e-3)
    np.testing.assert_allclose(found.T_cam_base, true, atol=1e-5)
    assert found.rotation_rad.max() < 1e-4
    assert found.translation_m.max() < 1e-5
    assert found.frames == len(FRAMES) - abs(lag)


@pytest.mark.parametrize("lag", [-3.5, 2.3])
def test_a_lag_between_frames(lag: float) -> None:
    tracked = T_CAM_BASE @ arm(FRAMES)
    found = estimate_hand_eye(FRAMES * DT_S, tracked, arm(FRAMES - lag), DT_S, max_lag_frames=MAX_LAG)
    assert found.lag_frames == pytest.approx(lag, abs=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_noise_twins_slips_and_gaps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tracked = noisy(T_CAM_BASE @ arm(FRAMES), 0.03, 0.001, rng)
    tracked[rng.random(len(FRAMES)) < 0.5] @= HALF_TURN
    # The tracker slips for 36 frames, far to one side; and 10 frames have no estimate, 20 no reading.
    tracked[50:86] = noisy(tracked[50:86], 0.8, 0.01, rng)
    tracked[50:86, :3, 3] += [0.03, 0.0, 0.02]
    tracked[120:130] = np.nan
    readings = arm(FRAMES - 4.0)
    readings[180:200] = np.nan
    found = estimate_hand_eye(FRAMES * DT_S, tracked, readings, DT_S, max_lag_frames=MAX_LAG)
    assert found.lag_frames == pytest.approx(4.0, abs=0.5)
    low, high = found.lag_interval_frames
    assert low < found.lag_frames < high < low + 3.0
    assert low < 4.0 < high
    off = apart(found.T_cam_base, T_CAM_BASE, found.middle_base_m)
    assert off.rotation_rad < np.radians(1.0)
    assert off.translation_m < 0.001
    # What is left is the noise: of three components of 0.03 rad and 1 mm.
    assert np.median(found.rotation_rad) == pytest.approx(0.03 * 1.538, rel=0.25)
    assert np.median(found.translation_m) == pytest.approx(0.001 * 1.538, rel=0.25)
    assert np.percentile(found.translation_m, 90) > 0.01
    assert np.isnan(found.off[120:130]).all()


def test_frames_that_do_not_count_are_not_learnt_from() -> None:
    tracked, counts = T_CAM_BASE @ arm(FRAMES), FRAMES < 100
    tracked[100:, :3, 3] += 0.02
    found = estimate_hand_eye(FRAMES * DT_S, tracked, arm(FRAMES), DT_S, counts, max_lag_frames=MAX_LAG)
    np.testing.assert_allclose(found.T_cam_base, T_CAM_BASE, atol=1e-5)
    np.testing.assert_allclose(found.translation_m[100:], 0.02 * np.sqrt(3), atol=1e-5)


def test_stretched_cables_are_no_lag() -> None:
    stretch = np.array([0.004, 0.003, 0.0006, 0.005])
    speed = np.gradient(joints(FRAMES), DT_S, axis=0)
    read = joints(FRAMES - 0.0) + stretch * speed / np.hypot(speed, [0.02, 0.02, 0.002, 0.02])
    tracked = noisy(T_CAM_BASE @ arm(FRAMES), 0.005, 0.0002, np.random.default_rng(0))
    found = estimate_hand_eye(FRAMES * DT_S, tracked, CLASSIC_400006.forward(read), DT_S, max_lag_frames=MAX_LAG)
    assert found.lag_frames == pytest.approx(0.0, abs=0.15)
    share = found.stretch / stretch
    assert ((share[:3] > 0.7) & (share[:3] < 1.2)).all()
    assert 0.2 < share[3] < 1.2  # of roll the wrist's place tells nothing


RESTING = {
    "rests": np.zeros_like(FRAMES),
    "moves evenly along a line": 0.2 * FRAMES,
    "goes to and fro without change": 4.0 * np.sin(2 * np.pi * FRAMES / 12.0),
}


@pytest.mark.parametrize("how", RESTING)
def test_motion_that_tells_nothing_is_refused(how: str) -> None:
    poses = np.broadcast_to(np.eye(4), (len(FRAMES), 4, 4)).copy()
    poses[:, 0, 3] = 0.001 * RESTING[how]
    tracked = noisy(T_CAM_BASE @ poses, 0.01, 0.0005, np.random.default_rng(0))
    with pytest.raises(TooLittleMotionError, match=r"the arm moves too little to judge by: .* mm and .*°, ") as refused:
        estimate_hand_eye(FRAMES * DT_S, tracked, poses, DT_S, max_lag_frames=MAX_LAG)
    assert "\n" not in str(refused.value)


def test_too_few_frames_are_refused() -> None:
    tracked = T_CAM_BASE @ arm(FRAMES)
    tracked[20:] = np.nan
    with pytest.raises(TooLittleMotionError, match="20 frames have an estimate to go by; 30 are needed"):
        estimate_hand_eye(FRAMES * DT_S, tracked, arm(FRAMES), DT_S)
    readings = arm(FRAMES)
    readings[:-20] = np.nan
    with pytest.raises(TooLittleMotionError, match="20 frames with readings"):
        estimate_hand_eye(FRAMES * DT_S, T_CAM_BASE @ arm(FRAMES), readings, DT_S)


def test_the_better_tracker_leaves_less() -> None:
    left = []
    for size in (0.5, 1.0, 2.0):
        tracked = noisy(T_CAM_BASE @ arm(FRAMES), 0.02 * size, 0.001 * size, np.random.default_rng(1))
        found = estimate_hand_eye(FRAMES * DT_S, tracked, arm(FRAMES), DT_S, max_lag_frames=MAX_LAG)
        left.append((np.median(found.rotation_rad), np.median(found.translation_m)))
    assert np.all(np.diff(left, axis=0) > 0)


@given(turns, places)
def test_the_closed_form_is_exact_and_the_robust_one_too(turn: FloatArray, place: FloatArray) -> None:
    true, poses = rigid_transform(rotation_from_vector(turn), place), arm(FRAMES[::8])
    np.testing.assert_allclose(closed_form(true @ poses, poses, np.ones((len(poses), 2))), true, atol=1e-12)
    tracked = true @ poses
    tracked[::3] @= HALF_TURN
    tracked[1::5, :3, 3] += 0.1
    np.testing.assert_allclose(robust_fit(tracked, poses, NOMINAL), true, atol=1e-3)
    again = nearest_alike(tracked[:, :3, :3], (true @ poses)[:, :3, :3])
    np.testing.assert_allclose(again, (true @ poses)[:, :3, :3], atol=1e-12)


def test_readings_are_there_between_neighbours_only() -> None:
    times, poses = np.array([0.0, 1.0, 2.0, 7.0, 8.0]), arm(np.array([0.0, 5.0, 10.0, 35.0, 40.0]))
    poses[1] = np.nan
    track = ReadingTrack(times, poses, dt_s=1.0)
    known = np.isfinite(track.at(np.array([-0.1, 0.0, 1.0, 2.0, 2.1, 6.9, 7.0, 7.5, 8.0, 8.1]))[:, 0, 0])
    # The one missing reading is bridged; the gap of five frames is not.
    assert known.tolist() == [False, True, True, True, False, False, True, True, True, False]
    np.testing.assert_allclose(track.at(times)[[0, 2, 3, 4]], poses[[0, 2, 3, 4]], atol=1e-12)
    middle = track.at(np.array([7.5]))[0]
    half = rotation_angle(poses[3, :3, :3].T @ poses[4, :3, :3]) / 2
    assert rotation_angle(poses[3, :3, :3].T @ middle[:3, :3]) == pytest.approx(float(half))
