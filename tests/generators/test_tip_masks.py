"""Masks with known tips: the same number is the same mask, and what is said of the tips is true."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import resting_state

from surgbench.config import parse_model
from surgbench.errors import ConfigError
from surgbench.generators.presets import PAPER_CAMERA
from surgbench.generators.render import MaskRenderer
from surgbench.generators.tip_masks import Painter, TipMasks, TipMaskSettings
from surgbench.geometry import FloatArray
from surgbench.instrument import load_instrument
from surgbench.keypoints.accuracy import accuracy, outcome, pair_errors
from surgbench.keypoints.labelled import LabelledMask

CLEAN = TipMaskSettings(cameras=(PAPER_CAMERA,), variants=1, corruption={"none": 1.0})
SEEN = resting_state()


def facing(jaw_rad: float) -> FloatArray:
    """The shaft from the left, wrist straight, jaws turned so that they open in the image."""
    return np.array([0.0, 0.0, 0.9, 0.0, 0.0, 0.13, 0.0, 0.0, jaw_rad])


@pytest.fixture(scope="module")
def masks() -> TipMasks:
    return TipMasks(TipMaskSettings(), 40, seed=0, part="test")


def test_a_mask_does_not_depend_on_those_before_it(masks: TipMasks) -> None:
    again = TipMasks(TipMaskSettings(), 5, seed=0, part="test")
    for index in (4, 0, 2):
        one, other = masks[index], again[index]
        assert np.array_equal(one.mask, other.mask)
        assert np.array_equal(one.tips_px, other.tips_px)
        assert np.array_equal(one.shows, other.shows)


@pytest.mark.parametrize("change", [{"seed": 1}, {"part": "training"}])
def test_other_seeds_and_parts_are_other_masks(masks: TipMasks, change: dict[str, int | str]) -> None:
    other = TipMasks(TipMaskSettings(), 1, **{"seed": 0, "part": "test", **change})[0]
    assert not np.array_equal(masks[0].tips_px, other.tips_px)


def test_there_are_as_many_as_asked_for(masks: TipMasks) -> None:
    assert len(masks) == 40
    with pytest.raises(IndexError):
        masks[40]


@pytest.mark.slow
def test_the_set_holds_what_detectors_meet(masks: TipMasks) -> None:
    """Several cameras and corruptions, tips that show and tips that do not, jaws closed and open."""
    every = list(masks)
    assert len({one.camera for one in every}) > 1
    assert len({one.corruption for one in every}) == 4
    assert 0.2 < np.mean([one.both_show for one in every]) < 0.9
    openings = [one.opening_rad for one in every]
    assert min(openings) < 0.2 < 0.9 < max(openings)


def test_tips_that_show_lie_on_the_mask() -> None:
    for one in TipMasks(CLEAN, 30, seed=3, part="test"):
        for tip, shows in zip(one.tips_px, one.shows, strict=True):
            if shows:
                u, v = np.round(tip).astype(int)
                around = one.mask[max(v - 3, 0) : v + 4, max(u - 3, 0) : u + 4]
                assert around.any()
                assert one.camera.contains(tip)


def test_open_jaws_show_and_closed_ones_seen_edge_on_cover_each_other() -> None:
    painter = Painter(load_instrument("large_needle_driver"), PAPER_CAMERA)
    edge_on = facing(0.0)
    edge_on[1] = np.pi / 2
    for state, expected in ((facing(0.5), True), (edge_on, False)):
        assert painter.shows(state, painter.mask(state)).all() == expected


def test_a_tip_before_the_shaft_does_not_show() -> None:
    """Bent back over the shaft the jaws are hidden in the silhouette, whichever is nearer."""
    painter = Painter(load_instrument("large_needle_driver"), PAPER_CAMERA)
    looking_along = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.13, 0.0, 0.0, 0.2])  # the shaft away from the camera
    assert not painter.shows(looking_along, painter.mask(looking_along)).any()


def test_tips_outside_the_image_do_not_show() -> None:
    painter = Painter(load_instrument("large_needle_driver"), PAPER_CAMERA)
    state = facing(0.5) + np.array([0, 0, 0, 0.08, 0, 0, 0, 0, 0])
    assert not PAPER_CAMERA.contains(PAPER_CAMERA.project(painter.instrument.tips_cam(state))).any()
    assert not painter.shows(state, painter.mask(state)).any()


def test_a_tip_that_the_corruption_ate_or_buried_does_not_show() -> None:
    painter = Painter(load_instrument("large_needle_driver"), PAPER_CAMERA)
    state = facing(0.5)
    mask = painter.mask(state)
    u, v = np.round(PAPER_CAMERA.project(painter.instrument.tips_cam(state))[0]).astype(int)
    for covered in (False, True):
        spoilt = mask.copy()
        spoilt[v - 15 : v + 16, u - 15 : u + 16] = covered
        assert painter.shows(state, spoilt).tolist() == [False, True]


def test_masks_are_those_of_the_datasets_renderer() -> None:
    """Engine and Mitsuba agree but for pixel centres within rounding of an edge."""
    instrument = load_instrument("large_needle_driver")
    painter, renderer = Painter(instrument, PAPER_CAMERA), MaskRenderer([instrument], PAPER_CAMERA, threads=1)
    for state in (SEEN, facing(0.5)):
        assert np.count_nonzero(painter.mask(state) != renderer.mask(state)) <= 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"distance_m": [0.2, 0.1]}, "lower, upper"),
        ({"corruption": {"none": 0.5}}, "sum to 1"),
        ({"distanc_m": [0.1, 0.2]}, "did you mean 'distance_m'"),
    ],
)
def test_wrong_settings_are_told_in_one_line(content: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        parse_model(TipMaskSettings, content, "file.yaml")
    assert "\n" not in str(caught.value)


def example(tips: FloatArray, shows: tuple[bool, bool] = (True, True)) -> LabelledMask:
    mask = np.zeros((PAPER_CAMERA.height, PAPER_CAMERA.width), dtype=bool)
    return LabelledMask(mask, PAPER_CAMERA, tips, np.array(shows), 0.3, "none")


@pytest.mark.slow
def test_the_truth_handed_in_scores_perfectly(masks: TipMasks) -> None:
    found = accuracy([outcome(one, one.tips_px[::-1]) for one in masks])
    assert found.detected_percent == 100.0
    assert found.median_error_px == found.p95_error_px == 0.0
    assert found.false_pair_percent == found.all_false_pair_percent == 0.0
    assert 0 < found.masks < found.masks + found.other_masks == len(masks)


def test_nothing_found_is_no_false_pair(masks: TipMasks) -> None:
    found = accuracy([outcome(one, None) for one in masks])
    assert found.detected_percent == found.false_pair_percent == 0.0
    assert found.median_error_px is None


def test_a_pair_that_is_off_is_false_where_none_was_asked_for_and_missed_where_one_was() -> None:
    tips = np.array([[100.0, 100.0], [150.0, 100.0]])
    asked, hidden = example(tips), example(tips, (True, False))
    far = tips + np.array([[0.0, 0.0], [11.0, 0.0]])
    found = accuracy([outcome(one, far) for one in (asked, hidden)])
    assert (found.detected_percent, found.false_pair_percent) == (0.0, 100.0)
    near = tips + np.array([[0.0, 3.0], [9.0, 0.0]])
    found = accuracy([outcome(one, near) for one in (asked, hidden)])
    assert (found.detected_percent, found.false_pair_percent) == (100.0, 0.0)
    assert found.median_error_px == pytest.approx(6.0)


def test_tips_that_cross_are_not_asked_for() -> None:
    assert outcome(example(np.array([[100.0, 100.0], [108.1, 100.0]])), None).asked
    assert not outcome(example(np.array([[100.0, 100.0], [107.9, 100.0]])), None).asked


@settings(max_examples=50)
@given(st.lists(st.floats(-500, 500), min_size=8, max_size=8))
def test_the_order_of_a_pair_does_not_matter(numbers: list[float]) -> None:
    pair, tips = np.array(numbers).reshape(2, 2, 2)
    errors = pair_errors(pair, tips)
    assert errors.sum() == pytest.approx(pair_errors(pair[::-1], tips).sum())
    assert errors.sum() <= np.linalg.norm(pair - tips, axis=1).sum() + 1e-9
