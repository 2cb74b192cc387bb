"""Painted markers and shaft edges on pictures of which it is known where everything is."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support import resting_state

from surgbench.camera import Camera
from surgbench.contract import Observation, Scene, View
from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray, inverse_transform, look_at_rotation, rigid_transform, rotation_from_vector
from surgbench.instrument import Instrument, load_instrument
from surgbench.instrument.spec import LinkPoint, Marker
from surgbench.metrics import pose_errors
from surgbench.silhouette import KeypointProjector, SilhouetteEvaluator
from surgbench.tasks.instrument.conformance.scenes import IMAGES, make_play, painted_instrument
from surgbench.trackers.observations.edges import Gate, expected_edges
from surgbench.trackers.observations.image_edges import detect_image_edges
from surgbench.trackers.observations.likelihood import identified_likelihood
from surgbench.trackers.observations.markers import MarkerConfig, MarkerFinder
from surgbench.trackers.observations.paint import decoded, encoded, hue_and_saturation, turned
from surgbench.trackers.observations.patches import Patches
from surgbench.trackers.observations.shaft import shaft_of
from surgbench.trackers.particle_filter_markers import MarkerFilterTracker

CAMERA = Camera(width=640, height=480, fx=790.0, fy=790.0, cx=319.5, cy=239.5)
TISSUE, STEEL = np.array([0.30, 0.10, 0.08]), 0.05
FINER = 8
SHAFT_SPOTS = {
    "red": ((0.00415, 0.0, -0.0075), (0.85, 0.01, 0.01)),
    "green": ((-0.00415, 0.0, -0.0075), (0.01, 0.35, 0.17)),
    "violet": ((0.0, 0.00415, -0.0125), (0.85, 0.01, 0.85)),
    "olive": ((0.0, -0.00415, -0.0125), (0.17, 0.35, 0.01)),
}


@pytest.fixture(scope="module")
def painted() -> Instrument:
    driver = load_instrument("large_needle_driver")
    markers = tuple(
        Marker(name=name, point=LinkPoint(link="shaft", point_m=place), radius_m=0.0014, colour=colour)
        for name, (place, colour) in SHAFT_SPOTS.items()
    )
    return Instrument(driver.spec.model_copy(update={"markers": markers}), driver.meshes)


def state_of() -> FloatArray:
    state = resting_state()
    state[3:6] = 0.0, 0.0, 0.12
    return state


def drawn(
    painted: Instrument,
    state: FloatArray,
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0),
    without: tuple[str, ...] = (),
) -> tuple[NDArray[np.uint8], FloatArray]:
    """Discs where the paint's middles show, mixed with grey in linear light; and these middles."""
    shown = Patches(painted).shown(painted.link_transforms(state), CAMERA)
    mask = SilhouetteEvaluator((painted,), CAMERA).mask(state)
    light = np.where(mask[..., None], STEEL, TISSUE)
    for marker, place, area, sought in zip(
        painted.spec.markers, shown.places_px, shown.areas_px, shown.sought, strict=True
    ):
        if sought and marker.name not in without:
            share = disc(place, np.sqrt(area / np.pi))[..., None]
            light = (1 - share) * light + share * 0.5 * np.array(marker.colour)
    image = np.rint(255 * encoded(np.clip(light * gains, 0, 1))).astype(np.uint8)
    return image, np.where(shown.sought[:, None], shown.places_px, np.nan)


def disc(middle: FloatArray, radius: float) -> FloatArray:
    """Share of each pixel that a disc covers."""
    fine = np.zeros((CAMERA.height * FINER, CAMERA.width * FINER), np.uint8)
    at = np.rint((middle + 0.5) * FINER * 16 - 8).astype(int)
    cv2.circle(fine, (int(at[0]), int(at[1])), round(radius * FINER * 16), 1, cv2.FILLED, shift=4)
    shares: FloatArray = fine.reshape(CAMERA.height, FINER, CAMERA.width, FINER).mean(axis=(1, 3))
    return shares


# Colours


def test_hues_and_the_curve_are_those_of_opencv() -> None:
    levels = np.random.default_rng(0).random((50, 3))
    hue, saturation = hue_and_saturation(levels)
    theirs = cv2.cvtColor(levels[None].astype(np.float32), cv2.COLOR_RGB2HSV)[0]
    assert np.abs(turned(hue, theirs[:, 0])).max() < 1e-2
    np.testing.assert_allclose(saturation, theirs[:, 1], atol=1e-5)
    np.testing.assert_allclose(decoded(encoded(levels)), levels, atol=1e-6)
    assert encoded(np.array(0.214)) == pytest.approx(0.5, abs=1e-3)  # middle grey


