"""Keypoint source ``corners``, and the parts of a mask that are an arm's, on drawn masks."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from support import observe, resting_state, scene_of

from surgbench.camera import Camera
from surgbench.contract import Mask, View
from surgbench.geometry import FloatArray
from surgbench.trackers.arm_masks import mask_per_arm
from surgbench.trackers.keypoints.corners import CornersKeypoints

SIZE = (240, 320)


def wedge(tip: tuple[int, int], base_x: int, half_width: int = 30) -> Mask:
    """A triangle with one sharp corner; the two others lie outside the picture or are blunt by being cut."""
    image = np.zeros(SIZE, dtype=np.uint8)
    corners = np.array([[base_x, tip[1] - half_width], [base_x, tip[1] + half_width], tip], dtype=np.int32)
    cv2.fillPoly(image, [corners], 1)
    return image.astype(bool)


def jaws(tips: tuple[tuple[int, int], tuple[int, int]]) -> Mask:
    """A body from the left edge that ends in two sharp tips with a blunt notch between them."""
    image = np.zeros(SIZE, dtype=np.uint8)
    cv2.fillPoly(image, [np.array([(0, 80), (0, 160), tips[1], (190, 120), tips[0]], dtype=np.int32)], 1)
    return image.astype(bool)


def view_of(mask: Mask, arms: int = 1, instance_masks: tuple[Mask, ...] | None = None) -> View:
    camera = Camera(width=SIZE[1], height=SIZE[0], fx=400.0, fy=400.0, cx=160.0, cy=120.0)
    return View(camera, np.eye(4), mask, instance_masks, keypoints=(None,) * arms)


def detect(view: View, small_camera: Camera) -> tuple[FloatArray | None, ...]:
    source, arms = CornersKeypoints(), len(view.keypoints)
    scene = scene_of(small_camera, arms)
    source.reset(scene)
    frame = observe(scene, np.tile(resting_state(), arms))
    observation = replace(frame, views=(view,), start=np.zeros_like(frame.start))  # nothing is known yet
    found: tuple[FloatArray | None, ...] = source.detect(observation, view)
    return found


def test_corners_of_jaws_are_their_tips(small_camera: Camera) -> None:
    tips = ((200, 60), (205, 180))
    (found,) = detect(view_of(jaws(tips)), small_camera)
    assert found is not None
    ordered = found[np.argsort(found[:, 1])]
    assert np.linalg.norm(ordered - np.array(tips), axis=1).max() < 12  # of a block of 15 pixels


@pytest.mark.parametrize("fill", [False, True])
def test_a_mask_without_corners_has_none(small_camera: Camera, fill: bool) -> None:
    assert detect(view_of(np.full(SIZE, fill)), small_camera) == (None,)


def test_corners_do_not_look_at_the_tips_of_the_dataset(small_camera: Camera) -> None:
    view = view_of(jaws(((200, 60), (205, 180))))
    marked = replace(view, keypoints=(np.array([[10.0, 10.0], [20.0, 20.0]]),))
    np.testing.assert_array_equal(detect(view, small_camera)[0], detect(marked, small_camera)[0])


@pytest.mark.slow
def test_each_arm_has_the_corners_of_its_part(small_camera: Camera) -> None:
    left, right = wedge((120, 60), 40), wedge((200, 170), 290)
    mask = left | right
    mask[5:8, 300:303] = True  # a speck of corruption is no arm
    for view in (view_of(mask, 2), view_of(left | right, 2, instance_masks=(left, right))):
        found = detect(view, small_camera)
        for corners, alone in zip(found, (left, right), strict=True):
            expected = detect(view_of(alone), small_camera)[0]
            assert corners is not None
            np.testing.assert_array_equal(corners, expected)


def test_arms_that_touch_have_no_corners_unless_there_are_instance_masks(small_camera: Camera) -> None:
    left, right = wedge((170, 100), 40), wedge((150, 100), 290)
    both = left | right
    both[5:8, 300:303] = True
    assert detect(view_of(both, 2), small_camera) == (None, None)
    told = detect(view_of(both, 2, instance_masks=(left, right)), small_camera)
    assert all(corners is not None for corners in told)


def test_parts_of_two_arms_are_ordered_from_left_to_right() -> None:
    left, right = wedge((120, 60), 40, 20), wedge((200, 170), 290, 40)  # the right one is larger
    parts = mask_per_arm(view_of(left | right, 2), 2)
    assert parts is not None
    np.testing.assert_array_equal(parts[0], left)
    np.testing.assert_array_equal(parts[1], right)
    assert mask_per_arm(view_of(left, 2), 2) is None
