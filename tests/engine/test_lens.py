"""One lens for points, masks and pictures: what it does to one it does to all, and undoes."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from surgbench.camera import Camera
from surgbench.camera.lens import DistortionModel
from surgbench.camera.undistortion import Undistortion
from surgbench.errors import ConfigError
from surgbench.generators.lens import Lens as MaskLens
from surgbench.geometry import FloatArray
from surgbench.viewpoint.optics.calibration import displacement_px

SIZE: dict[str, Any] = {"width": 640, "height": 512}
# In OpenCV's order: how large each coefficient may be.
BOUNDS = (0.35, 0.15, 0.004, 0.004, 0.05, 0.2, 0.1, 0.05, 0.01, 0.01, 0.01, 0.01, 0.06, 0.06)


@st.composite
def lenses(draw: st.DrawFn, counts: tuple[int, ...] = (4, 5, 8, 12, 14), fisheye: bool = True) -> Camera:
    """Cameras of fields of view of 40 to 105 degrees, with lenses of every model, folding ones among them."""
    focal = draw(st.floats(310, 900))
    place = {"cx": draw(st.floats(250, 390)), "cy": draw(st.floats(200, 310))}
    intrinsics: dict[str, Any] = {**SIZE, "fx": focal, "fy": focal * draw(st.floats(0.95, 1.05)), **place}
    if fisheye and draw(st.booleans()):
        bent = draw(st.tuples(*[st.floats(-0.03, 0.03)] * 4))
        return Camera(**intrinsics, distortion=bent, distortion_model="fisheye")
    count = draw(st.sampled_from(counts))
    return Camera(**intrinsics, distortion=draw(st.tuples(*[st.floats(-bound, bound) for bound in BOUNDS[:count]])))


def border(camera: Camera) -> FloatArray:
    """``(n, 2)`` pixels along the picture's border, and some inside."""
    across = np.linspace(-0.5, camera.width - 0.5, 33)
    down = np.linspace(-0.5, camera.height - 0.5, 33)
    edges = [np.stack(np.broadcast_arrays(across, edge), axis=-1) for edge in (-0.5, camera.height - 0.5)]
    sides = [np.stack(np.broadcast_arrays(edge, down), axis=-1) for edge in (-0.5, camera.width - 0.5)]
    inside = np.stack(np.meshgrid(across[::4], down[::4]), axis=-1).reshape(-1, 2)
    return np.concatenate([*edges, *sides, inside])


def tangents(camera: Camera, straight: FloatArray) -> FloatArray:
    return np.asarray(np.hypot(*np.moveaxis((straight - [camera.cx, camera.cy]) / [camera.fx, camera.fy], -1, 0)))


@settings(max_examples=25)
@given(lenses())
def test_the_inverse_is_converged_up_to_the_border(camera: Camera) -> None:
    pixels = border(camera)
    straight = camera.lens.undistort(pixels)
    seen = np.isfinite(straight[:, 0])
    assert np.isfinite(straight[seen]).all()
    np.testing.assert_allclose(camera.lens.distort(straight[seen]), pixels[seen], atol=2e-4)
    assert (tangents(camera, straight[seen]) <= camera.widest * (1 + 1e-12)).all()


@settings(max_examples=25)
@given(lenses())
def test_what_the_lens_sees_is_found_again(camera: Camera) -> None:
    """Not only does the way back and forth lead to the same pixel: no pixel that is seen is called unseen."""
    # Short of the limit, where a pixel says next to nothing about its ray.
    # How wide it sees is told of its radial terms; tangential ones have the picture fold over a little before.
    reach = 0.9 * min(camera.widest, 3.0)
    angle, share = np.meshgrid(np.linspace(0, 2 * np.pi, 16, endpoint=False), np.linspace(0, 1, 9))
    rays = reach * np.stack([share * np.cos(angle), share * np.sin(angle)], axis=-1)
    straight = rays * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    pixels = camera.lens.distort(straight)
    assert np.isfinite(pixels).all()
    inside = camera.contains(pixels)
    assume(inside.any())
    again = camera.lens.undistort(pixels)[inside]
    assert np.isfinite(again).all()
    np.testing.assert_allclose(camera.lens.distort(again), pixels[inside], atol=2e-4)
    if camera.distortion_model == "fisheye" or not any(camera.distortion[2:4] + camera.distortion[8:]):
        # Purely radial: one ray for a pixel.
        np.testing.assert_allclose(again, straight[inside], atol=1e-3)