# Markers


def test_discs_are_found_to_a_third_of_a_pixel(painted: Instrument) -> None:
    state = state_of()
    image, places = drawn(painted, state)
    rng = np.random.default_rng(1)
    noisy = np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8)
    off = state.copy()
    off[3:5] += 0.001  # 7 px
    found, shown = MarkerFinder(painted, CAMERA, MarkerConfig()).find(noisy, off)
    assert np.isfinite(places[:, 0]).sum() >= 2
    assert (np.isfinite(found) == np.isfinite(places)).all()
    assert np.nanmax(np.linalg.norm(found - places, axis=1)) < 0.3
    assert np.nanmin(np.linalg.norm(shown.places_px - places, axis=1)) > 5.0


@pytest.mark.parametrize("gains", [(1.25, 1.0, 0.8), (0.8, 1.0, 1.25)])
def test_white_balance_turns_hues_and_they_are_learned(painted: Instrument, gains: tuple[float, float, float]) -> None:
    image, places = drawn(painted, state_of(), gains)
    finder = MarkerFinder(painted, CAMERA, MarkerConfig())
    before = finder.paint.hues.copy()
    found, _ = finder.find(image, state_of())
    # Red paint beside tissue that has become redder is told from it less well.
    assert np.nanmax(np.linalg.norm(found - places, axis=1)) < 0.6
    seen = finder.paint.seen
    assert (seen == np.isfinite(places[:, 0])).all()
    colours = encoded(0.5 * np.array([marker.colour for marker in painted.spec.markers]) * gains)
    true = hue_and_saturation(colours)[0]
    assert np.abs(turned(true, before))[seen].max() > 3.0
    assert np.abs(turned(true, finder.paint.hues))[seen].max() < 2.0
    # What was not seen is expected to be turned the same way.
    hidden = ~seen & (np.abs(turned(true, before)) > 2.0)
    assert (np.abs(turned(true, finder.paint.hues)) < np.abs(turned(true, before)))[hidden].all()


def test_a_marker_that_is_hidden_or_cut_is_not_found(painted: Instrument) -> None:
    image, places = drawn(painted, state_of())
    names = [marker.name for marker in painted.spec.markers]
    number = int(np.flatnonzero(np.isfinite(places[:, 0]))[0])
    without, _ = drawn(painted, state_of(), without=(names[number],))
    found, _ = MarkerFinder(painted, CAMERA, MarkerConfig()).find(without, state_of())
    assert np.isnan(found[number]).all()
    assert np.isfinite(np.delete(found, number, axis=0)).any()
    # A cloth of its very colour is none, and neither is one of which little shows.
    cloth = image.copy()
    u, v = np.rint(places[number]).astype(int)
    cloth[v - 60 : v + 60, u - 60 : u + 60] = image[v, u]
    found, _ = MarkerFinder(painted, CAMERA, MarkerConfig()).find(cloth, state_of())
    assert np.isnan(found[number]).all()
    image[:, : u + 5] = np.rint(255 * encoded(TISSUE))
    found, _ = MarkerFinder(painted, CAMERA, MarkerConfig()).find(image, state_of())
    assert np.isnan(found[number]).all()


def test_nothing_is_found_in_an_empty_picture_or_behind_the_camera(painted: Instrument) -> None:
    tissue = np.broadcast_to(np.rint(255 * encoded(TISSUE)).astype(np.uint8), (480, 640, 3)).copy()
    finder = MarkerFinder(painted, CAMERA, MarkerConfig())
    assert np.isnan(finder.find(tissue, state_of())[0]).all()
    image, _ = drawn(painted, state_of())
    behind = state_of() * [1, 1, 1, 1, 1, -1, 1, 1, 1]
    assert np.isnan(finder.find(image, behind)[0]).all()


