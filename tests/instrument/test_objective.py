"""The loss of eq. 5, 6 and 8, worked out by hand on small cases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import observe, resting_state, scene_of

from surgbench.camera import Camera
from surgbench.objective import KeypointTerm, LossWeights, Objective
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.state import STATE_SCALE

OBSERVED = np.array([[100.0, 50.0], [110.0, 50.0]])
EQ_8 = KeypointTerm(10.0)
RELEASED = KeypointTerm(10.0, "released")


def test_keypoints_within_the_tolerance_cost_nothing() -> None:
    assert EQ_8.loss(OBSERVED, OBSERVED[None] + 5.0)[0] == 0.0


def test_keypoint_loss_is_eq_8() -> None:
    """Both tips and their centre 30 px away, 10 px free: three times 20."""
    projected = OBSERVED + np.array([18.0, 24.0])
    assert EQ_8.loss(OBSERVED, projected) == pytest.approx(60.0)


def test_the_released_loss_takes_tau_off_the_sum_of_both_tips() -> None:
    """18 and 24 px away are 42 in L1: both tips 84, less 10; their centre 42, less 10."""
    projected = OBSERVED + np.array([18.0, 24.0])
    assert RELEASED.loss(OBSERVED, projected) == pytest.approx(74.0 + 32.0)
    # One tip 9 px off costs nothing yet, two do: 18 - 10.
    assert RELEASED.loss(OBSERVED, OBSERVED + np.array([[9.0, 0.0], [0.0, 0.0]])) == 0.0
    assert RELEASED.loss(OBSERVED, OBSERVED + np.array([9.0, 0.0])) == pytest.approx(8.0)


def test_the_better_assignment_counts() -> None:
    for form in (KeypointTerm(0.0), KeypointTerm(0.0, "released")):
        assert form.loss(OBSERVED, OBSERVED[::-1]) == 0.0


def test_the_released_loss_is_that_of_the_released_code_at_any_resolution() -> None:
    """``6 MSE + 6e-6 |difference of areas| + 3e-3 L_kpts`` of pictures of 350 x 246, times N / 6, N the pixels."""
    # The paper's camera at its rendering's size, and twice that; the tips are off by (9, 8) of the small pixels.
    for factor in (1, 2):
        pixels = factor**2 * 350 * 246
        camera = Camera(
            width=factor * 350, height=factor * 246, fx=factor * 450, fy=factor * 450, cx=factor * 175, cy=factor * 123
        )
        scene = scene_of(camera)
        states = np.stack([resting_state(), resting_state(0.15)])
        observation = observe(scene, states[0])
        tips = camera.project(scene.instruments[0].tips_cam(states[0])) + factor * np.array([9.0, 8.0])
        observation = replace(observation, views=(replace(observation.views[0], keypoints=(tips,)),))
        objective = Objective(scene, LossWeights(keypoint_form="released"))
        objective.observe(observation)
        difference = objective.evaluator.mask(states[1]).astype(int) - observation.mask.astype(int)
        keypoints = 2 * 17.0 - 10.0 + 17.0 - 10.0
        # Areas are those of the small pictures, of which each pixel is factor² pixels here.
        released = 6 * (difference**2).mean() + 6e-6 * abs(difference.sum()) / factor**2
        assert objective(states[:1])[0][0] == pytest.approx(3e-3 * keypoints * pixels / 6)
        masks_alone = objective.mismatch(states[1:])[0][0]
        assert masks_alone == pytest.approx(released * pixels / 6, rel=1e-3)


def test_a_tip_behind_the_camera_is_infinitely_bad() -> None:
    for form in (EQ_8, RELEASED):
        assert form.loss(OBSERVED, np.full((2, 2), np.nan)) == np.inf


def test_rendering_loss_is_eq_6(small_camera: Camera) -> None:
    scene = scene_of(small_camera)
    evaluator = SilhouetteEvaluator(scene.instruments, small_camera)
    target, other = resting_state(), resting_state(0.15)
    S, M = evaluator.mask(other), evaluator.mask(target)
    objective = Objective(scene, LossWeights(appearance=0.25, keypoints=0.0))
    objective.observe(observe(scene, target))
    losses, overlaps = objective(np.stack([target, other]))
    squared = np.sum((S.astype(int) - M.astype(int)) ** 2)
    appearance = abs(int(S.sum()) - int(M.sum()))
    assert losses[0] == 0.0
    assert losses[1] == pytest.approx(squared + 0.25 * appearance)
    assert overlaps[1] == pytest.approx((S & M).sum() / (S | M).sum())


def test_keypoints_weigh_where_they_are_seen(small_camera: Camera) -> None:
    scene = scene_of(small_camera)
    state = resting_state()
    observation = observe(scene, state)
    far = replace(observation, views=(replace(observation.views[0], keypoints=(np.zeros((2, 2)),)),))
    weights = LossWeights(keypoint_tolerance_px=2.0)
    objective = Objective(scene, weights)
    objective.observe(far)
    tips = small_camera.project(scene.instruments[0].tips_cam(state))
    pixels = small_camera.width * small_camera.height
    expected = weights.keypoints * pixels * KeypointTerm(2.0).loss(np.zeros((2, 2)), tips)
    assert objective(state[None])[0][0] == pytest.approx(float(expected))
    assert expected > 0


def test_scoring_before_a_frame_is_an_error(small_camera: Camera) -> None:
    with pytest.raises(RuntimeError, match="observe a frame"):
        Objective(scene_of(small_camera), LossWeights())(resting_state()[None])


@pytest.mark.parametrize("term", [EQ_8, RELEASED])
@pytest.mark.parametrize("observed_px", [[[300.0, 200.0], [340.0, 215.0]], [[340.0, 215.0], [300.0, 200.0]]])
def test_slope_of_the_keypoint_loss_is_its_derivative(observed_px: list[list[float]], term: KeypointTerm) -> None:
    """In either order of the tips, with one tip within the tolerance (no slope) and one behind the camera."""
    observed = np.array(observed_px)
    rng = np.random.default_rng(3)
    projected = np.array([[310.0, 190.0], [360.0, 230.0]]) + rng.normal(0, 8, (20, 2, 2))
    slope = term.slope(observed, projected)
    for index in np.ndindex(2, 2):
        step = np.zeros((2, 2))
        step[index] = 1e-6
        up, down = (term.loss(observed, projected + sign * step) for sign in (1, -1))
        assert slope[(slice(None), *index)] == pytest.approx((up - down) / 2e-6, abs=1e-5)
    projected[0, 1] = np.nan
    assert np.isfinite(term.slope(observed, projected)).all()


def test_gradient_predicts_the_change_of_the_whole_loss(camera: Camera) -> None:
    """A step of 0.2 natural steps downhill changes the loss by what the gradient says; tips 25 px off weigh in."""
    scene = scene_of(camera)
    state = resting_state()
    observation = observe(scene, state)
    tips = camera.project(scene.instruments[0].tips_cam(state)) + np.array([15.0, 20.0])
    observation = replace(observation, views=(replace(observation.views[0], keypoints=(tips,)),))
    objective = Objective(scene, LossWeights())
    objective.observe(observation)
    states = state + np.random.default_rng(1).standard_normal((12, 9)) * STATE_SCALE
    gradient = objective.gradient(states) * STATE_SCALE
    before, _ = objective(states)
    downhill = -0.2 * gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    after, _ = objective(states + STATE_SCALE * downhill)
    assert (after < before).all()
    assert np.median((after - before) / np.sum(downhill * gradient, axis=1)) == pytest.approx(1.0, abs=0.1)


def test_a_gradient_before_a_frame_is_an_error(small_camera: Camera) -> None:
    with pytest.raises(RuntimeError, match="observe a frame"):
        Objective(scene_of(small_camera), LossWeights()).gradient(resting_state()[None])