@settings(max_examples=25)
@given(lenses(fisheye=False))
def test_points_are_where_opencv_has_them(camera: Camera) -> None:
    rays = np.array([[0.1, -0.2, 1.0], [0.3, 0.25, 1.0], [0.0, 0.0, 1.0]])
    assume(camera.widest > 0.5)
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))
    np.testing.assert_allclose(camera.see(rays), np.asarray(expected)[:, 0], atol=1e-9)


def test_a_fisheye_is_opencvs() -> None:
    camera = Camera(
        **SIZE, fx=310, fy=312, cx=320, cy=255, distortion=(-0.02, 0.01, -0.005, 0.001), distortion_model="fisheye"
    )
    points = np.random.default_rng(3).uniform([-0.2, -0.2, 0.05], [0.2, 0.2, 0.3], (200, 3))
    points[0, :2] = 0.0
    none = np.zeros((1, 3))
    expected, _ = cv2.fisheye.projectPoints(points[None], none, none, camera.matrix, np.array(camera.distortion))
    np.testing.assert_allclose(camera.see(points), np.asarray(expected)[0], atol=1e-9)
    # Without coefficients, a pixel's distance is the angle.
    plain = camera.model_copy(update={"distortion": (0.0,) * 4})
    np.testing.assert_allclose(plain.see(np.array([1.0, 0.0, 1.0])), [320 + 310 * np.pi / 4, 255])
    assert plain.is_distorted
    assert plain.widest == pytest.approx(1000)
    assert np.isnan(plain.see(np.array([1.0, 0.0, 0.0]))).all()


def test_the_range_ends_where_the_model_folds() -> None:
    # r (1 - 0.28 r^2 + 0.03 r^4) grows while 1 - 0.84 r^2 + 0.15 r^4 > 0.
    camera = Camera(width=1280, height=1024, fx=560, fy=560, cx=640, cy=512, distortion=(-0.28, 0.03, 0, 0, 0))
    fold = np.sqrt((0.84 - np.sqrt(0.84**2 - 4 * 0.15)) / 0.3)
    assert camera.widest == pytest.approx(fold, rel=1e-6)
    last = fold * (1 - 0.28 * fold**2 + 0.03 * fold**4) * 560
    beside = np.array([[640 + last - 0.01, 512.0], [640 + last + 0.01, 512.0], [0.0, 0.0]])
    assert np.isnan(camera.lens.undistort(beside)[:, 0]).tolist() == [False, True, True]
    assert np.isnan(camera.see(np.array([[fold - 1e-6, 0, 1], [fold + 1e-6, 0, 1]]))[:, 0]).tolist() == [False, True]
    # A pole is an end, too: 1 / (1 - r^2 / 4).
    pole = camera.model_copy(update={"distortion": (0.0, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0)})
    assert pole.widest == pytest.approx(2.0)
    # And an odd one that always grows has none within what is looked at.
    assert camera.model_copy(update={"distortion": (0.1, 0.0, 0.0, 0.0)}).widest == 20


def test_nothing_is_drawn_beyond_the_range() -> None:
    camera = Camera(width=320, height=256, fx=140, fy=140, cx=160, cy=128, distortion=(-0.28, 0.03, 0, 0, 0))
    white = np.full((256, 320), 255, np.uint8)
    columns, rows = np.meshgrid(np.arange(320.0), np.arange(256.0))
    beyond = tangents(camera, np.stack([columns, rows], axis=-1)) > camera.widest
    assert 0.01 < beyond.mean() < 0.95
    for interpolation in (cv2.INTER_NEAREST, cv2.INTER_LINEAR):
        assert np.array_equal(Undistortion(camera)(white, interpolation) == 0, beyond)
    # And nothing of a pinhole's mask is seen in pixels that no ray reaches.
    lens = MaskLens(camera)
    seen = lens.see(np.ones((lens.pinhole.height, lens.pinhole.width), bool))
    reached = np.isfinite(camera.lens.undistort(np.stack([columns, rows], axis=-1))[..., 0])
    assert np.array_equal(seen, reached)
    assert not reached[0, 0]


