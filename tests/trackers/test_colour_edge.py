"""Masks by colour and edges, of painted pictures."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support import resting_state, scene_of

from surgbench.camera import Camera
from surgbench.contract import Mask, Observation, Scene
from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray
from surgbench.mask_sources import FoundMasks, Prompts
from surgbench.registry import create, find
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.trackers.masks.colour_edge import ColourEdgeMasks

Image = NDArray[np.uint8]
CAMERA = Camera(width=640, height=480, fx=800.0, fy=800.0, cx=320.0, cy=240.0)
TISSUE, DRAPE = (150, 60, 50), (40, 110, 120)
GREY = (75, 78, 80)
BAR_PX = 60.0


def background(seed: int = 0, colour: tuple[int, int, int] = TISSUE) -> Image:
    """A coloured plane with a coarse texture, darker to the corners, and noise."""
    rng = np.random.default_rng(seed)
    coarse = cv2.resize(rng.uniform(0.7, 1.3, (24, 32)), (640, 480), interpolation=cv2.INTER_CUBIC)
    v, u = np.mgrid[:480, :640]
    light = coarse * (1.1 - 0.5 * np.hypot(u - 320, v - 240) / 400)
    return noisy(light[..., None] * np.array(colour), rng)


def noisy(picture: FloatArray, rng: np.random.Generator) -> Image:
    return np.clip(picture + rng.normal(0, 6, picture.shape), 0, 255).astype(np.uint8)


def bar(angle_rad: float, shift_px: float = 0.0) -> Mask:
    """A bar from the border of the picture to its middle."""
    v, u = np.mgrid[:480, :640]
    along = (u - 320) * np.cos(angle_rad) + (v - 240) * np.sin(angle_rad)
    across = (v - 240) * np.cos(angle_rad) - (u - 320) * np.sin(angle_rad) - shift_px
    return np.asarray((along > 0) & (np.abs(across) < BAR_PX / 2))


def painted(mask: Mask, picture: Image, seed: int = 1) -> Image:
    """Grey where the mask is."""
    rng = np.random.default_rng(seed)
    shown = picture.copy()
    shown[mask] = noisy(np.array(GREY, float) * rng.uniform(0.9, 1.1, (mask.sum(), 1)), rng)
    return shown


def start(arms: int = 1, prompts: Prompts | None = None) -> tuple[ColourEdgeMasks, Scene]:
    source, scene = ColourEdgeMasks(), scene_of(CAMERA, arms)
    source.reset(scene, scene.views[0], prompts)
    return source, scene


def segment(source: ColourEdgeMasks, scene: Scene, image: Image | None, state: FloatArray | None = None) -> FoundMasks:
    view = replace(scene.views[0], image=lambda: image)
    begin = np.zeros(9 * scene.arms) if state is None else state
    found: FoundMasks = source.segment(Observation(3, 0.1, (view,), begin), view)
    return found


def found(image: Image | None, state: FloatArray | None = None) -> Mask:
    return segment(*start(), image, state).mask


def iou(one: Mask, other: Mask) -> float:
    return float((one & other).sum() / (one | other).sum())


@pytest.mark.slow
@given(
    angle_rad=st.floats(0, 2 * np.pi),
    shift_px=st.floats(-80, 80),
    colour=st.sampled_from([TISSUE, DRAPE]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=25)
def test_a_grey_bar_is_found_before_tissue_and_drape(
    angle_rad: float, shift_px: float, colour: tuple[int, int, int], seed: int
) -> None:
    truth = bar(angle_rad, shift_px)
    assert iou(found(painted(truth, background(seed, colour))), truth) >= 0.95


@given(colour=st.sampled_from([TISSUE, DRAPE, (200, 60, 150)]), seed=st.integers(0, 1000))
@settings(max_examples=10)
def test_nothing_is_found_where_there_is_none(colour: tuple[int, int, int], seed: int) -> None:
    result = segment(*start(), background(seed, colour))
    assert result.mask.mean() < 0.005
    assert result.confidence == 0.0 or result.mask.any()


def test_a_picture_of_one_colour_holds_nothing() -> None:
    for level in (0, 128, 255):
        assert not found(np.full((480, 640, 3), level, np.uint8)).any()


def test_highlights_are_no_instruments() -> None:
    truth, rng = bar(0.4), np.random.default_rng(5)
    image = background()
    shines = np.zeros((480, 640), np.uint8)
    for u, v in rng.uniform((20, 20), (620, 460), (60, 2)):
        axes = (int(rng.integers(2, 9)), int(rng.integers(2, 5)))
        cv2.ellipse(shines, (int(u), int(v)), axes, float(rng.uniform(0, 180)), 0, 360, 1, -1)
    image[shines > 0] = (235, 232, 230)
    mask = found(painted(truth, image))
    assert iou(mask, truth) >= 0.93
    assert (mask & (shines > 0) & ~truth).sum() < 0.1 * ((shines > 0) & ~truth).sum()


def test_painted_markers_leave_no_holes() -> None:
    truth = bar(0.0)
    image = painted(truth, background())
    for u, colour in ((360, (30, 170, 60)), (430, (200, 30, 180)), (500, (220, 210, 30))):
        cv2.circle(image, (u, 240), 11, colour, -1)
    mask = found(image)
    assert iou(mask, truth) >= 0.95
    assert mask[240, [360, 430, 500]].all()


@pytest.mark.parametrize("drift_px", [-20.0, 20.0])
def test_a_drifted_prediction_does_not_pull_the_mask_along(drift_px: float) -> None:
    state = resting_state()
    truth = SilhouetteEvaluator(scene_of(CAMERA).instruments, CAMERA).mask(state)
    image = painted(truth, background())
    drifted = state.copy()
    drifted[4] += drift_px / CAMERA.fy * state[5]
    masks = [found(image, one) for one in (state, drifted)]
    assert iou(masks[0], truth) >= 0.93
    np.testing.assert_array_equal(masks[1], masks[0])


def test_of_two_instruments_the_predicted_one_is_taken_and_a_pair_takes_both() -> None:
    state = resting_state()
    truth = SilhouetteEvaluator(scene_of(CAMERA).instruments, CAMERA).mask(state)
    other = np.zeros_like(truth)
    other[400:440, 320:] = True
    other &= ~(cv2.dilate(truth.astype(np.uint8), np.ones((25, 25), np.uint8)) > 0)
    image = painted(truth | other, background())
    assert iou(found(image, state), truth) >= 0.93
    assert iou(segment(*start(arms=2), image).mask, truth | other) >= 0.93
    v, u = np.argwhere(other).mean(0)
    prompts = Prompts([np.array([[u, v]])], [np.array([True])])
    assert iou(segment(*start(prompts=prompts), image).mask, other) >= 0.93


def test_what_is_cut_off_from_the_border_stays_where_it_was_before() -> None:
    """Something red lies over the shaft where it comes in: what shows is known from the frame before."""
    whole = bar(0.0)
    part = whole.copy()
    part[:, 560:] = False
    source, scene = start()
    first = segment(source, scene, painted(whole, background())).mask
    assert iou(first, whole) >= 0.95
    assert iou(segment(source, scene, painted(part, background())).mask, part) >= 0.93
    assert found(painted(part, background())).mean() < 0.005


def test_confidence_is_that_of_the_colours() -> None:
    sure = segment(*start(), painted(bar(0.3), background()))
    assert 0.8 < sure.confidence <= 1.0


@pytest.mark.parametrize(
    ("image", "problem"),
    [
        (None, "frame 3 has no image"),
        (np.zeros((240, 320, 3), np.uint8), "the image is 320 x 240 pixels, not 640 x 480"),
        (np.zeros((480, 640), np.uint8), "the image has no three colours"),
    ],
)
def test_an_image_that_will_not_do_is_one_line(image: Image | None, problem: str) -> None:
    with pytest.raises(DatasetError, match=problem) as error:
        found(image)
    assert "\n" not in str(error.value)


def test_it_is_registered_and_takes_its_options() -> None:
    source = create(find("mask_source", "colour-edge"), {"width_px": 128})
    assert source.config.width_px == 128
    assert source.reads_images
    truth = bar(0.7)
    scene = scene_of(CAMERA)
    source.reset(scene, scene.views[0], None)
    assert iou(segment(source, scene, painted(truth, background())).mask, truth) >= 0.9
