"""Several calibrated views in one objective, and in one contour fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import observe, resting_state, scene_of

from surgbench.camera import Camera
from surgbench.camera.change_of_view import ChangeOfView, angle_rates
from surgbench.contract import Observation, Scene, View
from surgbench.geometry import (
    FloatArray,
    inverse_transform,
    look_at_rotation,
    rigid_transform,
    rotation_from_vector,
)
from surgbench.metrics import pose_errors
from surgbench.objective import LossWeights, Objective
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.state import ANGLES, POSITION, STATE_SCALE
from surgbench.trackers.arm_masks import mask_per_arm
from surgbench.trackers.registration.fit import ContourFit, FitConfig, Prior
from surgbench.trackers.registration.view_fit import CALIBRATION

SIDE = Camera(width=512, height=384, fx=387.365, fy=385.763, cx=247.653, cy=187.991)
# From the side: the camera's frame turned by a third of a turn about an oblique axis through the instrument.
ABOUT = np.array([0.01, 0.005, 0.14])


def from_the_side(turn: tuple[float, float, float] = (0.3, 1.4, 0.2), distance_m: float = 0.12) -> FloatArray:
    """T_view_cam of a camera that looks at the resting instrument from another side."""
    rotation = rotation_from_vector(np.array(turn))
    return rigid_transform(rotation, np.array([0.0, 0.0, distance_m]) - rotation @ ABOUT)


def two_views(scene: Scene, camera: Camera, T_view_cam: FloatArray) -> Scene:
    further = View(camera, T_view_cam, np.zeros((camera.height, camera.width), dtype=bool), keypoints=(None,))
    return replace(scene, views=(scene.views[0], further))


def look(scene: Scene, state: FloatArray, index: int = 0, tips: bool = False) -> Observation:
    """What all cameras of a scene see of one arm; with the tips 20 px off where they are."""
    views = []
    for view in scene.views:
        own = ChangeOfView(view.T_view_cam).states(state)
        keypoints = view.camera.project(scene.instruments[0].tips_cam(own)) + np.array([12.0, 16.0]) if tips else None
        mask = SilhouetteEvaluator(scene.instruments, view.camera).mask(own)
        views.append(replace(view, mask=mask, keypoints=(keypoints,)))
    return Observation(index, index * scene.dt_s, tuple(views), start=state.copy())


def scored(scene: Scene, observation: Observation) -> Objective:
    objective = Objective(scene, LossWeights())
    objective.observe(observation)
    return objective


# --- change of frame


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 2))
def test_a_change_of_view_is_exact_and_so_is_its_derivative(seed: int, arms: int) -> None:
    rng = np.random.default_rng(seed)
    T = rigid_transform(rotation_from_vector(rng.normal(0, 1.5, 3)), rng.normal(0, 0.1, 3))
    change, states = ChangeOfView(T), rng.normal(0, 1, (3, 9 * arms))
    moved = change.states(states)
    here, there = states.reshape(-1, 9), moved.reshape(-1, 9)
    np.testing.assert_allclose(
        look_at_rotation(there[:, ANGLES]), T[:3, :3] @ look_at_rotation(here[:, ANGLES]), atol=1e-9
    )
    np.testing.assert_allclose(there[:, POSITION], here[:, POSITION] @ T[:3, :3].T + T[:3, 3], atol=1e-12)
    np.testing.assert_array_equal(there[:, 6:], here[:, 6:])
    back = ChangeOfView(inverse_transform(T)).states(moved).reshape(-1, 9)
    np.testing.assert_allclose(look_at_rotation(back[:, ANGLES]), look_at_rotation(here[:, ANGLES]), atol=1e-9)
    # A function that does not jump where an angle is wrapped.
    weights = rng.normal(0, 1, 9 * arms)

    def value(at: FloatArray) -> FloatArray:
        return np.asarray(np.sin(change.states(at)) @ weights)

    slope = change.pull_back(states, np.cos(moved) * weights)
    steps = 1e-6 * np.eye(9 * arms)
    numeric = np.stack([(value(states + step) - value(states - step)) / 2e-6 for step in steps], axis=1)
    scale = 1.0 / np.abs(np.cos(there[:, 0])).min()  # rates grow where the shaft stands along the view's y axis
    np.testing.assert_allclose(slope, numeric, atol=1e-6 * scale**2)
    one = change.pull_back(states[0], np.tile(np.cos(moved[0]) * weights, (2, 1)))
    np.testing.assert_allclose(one, np.tile(slope[0], (2, 1)), atol=1e-12 * scale)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_shaft_along_the_views_y_axis_keeps_its_rotation(side: float) -> None:
    """There beta and gamma are one angle, and naive inverses give any."""
    state = resting_state()
    wanted = look_at_rotation(np.array([side * np.pi / 2, 0.7, 0.0]))
    T = rigid_transform(wanted @ look_at_rotation(state[ANGLES]).T, np.zeros(3))
    moved = ChangeOfView(T).states(state)
    np.testing.assert_allclose(look_at_rotation(moved[ANGLES]), wanted, atol=1e-7)
    assert np.isfinite(ChangeOfView(T).pull_back(state, np.ones((1, 9)))).all()


def test_what_is_not_finite_stays_so() -> None:
    states = np.stack([resting_state(), np.full(9, np.nan), np.full(9, np.inf)])
    moved = ChangeOfView(from_the_side()).states(states)
    assert np.isfinite(moved).all(axis=1).tolist() == [True, False, False]


def test_rates_of_the_angles_are_those_of_a_turning_frame() -> None:
    angles, w = np.array([0.4, -1.0, 2.0]), np.array([0.3, -0.2, 0.5])
    turned = rotation_from_vector(1e-7 * w) @ look_at_rotation(angles)
    expected = look_at_rotation(angles + 1e-7 * angle_rates(angles) @ w)
    np.testing.assert_allclose(turned, expected, atol=1e-12)


# --- the objective


def test_two_identical_views_are_twice_one(camera: Camera) -> None:
    scene, state = scene_of(camera), resting_state()
    frame = look(scene, state, tips=True)
    twice = replace(scene, views=scene.views * 2)
    one, two = scored(scene, frame), scored(twice, replace(frame, views=frame.views * 2))
    states = state + np.random.default_rng(0).standard_normal((20, 9)) * STATE_SCALE
    losses, overlaps = one(states)
    both, pooled = two(states)
    np.testing.assert_allclose(both, 2 * losses, rtol=1e-12)
    np.testing.assert_array_equal(pooled, overlaps)
    np.testing.assert_allclose(two.gradient(states), 2 * one.gradient(states), rtol=1e-12)
    assert np.argmin(both) == np.argmin(losses)


def test_the_overlap_is_pooled_and_the_loss_is_each_views_own(camera: Camera) -> None:
    scene = two_views(scene_of(camera), SIDE, from_the_side())
    target, other = resting_state(), resting_state(0.135)
    frame = look(scene, target)
    losses, overlaps = scored(scene, frame)(np.stack([target, other]))
    assert (losses[0], overlaps[0]) == (0.0, 1.0)
    shared = union = 0
    expected = 0.0
    for view in frame.views:
        own = ChangeOfView(view.T_view_cam).states(other)
        S = SilhouetteEvaluator(scene.instruments, view.camera).mask(own)
        shared, union = shared + int((S & view.mask).sum()), union + int((S | view.mask).sum())
        excess = abs(int(S.sum()) - int(view.mask.sum()))
        expected += float((S ^ view.mask).sum()) + LossWeights().appearance * excess
    assert overlaps[1] == pytest.approx(shared / union)
    assert losses[1] == pytest.approx(expected)


def test_the_gradient_of_all_views_predicts_the_change_of_the_loss(camera: Camera) -> None:
    """Downhill by 0.2 natural steps, tips 20 px off in both views included."""
    scene, state = two_views(scene_of(camera), SIDE, from_the_side()), resting_state()
    objective = scored(scene, look(scene, state, tips=True))
    states = state + np.random.default_rng(1).standard_normal((12, 9)) * STATE_SCALE
    gradient = objective.gradient(states) * STATE_SCALE
    before, _ = objective(states)
    downhill = -0.2 * gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    after, _ = objective(states + STATE_SCALE * downhill)
    assert (after < before).all()
    assert np.median((after - before) / np.sum(downhill * gradient, axis=1)) == pytest.approx(1.0, abs=0.1)


def test_a_view_may_move_from_frame_to_frame(camera: Camera) -> None:
    scene, state = two_views(scene_of(camera), SIDE, from_the_side()), resting_state()
    objective = Objective(scene, LossWeights())
    for turn in ((0.3, 1.4, 0.2), (0.2, 1.1, 0.1)):
        there = two_views(scene, SIDE, from_the_side(turn))
        objective.observe(look(there, state))
        assert objective(state[None])[0][0] == 0.0


def test_a_second_view_tells_what_one_view_does_not(camera: Camera) -> None:
    """Farther away by 2 mm is a little thinner to the endoscope, and somewhere else from the side."""
    scene, state = scene_of(camera), resting_state()
    both = two_views(scene, SIDE, from_the_side())
    away = state.copy()
    away[POSITION] *= 1 + 2e-3 / np.linalg.norm(state[POSITION])
    alone = scored(scene, look(scene, state))(away[None])[1][0]
    together = scored(both, look(both, state))(away[None])[1][0]
    assert 1 - together > 1.5 * (1 - alone)


def test_a_frame_without_one_of_the_views_is_an_error(camera: Camera) -> None:
    scene = two_views(scene_of(camera), SIDE, from_the_side())
    with pytest.raises(ValueError, match="shorter"):
        Objective(scene, LossWeights()).observe(observe(scene, resting_state()))


def test_arms_are_told_apart_by_their_sides_in_the_reference_view_alone(small_camera: Camera) -> None:
    mask = np.zeros((small_camera.height, small_camera.width), dtype=bool)
    mask[10:20, 5:20] = mask[10:20, 60:75] = True
    view = View(small_camera, np.eye(4), mask, keypoints=(None, None))
    assert mask_per_arm(view, 2) is not None
    assert mask_per_arm(replace(view, T_view_cam=from_the_side()), 2) is None


# --- the contour fit


def test_the_contour_fit_learns_what_a_second_views_pose_is_wrong_by(camera: Camera) -> None:
    """A camera reported 3 mm and 0.7 degrees from where it is: the state stays right, and the error is learned."""
    instrument_scene, truth = scene_of(camera), resting_state()
    really = two_views(instrument_scene, SIDE, from_the_side())
    error = np.array([0.008, -0.006, 0.008, 2e-3, -1.5e-3, 2e-3])
    wrong = rigid_transform(rotation_from_vector(error[:3]), error[3:])
    told = inverse_transform(wrong) @ from_the_side()
    evaluator = SilhouetteEvaluator(really.instruments, camera)
    fit = ContourFit(really, evaluator, STATE_SCALE, FitConfig())
    information = np.diag((STATE_SCALE / [0.01, 0.05, 0.01, 1e-3, 1e-3, 1e-3, 0.05, 0.05, 0.05]) ** 2)
    for index in range(6):
        seen = look(really, truth, index)
        seen = replace(seen, views=(seen.views[0], replace(seen.views[1], T_view_cam=told)))
        found = fit(truth + 0.3 * STATE_SCALE, seen, Prior(truth, information))
    errors = pose_errors(really.instruments[0], camera, found.state[None], truth[None])
    assert errors["tip_error_m"][0] < 2e-4
    assert errors["rotation_error_rad"][0] < 5e-3
    assert found.explained > 0.95
    # A small turn and a small shift can hardly be told apart: what was learned is where the instrument is seen.
    learned = fit._views[1]._learned[0] * CALIBRATION
    mended = rigid_transform(rotation_from_vector(learned[:3]), learned[3:]) @ told
    tips = really.instruments[0].skeleton_cam(truth).reshape(-1, 3)
    there, said, then = (SIDE.project(tips @ T[:3, :3].T + T[:3, 3]) for T in (from_the_side(), told, mended))
    assert np.linalg.norm(said - there, axis=1).min() > 4
    assert np.linalg.norm(then - there, axis=1).max() < 1
