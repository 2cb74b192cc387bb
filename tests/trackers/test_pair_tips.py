"""Whose tips are whose: of arms that touch, have crossed, or are named wrongly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import observe, resting_state, scene_of

from surgbench.camera import Camera
from surgbench.contract import Mask, Observation, Scene
from surgbench.geometry import FloatArray
from surgbench.silhouette import VisibilityEvaluator
from surgbench.state import split_arms
from surgbench.trackers.arm_masks import mask_per_arm
from surgbench.trackers.keypoints.pairs import ArmTips, assigned, turned
from surgbench.trackers.keypoints.resnet18 import ResNet18Keypoints

NEARLY = np.tile([0.01, 0.05, 0.01, 1e-3, -1e-3, 1e-3, 0.05, 0.05, 0.02], 2)


def arms_at(left_x_m: float, right_x_m: float) -> FloatArray:
    """The left arm's shaft comes from the left, the right one's from the right; both wrists at the same height."""
    left, right = resting_state(), resting_state(0.15)
    left[[2, 3]], right[[2, 3, 4]] = [0.8, left_x_m], [-0.8, right_x_m, 0.008]
    return np.concatenate([left, right])


def tips_of(scene: Scene, state: FloatArray) -> list[FloatArray]:
    camera = scene.views[0].camera
    return [camera.project(one.tips_cam(own)) for one, own in zip(scene.instruments, split_arms(state), strict=True)]


class Known:
    """Finds the true tips of the arm that a mask shows most of."""

    def __init__(self, scene: Scene, state: FloatArray) -> None:
        self.alone = VisibilityEvaluator(scene.instruments, scene.views[0].camera).silhouettes(state)
        self.tips = tips_of(scene, state)
        self.overlaps: list[float] = []

    def __call__(self, mask: Mask) -> FloatArray | None:
        overlaps = [float((mask & one).sum() / (mask | one).sum()) for one in self.alone]
        self.overlaps.append(max(overlaps))
        return self.tips[int(np.argmax(overlaps))] if mask.any() else None


def frame_of(scene: Scene, state: FloatArray, start: FloatArray) -> Observation:
    return replace(observe(scene, state), start=start)


def test_arms_that_touch_are_parted_where_the_search_begins(camera: Camera) -> None:
    scene, state = scene_of(camera, arms=2), arms_at(-0.004, 0.004)
    frame = frame_of(scene, state, state + NEARLY)
    assert mask_per_arm(frame.views[0], 2) is None
    known, source = Known(scene, state), ArmTips(scene)
    found = source.find(frame, frame.views[0], known)
    assert min(known.overlaps) > 0.8
    for own, expected in zip(found, tips_of(scene, state), strict=True):
        assert own is not None
        np.testing.assert_array_equal(np.sort(own, axis=0), np.sort(expected, axis=0))
    unknown = replace(frame, start=np.zeros(18))
    assert source.find(unknown, frame.views[0], known) == (None, None)


def test_one_mask_given_for_both_arms_is_no_mask_of_either(camera: Camera) -> None:
    """Else both arms had the tips of the one that it shows."""
    scene, state = scene_of(camera, arms=2), arms_at(-0.004, 0.004)
    frame = frame_of(scene, state, state + NEARLY)
    known, source = Known(scene, state), ArmTips(scene)
    for mask in (frame.views[0].mask, known.alone[0]):
        view = replace(frame.views[0], instance_masks=(mask, mask))
        found = source.find(replace(frame, views=(view,)), view, known)
        for own, expected in zip(found, tips_of(scene, state), strict=True):
            assert own is not None
            np.testing.assert_array_equal(np.sort(own, axis=0), np.sort(expected, axis=0))


def test_arms_that_have_crossed_keep_their_tips(camera: Camera) -> None:
    """In two parts again, the left arm on the right: by their order alone they would be exchanged."""
    scene = scene_of(camera, arms=2)
    state = split_arms(arms_at(-0.025, 0.03))[::-1].ravel()
    frame = frame_of(scene, state, state + NEARLY)
    assert mask_per_arm(frame.views[0], 2) is not None
    known, source = Known(scene, state), ArmTips(scene)
    for start, order in ((state + NEARLY, [0, 1]), (np.zeros(18), [1, 0])):
        found = source.find(replace(frame, start=start), frame.views[0], known)
        for own, arm in zip(found, order, strict=True):
            assert own is known.tips[arm]


@pytest.mark.parametrize("swap", [False, True])
def test_masks_under_the_other_arms_name(camera: Camera, swap: bool) -> None:
    scene, state = scene_of(camera, arms=2), arms_at(-0.004, 0.004)
    frame = frame_of(scene, state, state + NEARLY)
    visible = tuple(VisibilityEvaluator(scene.instruments, camera).visible_masks(state))
    view = replace(frame.views[0], instance_masks=visible[::-1] if swap else visible)
    known = Known(scene, state)
    found = ArmTips(scene).find(replace(frame, views=(view,)), view, known)
    assert all(own is expected for own, expected in zip(found, known.tips, strict=True))


def test_four_tips_go_where_the_ways_are_shortest_in_sum() -> None:
    """Tips that were found in the other arm's part, twice, alone, or nowhere near any arm."""
    predicted = np.array([[[100.0, 100.0], [110.0, 100.0]], [[200.0, 100.0], [200.0, 120.0]]])
    left, right = predicted + 3.0
    mixed = (np.stack([left[0], right[1]]), np.stack([right[0], left[1]]))
    for found in ((left, right), (right, left), mixed):
        own = assigned(found, predicted, 50.0)
        for tips, expected in zip(own, (left, right), strict=True):
            assert tips is not None
            assert sorted(tips.tolist()) == sorted(expected.tolist())
    twice = assigned((left, left + 1.0), predicted, 50.0)
    assert twice[0] is not None
    assert len(twice[0]) == 2
    assert twice[1] is None
    far = assigned((left[:1], np.array([[400.0, 300.0], [203.0, 103.0]])), predicted, 50.0)
    assert [None if tips is None else tips.tolist() for tips in far] == [[[103.0, 103.0]], [[203.0, 103.0]]]
    assert assigned((None, None), predicted, 50.0) == (None, None)


def test_named_tips_are_exchanged_only_if_that_is_far_nearer() -> None:
    predicted = np.array([[[100.0, 100.0], [110.0, 100.0]], [[140.0, 100.0], [150.0, 100.0]]])
    a, b = np.array([[122.0, 100.0], [130.0, 100.0]]), np.array([[118.0, 100.0], [128.0, 100.0]])
    assert turned((a, b), predicted, 1.0)[0] is b
    assert turned((a, b), predicted, 0.5)[0] is a
    assert turned((predicted[1], None), predicted, 0.5)[0] is None


@pytest.mark.torch
@pytest.mark.slow
def test_the_network_finds_the_tips_of_crossing_arms(camera: Camera) -> None:
    """In one mask, at eleven places on the way across each other; what it says of an arm is that arm's."""
    scene, source = scene_of(camera, arms=2), ResNet18Keypoints()
    source.reset(scene)
    said, right = 0, 0
    for shift in np.linspace(-0.01, 0.01, 11):
        state = arms_at(shift - 0.004, 0.004 - shift)
        frame = frame_of(scene, state, state + 0.5 * NEARLY)
        for found, true in zip(source.detect(frame, frame.views[0]), tips_of(scene, state), strict=True):
            for tip in () if found is None else found:
                said += 1
                right += bool(np.linalg.norm(tip - true, axis=1).min() < 8)
    assert said >= 22  # of 44, some of which are hidden
    assert right >= 0.9 * said
