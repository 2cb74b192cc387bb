"""Where one tip hides, the other still says something."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support import observe, resting_state, scene_of

from surgbench.camera import Camera
from surgbench.contract import Observation, Scene
from surgbench.geometry import FloatArray
from surgbench.objective import KeypointTerm, LossWeights, Objective
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.state import STATE_SCALE
from surgbench.trackers.registration.fit import ContourFit, FitConfig, Prior
from surgbench.trackers.registration.view_fit import _offsets

PROJECTED = np.array([[80.0, 60.0], [100.0, 60.0]])
EQ_8 = KeypointTerm(10.0)


@pytest.mark.parametrize(("seen", "expected"), [([80.0, 75.0], 5.0), ([100.0, 39.0], 11.0), ([97.0, 60.0], 0.0)])
def test_the_nearer_tip_counts_beyond_the_tolerance(seen: list[float], expected: float) -> None:
    assert EQ_8.loss(np.array([seen]), PROJECTED) == pytest.approx(expected)


def test_a_tip_behind_the_camera_is_infinitely_far() -> None:
    behind = np.array([PROJECTED, [[np.nan, np.nan], [100.0, 60.0]]])
    np.testing.assert_array_equal(EQ_8.loss(PROJECTED[:1], behind), [0.0, np.inf])
    np.testing.assert_array_equal(EQ_8.slope(PROJECTED[:1] + 30.0, behind)[1], 0.0)


def test_the_slope_is_the_derivative_of_the_loss() -> None:
    seen, step = np.array([[85.0, 90.0]]), 1e-6
    slope = EQ_8.slope(seen, PROJECTED)
    for index in np.ndindex(2, 2):
        ahead, behind = PROJECTED.copy(), PROJECTED.copy()
        ahead[index] += step
        behind[index] -= step
        rise = EQ_8.loss(seen, ahead) - EQ_8.loss(seen, behind)
        assert slope[index] == pytest.approx(rise / (2 * step), abs=1e-6)


def one_tip(camera: Camera, state: FloatArray, shift_px: list[float], index: int = 0) -> tuple[Scene, Observation]:
    """A frame of which a mask is empty and one tip is seen beside where ``state`` has it."""
    scene = scene_of(camera)
    frame = observe(scene, state)
    seen = camera.project(scene.instruments[0].tips_cam(state))[index] + shift_px
    return scene, replace(
        frame, views=(replace(frame.views[0], mask=np.zeros_like(frame.mask), keypoints=(seen[None],)),)
    )


def test_the_loss_counts_a_single_tip_if_told_to(camera: Camera) -> None:
    state = resting_state()
    scene, frame = one_tip(camera, state, [0.0, 30.0])
    losses = {}
    for single in (False, True):
        objective = Objective(scene, LossWeights(single_tips=single))
        objective.observe(frame)
        losses[single] = objective(state[None])[0][0]
    assert losses[True] - losses[False] == pytest.approx(5e-4 * camera.width * camera.height * 20.0, rel=1e-3)


@pytest.mark.parametrize("index", [0, 1])
def test_a_fit_moves_the_tip_that_was_seen(camera: Camera, index: int) -> None:
    state = resting_state()
    scene, frame = one_tip(camera, state, [2.0, 3.0], index)
    (seen,) = frame.views[0].tips
    assert seen is not None
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    prior = Prior(state, np.eye(9) * 1e-3)

    def left_px(**options: Any) -> float:
        fit = ContourFit(scene, evaluator, STATE_SCALE, FitConfig(**options))(state, frame, prior)
        return float(np.linalg.norm(camera.project(scene.instruments[0].tips_cam(fit.state))[index] - seen[0]))

    assert left_px() < 0.3
    assert left_px(single_tips=False) == pytest.approx(np.hypot(2.0, 3.0))


def test_a_single_tip_is_either_of_two_that_lie_together_and_else_the_nearer() -> None:
    together, apart = np.array([[80.0, 60.0], [80.0, 60.0]]), np.array([[80.0, 60.0], [180.0, 60.0]])
    np.testing.assert_allclose(_offsets(np.array([[83.0, 60.0]]), together, 9.0)[1], [0.5, 0.5])
    off, share = _offsets(np.array([[83.0, 60.0]]), apart, 9.0)
    np.testing.assert_allclose(off[0], [3.0, 0.0])
    np.testing.assert_allclose(share, [1.0, 0.0], atol=1e-12)


def test_two_tips_count_in_full() -> None:
    off, share = _offsets(PROJECTED[::-1] + 1.0, PROJECTED, 9.0)
    np.testing.assert_array_equal(off, np.ones((2, 2)))
    np.testing.assert_array_equal(share, [1.0, 1.0])