def test_what_shows_of_a_flat_spot_is_its_disc(painted: Instrument) -> None:
    """Straight above a spot on a wide tube: a disc of its radius, but for the tube's curve."""
    spot = painted.spec.markers[0]
    state = np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.12, 0.0, 0.0, 0.0])  # the shaft across the view
    depths = [painted.points_cam(np.r_[0.0, beta, state[2:]], (spot.point,))[0, 2] for beta in np.linspace(0, 6.2, 32)]
    state[1] = np.linspace(0, 6.2, 32)[int(np.argmin(depths))]
    shown = Patches(painted).shown(painted.link_transforms(state), CAMERA)
    place = painted.points_cam(state, (spot.point,))[0]
    assert shown.areas_px[0] == pytest.approx(np.pi * (CAMERA.fx * spot.radius_m / place[2]) ** 2, rel=0.1)
    assert np.linalg.norm(shown.places_px[0] - CAMERA.project(place)) < 1.0
    assert shown.shares[0] > 0.9
    # Its fellow on the far side does not show, nor does anything behind a wall.
    assert not shown.sought[1]
    wall = Patches(painted).shown(painted.link_transforms(state), CAMERA, np.full((480, 640), 0.05))
    assert not wall.areas_px.any()


# Projection and likelihood


def test_projected_markers_are_those_of_the_kinematics(painted: Instrument) -> None:
    points = tuple(marker.point for marker in painted.spec.markers)
    rng = np.random.default_rng(2)
    states = state_of() + rng.normal(0, 1, (200, 9)) * [0.3, 0.3, 0.3, 0.01, 0.01, 0.01, 0.3, 0.3, 0.1]
    projector = KeypointProjector([painted, painted], CAMERA, [points, points[::-1]])
    places = projector.project(np.concatenate([states, states], axis=1))
    expected = CAMERA.project(painted.points_cam(states, points))
    np.testing.assert_allclose(places[:, 0], expected, atol=1e-7)
    np.testing.assert_allclose(places[:, 1], expected[:, ::-1], atol=1e-7)
    with pytest.raises(ValueError, match="as many points of every arm"):
        KeypointProjector([painted, painted], CAMERA, [points, points[:1]])


def test_a_pair_beyond_the_threshold_counts_as_missing() -> None:
    detected = np.array([[10.0, 10.0], [50.0, 50.0]])
    near = detected + np.array([3.0, 4.0])
    cases = np.stack([detected, near, [[10.0, 10.0], [500.0, 50.0]], [[10.0, 10.0], [np.nan, np.nan]]])
    values = identified_likelihood(cases, detected, 0.15, 3.0)
    one, missed = np.exp(-0.15 * 5.0), np.exp(-3.0)
    np.testing.assert_allclose(values, [2.0, 2 * one, 1 + missed, 1 + missed])


# Shaft


def test_the_edges_of_a_shaded_cylinder_are_found_to_a_pixel(painted: Instrument) -> None:
    """A highlight along it, a bright ring across it and a painted spot at its rim do not capture the line."""
    state, shaft = state_of(), shaft_of(painted)
    true, span = expected_edges(look_at_rotation(state[:3]), state[3:6], shaft, CAMERA)
    fine = CAMERA.resized(4 * CAMERA.width, 4 * CAMERA.height)
    pixels = (np.dstack(np.meshgrid(np.arange(fine.width), np.arange(fine.height))) + 0.5) / 4 - 0.5
    depths = [pixels @ edge[:2] - edge[2] for edge in true]
    inside = (depths[0] < 0) & (depths[1] < 0)
    across = depths[0] / (depths[0] + depths[1])  # 0 at one edge, 1 at the other
    grey = STEEL + 0.4 * np.exp(-0.5 * ((across - 0.4) / 0.05) ** 2)
    grey = np.where(np.abs(pixels[..., 0] - 100.0) < 3, 0.6, grey)
    light = np.where(inside[..., None], grey[..., None], TISSUE)
    light = light.reshape(CAMERA.height, 4, CAMERA.width, 4, 3).mean(axis=(1, 3))
    corner = np.array([CAMERA.width - 1.0, CAMERA.height - 1.0])
    middle = np.clip(span, 0, corner).mean(axis=0)
    spot = middle - (middle @ true[0, :2] - true[0, 2] + 6.0) * true[0, :2]
    share = disc(spot, 9.0)[..., None]
    light = (1 - share) * light + share * [0.02, 0.4, 0.02]
    light = cv2.GaussianBlur(light, (0, 0), 0.9)
    image = 255 * encoded(light) + np.random.default_rng(3).normal(0, 4, light.shape)
    image = np.clip(image, 0, 255).astype(np.uint8)
    off = true.copy()
    off[:, 2] += [9.0, -4.0]
    found = detect_image_edges(image, spot[None], np.array([9.0]), off, span, Gate(30.0, 0.2, 20))
    assert found.shape == (2, 3)
    assert np.abs((found[:, 2] - found[:, :2] @ middle) - (true[:, 2] - true[:, :2] @ middle)).max() < 1.0
    assert np.abs(1 - (found[:, :2] * true[:, :2]).sum(axis=1)).max() < 1e-4
    flat = np.full_like(image, 90)
    assert detect_image_edges(flat, np.empty((0, 2)), np.empty(0), off, span, Gate(30.0, 0.2, 20)).shape == (0, 3)


