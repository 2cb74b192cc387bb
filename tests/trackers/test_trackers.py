"""Optimisers, filters, the tracker and the initialisers on problems whose answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from support import observe, resting_state, scene_of

from surgbench.camera import Camera
from surgbench.contract import Trace
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.metrics import choose_twin, pose_errors
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.state import JOINTS, JointLimits
from surgbench.trackers.cmaes import CmaesTracker
from surgbench.trackers.filters.kalman import KalmanFilter
from surgbench.trackers.filters.none import NoFilter
from surgbench.trackers.initialisers.random import RandomInitialiser
from surgbench.trackers.initialisers.refinement import least_bent
from surgbench.trackers.initialisers.thickness import thickness_weights
from surgbench.trackers.initialisers.truth import TruthInitialiser
from surgbench.trackers.optimisers.cma import CMA
from surgbench.trackers.optimisers.cma_settings import tutorial_settings
from surgbench.trackers.optimisers.normals import SobolNormals

# --- optimisers


def minimise(search: CMA, loss: object, generations: int, rng: np.random.Generator, population: int) -> float:
    best = np.inf
    for _ in range(generations):
        samples = search.ask(rng.standard_normal((population, len(search.mean))))
        losses = np.array([loss(x) for x in samples])  # type: ignore[operator]
        search.tell(samples, losses)
        best = min(best, float(losses.min()))
    return best


def test_cma_finds_the_minimum_of_an_ill_conditioned_quadratic() -> None:
    scales = np.logspace(0, 3, 6)
    search = CMA(np.full(6, 3.0), 1.0, 20)
    assert minimise(search, lambda x: float(scales @ x**2), 300, np.random.default_rng(0), 20) < 1e-10


def test_cma_learns_the_inverse_hessian() -> None:
    """On a quadratic the covariance becomes proportional to the inverse of its matrix."""
    H = np.diag([1.0, 100.0])
    search = CMA(np.array([2.0, 2.0]), 1.0, 16)
    minimise(search, lambda x: float(x @ H @ x), 60, np.random.default_rng(1), 16)
    ratio = search.covariance[0, 0] / search.covariance[1, 1]
    assert 30 < ratio < 300


def test_cma_does_not_care_about_the_scale_of_the_losses() -> None:
    """Only ranks count: a monotone change of the losses changes nothing."""
    one, other = CMA(np.ones(4), 1.0, 12), CMA(np.ones(4), 1.0, 12)
    rng = np.random.default_rng(2)
    for _ in range(5):
        normals = rng.standard_normal((12, 4))
        samples = one.ask(normals)
        losses = (samples**2).sum(axis=1)
        one.tell(samples, losses)
        other.tell(other.ask(normals), np.exp(losses) * 1e3)
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_cma_keeps_arms_apart_and_survives_nan() -> None:
    settings = tutorial_settings(4, 12, mean_rate=2.0, covariance_rate=4.0, elites=4)
    search = CMA(np.zeros(4), 1.0, 12, settings=settings, blocks=(2, 2))
    rng = np.random.default_rng(3)
    for _ in range(30):
        samples = search.ask(rng.standard_normal((12, 4)))
        losses = (samples**2).sum(axis=1)
        losses[0] = np.nan
        search.tell(samples, losses)
    assert np.isfinite(search.mean).all()
    assert (search.covariance[:2, 2:] == 0).all()
    assert search.covariance[0, 1] != 0


def test_sobol_normals_are_normal_and_never_repeat() -> None:
    normals = SobolNormals(9, np.random.default_rng(0), block=1024)
    drawn = np.concatenate([normals.take(70) for _ in range(60)])
    assert len(np.unique(drawn[:, 0])) == len(drawn)
    assert np.isfinite(drawn).all()
    assert all(stats.kstest(column, "norm").pvalue > 0.01 for column in drawn.T)


@pytest.mark.parametrize("count", [1, 1023, 1025, 5000])
def test_as_many_normals_as_asked_for(count: int) -> None:
    """Of one sequence, whether taken at once or one by one."""
    at_once = SobolNormals(3, np.random.default_rng(0), block=1024)
    drawn = np.concatenate([at_once.take(700), at_once.take(count)])
    one_by_one = SobolNormals(3, np.random.default_rng(0), block=1024)
    np.testing.assert_array_equal(drawn, np.concatenate([one_by_one.take(1) for _ in range(700 + count)]))


# --- filters


def test_kalman_follows_constant_velocity_without_lag(small_camera: Camera) -> None:
    scene = scene_of(small_camera)
    velocity = np.array([0.1, 0.3, 0.1, 0.01, 0.02, -0.01, 0.3, 0.2, 0.1])
    published = KalmanFilter.Config(noise="published", measurement_noise=0.03, start="predicted")
    for config in (KalmanFilter.Config(), published):
        state_filter = KalmanFilter(config)
        start = np.array([0.2, 0.1, 0.3, 0.0, 0.0, 0.12, -0.5, -0.5, 0.1])
        state_filter.reset(scene, start)
        for k in range(1, 61):
            state_filter.predict()
            state_filter.update(start + velocity * k * scene.dt_s)
        expected = start + velocity * 61 * scene.dt_s
        assert np.abs(state_filter.predict() - expected)[[0, 3, 4]].max() < 2e-3


def test_published_kalman_is_that_of_the_released_code(small_camera: Camera) -> None:
    """A frame is 1/20 s whatever the recording says, a fast one too, and the filtered state starts the next search."""
    estimate = np.array([0.21, 0.1, 0.3, 0.0, 0.0, 0.12, -0.5, -0.5, 0.1])
    start = estimate - np.array([0.01, 0, 0, 0, 0, 0, 0, 0, 0])
    found = []
    for scene in (scene_of(small_camera), replace(scene_of(small_camera), dt_s=1 / 60, speed="fast")):
        state_filter = KalmanFilter(KalmanFilter.Config(noise="published"))
        state_filter.reset(scene, start)
        np.testing.assert_array_equal(state_filter.predict(), start)
        filtered = state_filter.update(estimate)
        np.testing.assert_array_equal(state_filter.predict(), filtered)
        found.append(filtered[0])
    # P = 1e-2 I, at rest; Q = 2e-5 of the value: the prediction's variance is 1e-2 + 1e-2 dt² + 2e-5. R = 2e-3.
    variance = 1e-2 + 1e-2 / 20**2 + 2e-5
    assert found == pytest.approx(2 * [start[0] + 0.01 * variance / (variance + 2e-3)], abs=1e-12)


def test_kalman_unwraps_angles(small_camera: Camera) -> None:
    """From 3.1 to -3.1 rad is a step of 0.08 rad, not of 6.2."""
    state_filter = KalmanFilter()
    state = resting_state()
    state[1] = 3.1
    state_filter.reset(scene_of(small_camera), state)
    state_filter.predict()
    turned = state.copy()
    turned[1] = -3.1
    filtered = state_filter.update(turned)
    assert 3.1 < filtered[1] < 2 * np.pi - 3.1 + 1e-9


@pytest.mark.parametrize("make", [KalmanFilter, NoFilter])
def test_filters_clamp_joints(make: type[KalmanFilter] | type[NoFilter], small_camera: Camera) -> None:
    scene = scene_of(small_camera)
    state_filter = make()
    outside = resting_state()
    state_filter.reset(scene, outside)
    outside[6:] = 3.0, -3.0, -1.0
    limits = scene.limits[0]
    for _ in range(5):
        for joints in (state_filter.predict()[6:], state_filter.update(outside)[6:]):
            assert (joints >= limits.lower_rad).all()
            assert (joints <= limits.upper_rad).all()


def test_fast_motion_gets_larger_velocity_noise(small_camera: Camera) -> None:
    """After one surprising step the fast filter expects more of the same than the nominal one."""
    predicted = []
    for speed in ("nominal", "fast"):
        state_filter = KalmanFilter()
        state_filter.reset(scene_of(small_camera, speed=speed), resting_state())
        state_filter.predict()
        moved = resting_state()
        moved[3] += 0.002
        filtered = state_filter.update(moved)
        predicted.append(state_filter.predict()[3] - filtered[3])
    assert predicted[1] > 1.5 * predicted[0] > 0


# --- the tracker


def follow(camera: Camera, joints: bool, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """States and estimates of 12 frames of a moving instrument."""
    scene = scene_of(camera)
    truth = resting_state() + np.linspace(0, 1, 12)[:, None] * np.array(
        [0.05, 0.1, 0.05, 4e-3, 3e-3, 2e-3, 0.2, 0.1, 0]
    )
    tracker = CmaesTracker()
    tracker.reset(scene, truth[0], np.random.default_rng(seed))
    estimates = [truth[0]]
    for k, state in enumerate(truth):
        reading = state[6:] if joints else None
        start = estimates[-1].copy()
        if reading is not None:
            start[6:] = reading
        estimates.append(tracker.step(replace(observe(scene, state, k, reading), start=start)).state)
    return truth, np.array(estimates[1:])


@pytest.mark.slow
@pytest.mark.parametrize("joints", [False, True])
def test_cmaes_follows_a_moving_instrument(camera: Camera, joints: bool) -> None:
    truth, estimates = follow(camera, joints)
    scene = scene_of(camera)
    errors = pose_errors(scene.instruments[0], camera, estimates, truth)
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    overlaps = [
        evaluator.score(estimate[None], reference).iou(reference)[0]
        for estimate, reference in zip(estimates, (Reference(evaluator.mask(s)) for s in truth), strict=True)
    ]
    assert np.mean(overlaps) > 0.93
    assert errors["rotation_error_rad"].mean() < (0.1 if joints else 0.4)
    if joints:
        assert errors["q1_error_rad"].mean() < 0.03


@pytest.mark.slow
def test_cmaes_gives_the_same_result_for_the_same_seed(small_camera: Camera) -> None:
    one, again, other = (follow(small_camera, False, seed)[1] for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)


def test_cmaes_follows_two_arms_in_one_mask(camera: Camera) -> None:
    scene = scene_of(camera, arms=2)
    left, right = resting_state(), resting_state()
    left[[2, 3]], right[[2, 3]] = [0.8, -0.02], [-0.8, 0.025]
    truth = np.concatenate([left, right])
    tracker = CmaesTracker(CmaesTracker.Config(iterations=6))
    start = truth + np.tile([0.01, 0.05, 0.01, 1e-3, -1e-3, 1e-3, 0.05, 0.05, 0.02], 2)
    tracker.reset(scene, start, np.random.default_rng(0))
    estimate = tracker.step(replace(observe(scene, truth), start=start))
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    reference = Reference(evaluator.mask(truth))
    before, after = evaluator.score(np.stack([start, estimate.state]), reference).iou(reference)
    assert estimate.state.shape == (18,)
    assert after > max(before, 0.9)


def test_cmaes_says_when_it_is_lost(small_camera: Camera) -> None:
    scene = scene_of(small_camera)
    tracker = CmaesTracker()
    tracker.reset(scene, resting_state(), np.random.default_rng(0))
    frame = observe(scene, resting_state())
    for mask in (np.zeros_like(frame.mask), np.ones_like(frame.mask)):
        estimate = tracker.step(replace(frame, views=(replace(frame.views[0], mask=mask),)))
        assert estimate.lost
        assert np.isfinite(estimate.state).all()


def test_trace_holds_the_candidates_best_first(small_camera: Camera) -> None:
    scene = scene_of(small_camera)
    tracker = CmaesTracker()
    tracker.reset(scene, resting_state(), np.random.default_rng(0))
    tracker.trace = Trace()
    estimate = tracker.step(observe(scene, resting_state()))
    assert [len(states) for states in tracker.trace.states] == [70, 70, 70]
    assert all((np.diff(losses) >= 0).all() for losses in tracker.trace.losses)
    best = min(range(3), key=lambda k: tracker.trace.losses[k][0])
    np.testing.assert_array_equal(tracker.trace.states[best][0], estimate.state)


# --- initialisers


@pytest.mark.slow
def test_random_initialiser_needs_no_hint(camera: Camera) -> None:
    scene = scene_of(camera)
    truth = resting_state(0.14)
    config = RandomInitialiser.Config(hypotheses=2048, refined=8, finalists=2, generations=(15, 40))
    fractions: list[float] = []
    state = RandomInitialiser(config).initialise(
        scene, observe(scene, truth), np.random.default_rng(0), None, fractions.append
    )
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    reference = Reference(evaluator.mask(truth))
    assert evaluator.score(state[None], reference).iou(reference)[0] > 0.9
    assert fractions == sorted(fractions)
    assert 0.9 < fractions[-1] <= 1.0
    tips = scene.instruments[0].tips_cam(choose_twin(state, truth))
    assert np.linalg.norm(tips.mean(axis=0) - scene.instruments[0].tips_cam(truth).mean(axis=0)) < 0.02


def test_random_initialiser_keeps_to_readings(small_camera: Camera) -> None:
    scene = scene_of(small_camera)
    truth = resting_state(0.14)
    config = RandomInitialiser.Config(hypotheses=512, refined=4, finalists=1, generations=(5, 10))
    frame = observe(scene, truth, joints=truth[6:])
    state = RandomInitialiser(config).initialise(scene, frame, np.random.default_rng(0), None, lambda _: None)
    assert np.abs(state[6:] - truth[6:]).max() < 0.3


def test_random_initialiser_refuses_an_empty_mask(small_camera: Camera) -> None:
    scene = scene_of(small_camera)
    frame = observe(scene, resting_state(-1.0))
    with pytest.raises(SurgbenchError, match="empty"):
        RandomInitialiser().initialise(scene, frame, np.random.default_rng(0), None, lambda _: None)


@pytest.mark.slow
def test_random_initialiser_tells_two_arms_apart(camera: Camera) -> None:
    scene = scene_of(camera, arms=2)
    left, right = resting_state(), resting_state()
    left[[2, 3]], right[[2, 3]] = [0.8, -0.025], [-0.8, 0.03]
    frame = observe(scene, np.concatenate([left, right]))
    config = RandomInitialiser.Config(hypotheses=512, refined=4, finalists=1, generations=(5, 10))
    state = RandomInitialiser(config).initialise(scene, frame, np.random.default_rng(0), None, lambda _: None)
    assert state[3] < 0 < state[12]


def test_of_states_that_fit_alike_the_least_bent_wrist_is_taken() -> None:
    limits = JointLimits(np.array([-1.5, -1.0, 0.0]), np.array([1.5, 1.0, 1.4]))
    states = np.zeros((3, 9))
    states[:, JOINTS] = [[-1.45, 0.1, 0.5], [0.9, 0.2, 0.0], [0.1, -0.8, 1.4]]
    np.testing.assert_array_equal(least_bent(states, limits), states[1])


def test_thin_parts_weigh_more_than_thick_ones() -> None:
    mask = np.zeros((80, 120), dtype=bool)
    mask[20:60, :60] = True
    mask[38:42, 60:110] = True
    weights = thickness_weights(mask)
    assert weights[40, 30] == pytest.approx(1.0, abs=0.3)
    assert weights[40, 90] == pytest.approx(10**0.5, rel=0.2)
    assert weights.min() >= 1.0


def test_truth_initialiser_needs_truth(small_camera: Camera) -> None:
    scene = scene_of(small_camera)
    with pytest.raises(SurgbenchError, match="ground truth"):
        TruthInitialiser().initialise(
            scene, observe(scene, resting_state()), np.random.default_rng(0), None, lambda _: None
        )
