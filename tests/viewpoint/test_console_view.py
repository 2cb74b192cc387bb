"""The console's pictures: lines become straight, edges sharp by the formula, and pictures move by whole pixels."""

from __future__ import annotations

import re
from statistics import NormalDist

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from surgbench.camera import Camera
from surgbench.camera.undistortion import Undistortion
from surgbench.errors import ConfigError, SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.report.drawing import Picture
from surgbench.viewpoint.optics.console import (
    KERNEL_PX,
    SIGMA_PX,
    ConsoleSettings,
    ConsoleView,
    StereoPicture,
    fusing_separation_px,
    join,
    move_apart,
    sharpen,
    shift,
)
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO

LEFT, RIGHT = AUTOCAM_STEREO.left, AUTOCAM_STEREO.right
IDEAL = Camera(width=512, height=384, fx=390.0, fy=390.0, cx=250.0, cy=190.0)


def noise(height: int, width: int, channels: int = 3) -> Picture:
    shape = (height, width, channels) if channels else (height, width)
    return np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)


def through_lens(camera: Camera, line: FloatArray) -> Picture:
    """How the camera sees a soft line whose points would be at ``a u + b v = c`` without its lens.

    Brown's model, solved for the ideal point of each pixel by a fixed point.
    """
    k1, k2, p1, p2, k3 = camera.distortion
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    seen_x, seen_y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    x, y = seen_x, seen_y
    for _ in range(60):
        square = x * x + y * y
        radial = 1 + square * (k1 + square * (k2 + square * k3))
        x, y = (
            (seen_x - 2 * p1 * x * y - p2 * (square + 2 * x * x)) / radial,
            (seen_y - p1 * (square + 2 * y * y) - 2 * p2 * x * y) / radial,
        )
    a, b, c = line
    away = a * (camera.fx * x + camera.cx) + b * (camera.fy * y + camera.cy) - c
    return np.asarray(np.rint(250 * np.exp(-((away / 2.5) ** 2))), dtype=np.uint8)


def line_errors(picture: Picture, line: FloatArray) -> FloatArray:
    """How far the line is from where it should be, by the centroid of each row, in the rows where all of it is seen."""
    a, b, c = line
    rows, columns = np.arange(picture.shape[0]), np.arange(picture.shape[1])
    expected = (c - b * rows) / a
    window = np.abs(columns - expected[:, None]) < 12
    inside = (expected > 20) & (expected < picture.shape[1] - 20) & (rows > 10) & (rows < picture.shape[0] - 10)
    weight = picture.astype(np.float64) * window
    centroid = (weight * columns).sum(axis=1)[inside] / weight.sum(axis=1)[inside]
    return np.asarray((centroid - expected[inside]) * a)


@pytest.mark.parametrize("camera", [LEFT, RIGHT])
@pytest.mark.parametrize("column", [40.0, 450.0])
def test_a_line_that_the_lens_bent_is_straight_again(camera: Camera, column: float) -> None:
    """It is where an ideal camera sees it, too."""
    line = np.array([np.cos(0.08), np.sin(0.08), column * np.cos(0.08)])
    bent = through_lens(camera, line)
    assert np.abs(line_errors(bent, line)).max() > 1
    assert np.abs(line_errors(Undistortion(camera)(bent), line)).max() < 0.1


def test_undistortion_keeps_shape_and_type_and_leaves_an_ideal_picture_alone() -> None:
    for channels in (0, 3):
        straight = Undistortion(LEFT)(noise(384, 512, channels))
        assert straight.shape == noise(384, 512, channels).shape
        assert straight.dtype == np.uint8
        np.testing.assert_array_equal(Undistortion(IDEAL)(noise(384, 512, channels)), noise(384, 512, channels))
    mask = noise(384, 512, 0) & 1
    assert set(np.unique(Undistortion(LEFT)(mask, cv2.INTER_NEAREST))) == {0, 1}


def test_a_lens_of_an_unknown_model_is_one_clear_error() -> None:
    with pytest.raises(ConfigError, match=r"^camera has 3 distortion coefficients \('distortion' must have 4, 5"):
        Undistortion(LEFT.model_copy(update={"distortion": (0.1, 0.2, 0.3)}))


def test_no_sharpening_gives_the_picture_back() -> None:
    np.testing.assert_array_equal(sharpen(noise(40, 60), 0.0), noise(40, 60))


@given(st.integers(0, 255), st.floats(0, 10))
def test_an_even_picture_stays_as_it_is(grey: int, alpha: float) -> None:
    even = np.full((30, 40, 3), grey, np.uint8)
    np.testing.assert_array_equal(sharpen(even, alpha), even)