@settings(max_examples=8)
@given(lenses(counts=(5, 14)), st.floats(0.3, 0.7), st.floats(0.3, 0.7))
def test_points_and_pictures_agree(camera: Camera, across: float, down: float) -> None:
    """A disc drawn where the lens shows a point is, undistorted, where the point is."""
    camera = camera.resized(320, 256)
    straight = np.array([across * camera.width, down * camera.height])
    pixel = camera.lens.distort(straight)
    near = camera.lens.distort(straight + 6 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]))
    assume(np.isfinite(near).all() and camera.contains(near, 8.0).all() and camera.contains(pixel, 20.0))
    # No mirror images, and no more of a squeeze than a disc survives.
    assume(np.linalg.norm(near - pixel, axis=1).min() > 3)
    picture = np.zeros((camera.height, camera.width), np.uint8)
    cv2.circle(picture, tuple(np.rint(pixel * 16).astype(int).tolist()), 5 * 16, 255, -1, cv2.LINE_AA, 4)
    rows, columns = np.nonzero(Undistortion(camera)(picture) > 127)
    np.testing.assert_allclose([columns.mean(), rows.mean()], straight, atol=1.0)


def test_what_is_wrong_with_a_camera_is_told() -> None:
    intrinsics: dict[str, Any] = {**SIZE, "fx": 500, "fy": 500, "cx": 320, "cy": 256}
    wrong: list[tuple[tuple[float, ...], DistortionModel, str]] = [
        ((0.1, 0.2), "opencv", "'distortion' must have 4, 5, 8, 12 or 14 coefficients"),
        ((0.1,) * 5, "fisheye", "'distortion' must have 4 coefficients, k1 to k4"),
        ((), "fisheye", "not 0"),
    ]
    for coefficients, model, message in wrong:
        with pytest.raises(ValidationError, match=message):
            Camera(**intrinsics, distortion=coefficients, distortion_model=model)
        with pytest.raises(ConfigError, match="distortion coefficients"):
            _ = Camera(**intrinsics).model_copy(update={"distortion": coefficients, "distortion_model": model}).lens


def test_files_of_cameras_that_are_no_fisheyes_stay_as_they_were() -> None:
    camera = Camera(**SIZE, fx=500, fy=501, cx=320, cy=256, distortion=(0.1, 0.0, 0.0, 0.0))
    assert list(camera.model_dump()) == ["width", "height", "fx", "fy", "cx", "cy", "distortion"]
    fisheye = camera.model_copy(update={"distortion_model": "fisheye"})
    assert fisheye.model_dump(mode="json")["distortion_model"] == "fisheye"
    for one in (camera, fisheye):
        assert Camera.model_validate_json(one.model_dump_json()) == one
        assert one.pinhole.model_dump() == {**camera.model_dump(), "distortion": ()}
        assert not one.pinhole.is_distorted


def test_resized_pictures_have_the_resized_camera(camera: Camera) -> None:
    # A bright pixel's square, made smaller as cv2 does it, keeps its middle.
    double = camera.resized(1400, 986)
    assert (double.width, double.height) == (1400, 986)
    picture = np.zeros((986, 1400), np.float32)
    picture[400:404, 600:602] = 1
    small = cv2.resize(picture, (700, 493), interpolation=cv2.INTER_AREA)
    rows, columns = np.nonzero(np.asarray(small))
    ray = [(600.5 - double.cx) / double.fx, (401.5 - double.cy) / double.fy, 1.0]
    np.testing.assert_allclose(camera.project(np.array(ray)), [columns.mean(), rows.mean()], atol=1e-9)
    assert double.resized(350, 246).width == 350
    with pytest.raises(ConfigError, match=r"700x493 pixels cannot be scaled to 640x480 \(another aspect ratio\)"):
        camera.resized(640, 480)


def test_a_calibration_is_off_by_nothing_from_itself() -> None:
    camera = Camera(width=160, height=128, fx=120, fy=121, cx=80, cy=64, distortion=(-0.2, 0.02, 0.001, 0.0, 0.0))
    assert np.nanmax(displacement_px(camera, camera)) < 1e-4
    moved = camera.model_copy(update={"cx": 81.0})
    np.testing.assert_allclose(displacement_px(camera, moved), 1.0, atol=1e-3)