# The tracker


def scene_and_frame(
    painted: Instrument, error: FloatArray, eye: bool = False
) -> tuple[Scene, Observation, FloatArray, FloatArray]:
    """A still scene, its truth, and the state that its readings alone would give."""
    base = rigid_transform(rotation_from_vector(np.array([2.0, 0.3, -0.4])), np.array([-0.12, -0.1, 0.1]))
    state = state_of()
    pose = rigid_transform(look_at_rotation(state[:3]), state[3:6])
    image, _ = drawn(painted, state)
    empty = np.zeros((CAMERA.height, CAMERA.width), dtype=bool)
    view = View(CAMERA, np.eye(4), empty, keypoints=(None,), image=partial(np.copy, image))
    views = (view, replace(view, T_view_cam=np.eye(4))) if eye else (view,)
    limits = (painted.search_limits,)
    scene = Scene((painted,), views, limits, 1 / 30, 1, T_cam_base=base[None])
    kinematics = inverse_transform(base @ error) @ pose
    start = state.copy()
    start[3:6] = (base @ kinematics)[:3, 3]
    return scene, Observation(0, 0.0, views, state, state[6:], kinematics[None]), state, start


@pytest.mark.parametrize("eye", [False, True])
def test_it_finds_a_lumped_error_on_images_alone(painted: Instrument, eye: bool) -> None:
    error = rigid_transform(np.eye(3), np.array([0.0012, -0.0008, 0.0]))
    scene, seen, truth, start = scene_and_frame(painted, error, eye)
    tracker = MarkerFilterTracker(MarkerFilterTracker.Config(particles=600, joint_errors=False))
    tracker.reset(scene, start, np.random.default_rng(0))
    estimates = [tracker.step(seen) for _ in range(16)]
    late = pose_errors(painted, CAMERA, np.array([one.state for one in estimates[8:]]), np.tile(truth, (8, 1)))
    before = pose_errors(painted, CAMERA, start[None], truth[None])
    assert late["keypoint_error_px"].mean() < 0.4 * before["keypoint_error_px"][0]
    assert (np.asarray(estimates[-1].confidence) == 1.0).all()
    assert not np.any(estimates[-1].lost)


def test_where_nothing_shows_it_is_lost(painted: Instrument) -> None:
    scene, seen, _, start = scene_and_frame(painted, np.eye(4))
    tracker = MarkerFilterTracker(MarkerFilterTracker.Config())
    tracker.reset(scene, start, np.random.default_rng(0))
    flat = replace(seen.views[0], image=partial(np.full, (CAMERA.height, CAMERA.width, 3), 80, np.uint8))
    estimate = tracker.step(replace(seen, views=(flat,)))
    assert np.all(estimate.lost)
    assert np.all(estimate.confidence == 0.0)
    assert np.isfinite(estimate.state).all()


def test_what_it_needs_is_said_in_one_line() -> None:
    assert MarkerFilterTracker.reads_images
    play = make_play(kinematics=True, images=True)
    tracker = MarkerFilterTracker()
    with pytest.raises(ConfigError, match="lists no 'markers': a dataset of the preset 'markers'") as caught:
        tracker.reset(make_play(kinematics=True).scene, play.truth[0], np.random.default_rng(0))
    assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match="particle-filter-markers needs kinematics: a dataset with"):
        tracker.reset(replace(play.scene, T_cam_base=None), play.truth[0], np.random.default_rng(0))
    tracker.reset(play.scene, play.truth[0], np.random.default_rng(0))
    with pytest.raises(ConfigError, match="needs images in every frame and view") as caught:
        tracker.step(make_play(kinematics=True).observations[0])
    assert "\n" not in str(caught.value)
    assert painted_instrument().spec.markers
    assert IMAGES
