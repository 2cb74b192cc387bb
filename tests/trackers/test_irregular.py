"""Frames that are not evenly apart: what predicts motion goes by the true time, and regular data by no other bits."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from support import resting_state, scene_of

from surgbench.camera import Camera
from surgbench.contract import TimedFilter
from surgbench.state import STATE_SCALE
from surgbench.timing import STEADY_S, carried_s, step_s
from surgbench.trackers.filters.kalman import KalmanFilter
from surgbench.trackers.registration.belief import MotionBelief

DT_S = 1 / 30
RATE = np.array([0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0])  # per second


@pytest.mark.parametrize("noise", ["tuned", "published"])
def test_a_kalman_filter_goes_as_far_as_the_time_does(small_camera: Camera, noise: Any) -> None:
    scene, state = scene_of(small_camera), resting_state()
    known, told = KalmanFilter(KalmanFilter.Config(noise=noise, start="predicted")), KalmanFilter()
    known.reset(scene, state)
    for k in range(1, 60):
        known.elapse(scene.dt_s)
        known.predict()
        known.update(state + RATE * k * scene.dt_s)
    moved = known.predict() - state
    expected = RATE * 60 * scene.dt_s
    np.testing.assert_allclose(moved[3], expected[3], rtol=0.1)
    known.update(state + expected)
    known.elapse(5 * scene.dt_s)
    np.testing.assert_allclose((known.predict() - state)[3], RATE[3] * 65 * scene.dt_s, rtol=0.1)
    assert isinstance(told, TimedFilter)


def test_a_filter_that_is_told_of_regular_frames_gives_the_same_bits(small_camera: Camera) -> None:
    scene, state = scene_of(small_camera), resting_state()
    one, other = KalmanFilter(), KalmanFilter()
    one.reset(scene, state)
    other.reset(scene, state)
    for k in range(20):
        other.elapse(step_s(k * scene.dt_s, (k + 1) * scene.dt_s, scene.dt_s))
        assert np.array_equal(one.predict(), other.predict())
        estimate = state + 1e-3 * np.sin(k + np.arange(9))
        assert np.array_equal(one.update(estimate), other.update(estimate))


def belief() -> MotionBelief:
    made = MotionBelief(STATE_SCALE, DT_S, 10 * STATE_SCALE, STATE_SCALE, 0.02, 1e-4)
    made.restart(resting_state(), STATE_SCALE)
    return made


def test_a_belief_spreads_with_the_time_that_passes() -> None:
    regular, told, long = belief(), belief(), belief()
    regular.predict()
    told.predict(DT_S)
    long.predict(4 * DT_S)
    assert np.array_equal(regular.covariance, told.covariance)
    assert (np.diag(long.covariance) > np.diag(regular.covariance)).all()
    # Of constant acceleration over a step: its fourth power, beside what the velocity adds.
    one, four = (made.covariance[3, 3] - 1.0 - dt**2 for made, dt in ((regular, DT_S), (long, 4 * DT_S)))
    np.testing.assert_allclose(four / one, 4**4, rtol=1e-6)


def test_steps_that_are_regular_but_for_rounding_are_the_nominal_one() -> None:
    times = np.arange(1000) * DT_S
    assert {step_s(a, b, DT_S) for a, b in pairwise(times)} == {DT_S}
    assert step_s(1.0, 1.0, DT_S) == step_s(2.0, 1.0, DT_S) == DT_S
    assert carried_s(10.0, DT_S) == STEADY_S
    assert carried_s(2.0, 2.0) == 2.0  # one frame in two seconds, as a rule
