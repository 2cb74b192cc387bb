"""What of a mask of all instruments a tracker of one arm is given."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from support import resting_state, scene_of

from surgbench.camera import Camera
from surgbench.contract import Mask, Observation, Scene
from surgbench.generators.place import Place
from surgbench.generators.presets import Workspace
from surgbench.geometry import FloatArray, rigid_transform
from surgbench.instrument import load_instrument
from surgbench.mask_sources import Prompts
from surgbench.silhouette import SilhouetteEvaluator, VisibilityEvaluator
from surgbench.state import STATE_SCALE
from surgbench.trackers.masks.own_arms import OwnArms

CAMERA = Camera(width=700, height=493, fx=905.955, fy=904.820, cx=294.280, cy=238.699)
LEAST_PX = 4000  # of each arm in the picture
BAR_PX = 60


@cache
def scene() -> Scene:
    return scene_of(CAMERA)


@cache
def visibility() -> VisibilityEvaluator:
    return VisibilityEvaluator([load_instrument("large_needle_driver")] * 2, CAMERA)


@cache
def places() -> list[Place]:
    instrument = load_instrument("large_needle_driver")
    return [Place(arm, Workspace(), CAMERA, instrument) for arm in ("left", "right")]


def frame(start: FloatArray | None = None) -> Observation:
    return Observation(0, 0.0, scene().views, np.zeros(9) if start is None else start)


def picked(mask: Mask, start: FloatArray | None, arms: OwnArms | None = None) -> Mask:
    """What is picked, which is never more than there is."""
    arms = arms or OwnArms(scene(), scene().views[0])
    own: Mask = arms.pick(mask, frame(start), scene().views[0])
    assert own.shape == mask.shape
    assert not (own & ~mask).any()
    return own


def iou(one: Mask, other: Mask) -> float:
    return float((one & other).sum() / (one | other).sum())


def touch(one: Mask, other: Mask) -> bool:
    return bool((cv2.dilate(one.astype(np.uint8), np.ones((5, 5))) > 0)[other].any())


def bars(*rows: int) -> Mask:
    """Level bars across the left half of the picture."""
    mask = np.zeros((CAMERA.height, CAMERA.width), bool)
    for row in rows:
        mask[row : row + BAR_PX, : CAMERA.width // 2] = True
    return mask


@given(seed=st.integers(0, 10**6))
@settings(max_examples=30)
def test_an_arm_is_picked_whole_and_alone_where_it_is_clear_of_the_other(seed: int) -> None:
    rng = np.random.default_rng(seed)
    states = np.concatenate([place.draw(1, rng)[0] for place in places()])
    alone = visibility().silhouettes(states)
    assume(alone.sum((1, 2)).min() >= LEAST_PX)
    drift = 0.3 * STATE_SCALE * rng.normal(size=9)
    for own, state, seen in zip(alone, states.reshape(2, 9), visibility().visible_masks(states), strict=True):
        if not touch(*alone):
            assert iou(picked(np.any(alone, axis=0), state + drift), own) >= 0.9
        elif seen.sum() >= LEAST_PX:  # nothing of it is lost to the other where the prediction is right
            assert (picked(np.any(alone, axis=0), state) & seen).sum() >= 0.98 * seen.sum()


def test_of_arms_that_cross_the_other_is_cut_off() -> None:
    """In the mean over many pairs: what is picked is the arm, and not the pair."""
    rng, found, whole = np.random.default_rng(3), [], []
    for states in np.concatenate([place.draw(150, rng) for place in places()], axis=1):
        alone = visibility().silhouettes(states)
        if alone.sum((1, 2)).min() < 3 * LEAST_PX or not touch(*alone):
            continue
        for own, state in zip(alone, states.reshape(2, 9), strict=True):
            found.append(iou(picked(np.any(alone, axis=0), state + 0.3 * STATE_SCALE * rng.normal(size=9)), own))
            whole.append(iou(np.any(alone, axis=0), own))
    assert len(found) >= 20
    assert np.mean(found) >= 0.85
    assert np.mean(found) >= np.mean(whole) + 0.3


def test_a_pair_keeps_everything() -> None:
    pair = scene_of(CAMERA, arms=2)
    mask = bars(50, 300)
    assert OwnArms(pair, pair.views[0]).pick(mask, frame(np.zeros(18)), pair.views[0]) is mask


def test_without_an_estimate_or_prompts_everything_stays() -> None:
    mask = bars(50, 300)
    np.testing.assert_array_equal(picked(mask, None), mask)
    assert not picked(np.zeros_like(mask), None).any()


@pytest.mark.parametrize("on", ["inside", "outside", "both", "beside"])
def test_points_say_which_arm_is_meant(on: str) -> None:
    mask = bars(50, 300)
    points = {"inside": [[90, 70]], "outside": [[90, 330]], "both": [[90, 70], [90, 330]], "beside": [[90, 20]]}[on]
    inside = {"inside": [True], "outside": [False], "both": [True, False], "beside": [True]}[on]
    prompts = Prompts([np.array(points, float)], [np.array(inside)])
    arms = OwnArms(scene(), scene().views[0], prompts)
    np.testing.assert_array_equal(picked(mask, None, arms), bars(50))
    moved = picked(np.roll(mask, 5, axis=0), None, arms)  # and what was picked says it in the frames to come
    np.testing.assert_array_equal(moved, np.roll(bars(50), 5, axis=0))


def test_points_of_both_kinds_on_one_part_divide_it() -> None:
    mask = np.ones((CAMERA.height, CAMERA.width), bool)
    prompts = Prompts([np.array([[100.0, 200], [600, 200]])], [np.array([True, False])])
    own = picked(mask, None, OwnArms(scene(), scene().views[0], prompts))
    assert own[:, :345].all()
    assert not own[:, 355:].any()


def test_a_lost_arm_is_looked_for_where_it_was_and_on_its_side() -> None:
    """The predicted silhouette meets nothing: not the nearer bar from the right, but that from the left."""
    state = resting_state()
    own = SilhouetteEvaluator(scene().instruments, CAMERA).mask(state)
    arms = OwnArms(scene(), scene().views[0])
    np.testing.assert_array_equal(picked(own, state, arms), own)
    side = np.zeros_like(own)
    rows = np.flatnonzero(own.any(1))
    assert own[:, 0].any() != own[:, -1].any()
    below, above = slice(rows[-1] + 60, rows[-1] + 110), slice(rows[-1] + 20, rows[-1] + 50)
    side[below, : CAMERA.width // 3] = True
    other = np.zeros_like(own)
    other[above, CAMERA.width // 2 :] = True
    if own[:, -1].any():
        side, other = side[:, ::-1], other[:, ::-1]
    assert not ((side | other) & own).any()
    np.testing.assert_array_equal(picked(side | other, state, arms), side)


def test_an_arm_that_is_predicted_outside_the_picture_is_not_the_other_one() -> None:
    away = resting_state()
    away[3] = 5.0
    assert not picked(bars(50), away).any()


def test_states_are_taken_into_the_view() -> None:
    """A camera that stands to the side sees the arm elsewhere, and it is picked there."""
    T_view_cam = rigid_transform(np.eye(3), np.array([0.02, 0.005, 0.0]))
    view = replace(scene().views[0], T_view_cam=T_view_cam)
    state, moved = resting_state(), resting_state()
    moved[3:6] += T_view_cam[:3, 3]
    evaluator = SilhouetteEvaluator(scene().instruments, CAMERA)
    arms = OwnArms(scene(), view)
    np.testing.assert_array_equal(arms.predicted(frame(state)), evaluator.mask(moved))
    assert arms.predicted(frame()) is None
    assert arms.predicted(frame(np.full(9, np.nan))) is None