@pytest.mark.parametrize("alpha", [1.0, 3.0])
def test_an_edge_overshoots_by_what_the_formula_says(alpha: float) -> None:
    """By alpha times the part of the kernel that lies beyond the edge, times the step; and undershoots by as much."""
    low, high, middle = 100, 140, 32
    edge = np.full((48, 64), low, np.uint8)
    edge[:, middle:] = high
    sharp = sharpen(edge, alpha)
    reach = np.arange(KERNEL_PX) - KERNEL_PX // 2
    kernel = np.exp(-0.5 * (reach / SIGMA_PX) ** 2)
    kernel /= kernel.sum()
    for away in range(KERNEL_PX // 2 + 3):
        beyond = kernel[reach > away].sum()
        np.testing.assert_array_equal(sharp[:, middle + away], round(high + alpha * beyond * (high - low)))
        np.testing.assert_array_equal(sharp[:, middle - 1 - away], round(low - alpha * beyond * (high - low)))
    # An ideal Gaussian has Phi(-1/4) of it more than half a pixel beyond.
    assert abs(int(sharp[0, middle]) - high - alpha * NormalDist().cdf(-0.25) * (high - low)) < 1.5


def test_sharpening_stays_within_black_and_white() -> None:
    edge = np.zeros((20, 40), np.uint8)
    edge[:, 20:] = 255
    np.testing.assert_array_equal(sharpen(edge, 3.0), edge)


@given(st.integers(-70, 70))
def test_a_shift_moves_by_exactly_so_many_columns(columns: int) -> None:
    picture = noise(8, 50)
    moved = shift(picture, columns)
    assert moved.shape == picture.shape
    for column in range(50):
        expected = picture[:, column - columns] if 0 <= column - columns < 50 else 0
        np.testing.assert_array_equal(moved[:, column], expected)


def test_apart_is_to_the_left_for_the_left_eye() -> None:
    point = np.zeros((5, 40), np.uint8)
    point[2, 20] = 255
    left, right = move_apart(StereoPicture(point, point), 3)
    assert np.argwhere(left).tolist() == [[2, 17]]
    assert np.argwhere(right).tolist() == [[2, 23]]


def test_what_is_at_the_separations_distance_lies_in_the_plane_of_the_screen() -> None:
    """The camera's 26.5 mm apart and a ring 11 cm away: the 47 px that move it there are near the code's 50."""
    separation_px = fusing_separation_px(IDEAL.fx, 0.0265, 0.11)
    assert 45 < separation_px < 50
    ring = np.array([0.02, 0.01, 0.11])
    eyes = StereoPicture(*(np.zeros((384, 512), np.uint8) for _ in range(2)))
    for picture, offset_m in zip(eyes, (0.0, 0.0265), strict=True):
        u, v = IDEAL.project(ring - [offset_m, 0, 0])
        picture[round(v), round(u)] = 255
    (left,), (right,) = (np.argwhere(picture) for picture in move_apart(eyes, round(separation_px)))
    assert left[0] == right[0]
    assert abs(left[1] - right[1]) <= 1


def test_joined_pictures_have_one_width() -> None:
    """The endoscope's above, its proportions kept; the auxiliary camera's below, untouched."""
    joined = join(np.full((986, 1400, 3), 90, np.uint8), noise(384, 512))
    assert joined.shape == (361 + 384, 512, 3)
    assert joined.dtype == np.uint8
    assert (joined[:361] == 90).all()
    np.testing.assert_array_equal(joined[361:], noise(384, 512))
    np.testing.assert_array_equal(join(noise(30, 50), noise(20, 50)), np.concatenate([noise(30, 50), noise(20, 50)]))


def test_the_chain_is_undistorted_then_sharpened_then_moved_then_joined() -> None:
    """Each eye through its own lens."""
    endoscope = StereoPicture(noise(300, 512), noise(300, 512)[::-1])
    auxiliary = StereoPicture(noise(384, 512), noise(384, 512)[::-1])
    console = ConsoleView(LEFT, RIGHT, ConsoleSettings(sharpening=3, separation_px=40))(endoscope, auxiliary)
    for eye, camera, columns in ((0, LEFT, -40), (1, RIGHT, 40)):
        below = shift(sharpen(np.asarray(Undistortion(camera)(auxiliary[eye]), np.uint8), 3.0), columns)
        np.testing.assert_array_equal(console[eye], np.concatenate([endoscope[eye], below]))


def test_without_lens_sharpening_and_separation_nothing_changes() -> None:
    pair = StereoPicture(noise(384, 512), noise(384, 512)[::-1])
    console = ConsoleView(IDEAL, IDEAL, ConsoleSettings(sharpening=0))(pair, pair)
    for shown, taken in zip(console, pair, strict=True):
        np.testing.assert_array_equal(shown, np.concatenate([taken, taken]))


def test_a_picture_of_the_wrong_kind_is_one_clear_error() -> None:
    view = ConsoleView(LEFT, RIGHT)
    right, small, grey = noise(384, 512), noise(300, 400), noise(384, 512, 0)
    big = StereoPicture(right, right)
    cases = [
        (big, StereoPicture(right, small), "auxiliary camera's right picture: is 400x300x3 (must be 512x384 pixels)"),
        (StereoPicture(right, small), big, "endoscope's right picture: is 400x300x3 (must be 512x384 pixels)"),
        (big, StereoPicture(grey, grey), "pictures of endoscope and auxiliary camera must both be grey or both"),
        (big, StereoPicture(right[..., :2], right), "not a picture: uint8 of shape (384, 512, 2) (must be uint8"),
        (StereoPicture(right[:0], right[:0]), big, "not a picture: uint8 of shape (0, 512, 3)"),
    ]
    for endoscope, auxiliary, message in cases:
        with pytest.raises(SurgbenchError, match="^" + re.escape(message)) as caught:
            view(endoscope, auxiliary)
        assert "\n" not in str(caught.value)
    with pytest.raises(SurgbenchError, match=r"^not a picture: float64"):
        sharpen(np.zeros((3, 3)))  # type: ignore[arg-type]
    with pytest.raises(SurgbenchError, match=r"^left camera has 512x384 pixels, right camera 256x384"):
        ConsoleView(LEFT, RIGHT.model_copy(update={"width": 256}))
    with pytest.raises(ValidationError, match="sharpening"):
        ConsoleSettings(sharpening=-1)
