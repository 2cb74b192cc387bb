"""What the particle filter weighs its particles with: edges of a cylinder, associations, resampling."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from support import resting_state, rigid_instrument, scene_of

from surgbench.camera import Camera
from surgbench.errors import ConfigError
from surgbench.generators.corruption import corrupt
from surgbench.generators.presets import CORRUPTION_LEVELS
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.instrument import Instrument
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.state import ANGLES, POSITION
from surgbench.trackers.observations.edges import Gate, detect_edges, expected_edges
from surgbench.trackers.observations.likelihood import association_likelihood, line_costs, point_costs
from surgbench.trackers.observations.particles import ParticleCloud, effective_number, systematic_resample
from surgbench.trackers.observations.shaft import Shaft, cylinder_edges, shaft_of

RADIUS_M = 0.004
GATE = Gate(offset_px=40.0, slope=0.2, least_points=20)
POSES = [
    [0.3, 0.4, 0.8, 0.0, 0.0, 0.13],
    [-0.4, 2.0, -0.6, 0.01, 0.01, 0.15],
    [0.8, -1.0, 0.1, -0.01, 0.0, 0.12],
    [0.02, 0.0, 1.4, 0.0, -0.02, 0.10],
]


def cylinder(length_m: float = 4.0) -> Instrument:
    """A smooth cylinder along z that leaves the image on both sides."""
    return rigid_instrument(trimesh.creation.cylinder(RADIUS_M, length_m, sections=720))


def edges_of(state: FloatArray, camera: Camera, shaft: Shaft) -> tuple[FloatArray, FloatArray]:
    lines, span_px = expected_edges(look_at_rotation(state[ANGLES]), state[POSITION], shaft, camera)
    return lines, span_px


def offsets_px(lines: FloatArray, points_px: FloatArray) -> FloatArray:
    """Signed distances ``(points, lines)``, positive outside the shaft."""
    return np.asarray(points_px @ lines[:, :2].T - lines[:, 2])


# --- the shaft


@pytest.mark.parametrize("pose", POSES)
def test_the_edges_of_a_cylinder_are_the_engines_contour(camera: Camera, pose: list[float]) -> None:
    state = np.array([*pose, 0.0, 0.0, 0.0])
    lines = cylinder_edges(state[POSITION], look_at_rotation(state[ANGLES])[:, 2], RADIUS_M, camera)
    contour = SilhouetteEvaluator([cylinder()], camera).contour_points(state)
    nearest = np.abs(offsets_px(lines, contour.points_px)).argmin(axis=1)
    assert set(nearest) == {0, 1}
    # A polygon of 720 sides lies within 1e-5 radii of the circle.
    assert np.abs(offsets_px(lines, contour.points_px)).min(axis=1).max() < 5e-3
    assert ((contour.normals * lines[nearest, :2]).sum(axis=1) > 0.9999).all()


def test_no_edges_are_seen_from_inside_a_cylinder(camera: Camera) -> None:
    lines = cylinder_edges(np.array([0.001, 0.0, 0.1]), np.array([0.0, 0.0, 1.0]), RADIUS_M, camera)
    assert np.isnan(lines).all()
    assert np.isfinite(cylinder_edges(np.array([0.005, 0, 0.1]), np.array([0, 0, 1.0]), RADIUS_M, camera)).all()


def test_the_shaft_is_measured_on_the_body() -> None:
    found = shaft_of(cylinder(0.3))
    assert found.radius_m == pytest.approx(RADIUS_M, rel=1e-4)
    np.testing.assert_allclose(found.axis_m, 0.0, atol=1e-7)
    assert (found.rear_m, found.front_m) == pytest.approx((-0.15, 0.15 - RADIUS_M), abs=1e-5)


def test_the_needle_drivers_shaft_ends_before_its_wrist(camera: Camera) -> None:
    found = shaft_of(scene_of(camera).instruments[0])
    assert found.radius_m == pytest.approx(0.00415, rel=1e-3)
    assert -0.005 < found.front_m < 0


def test_an_instrument_without_a_shaft_is_refused() -> None:
    body = cylinder()
    with pytest.raises(ConfigError, match="first link 'body'"):
        shaft_of(replace(body, meshes={}))


# --- edges in masks


@pytest.mark.parametrize("pose", POSES)
def test_edges_are_found_though_expected_elsewhere(camera: Camera, pose: list[float]) -> None:
    scene = scene_of(camera)
    state = np.array([*pose, 0.3, -0.2, 0.3])
    mask = SilhouetteEvaluator(scene.instruments, camera).mask(state)
    shaft = shaft_of(scene.instruments[0])
    true, span = edges_of(state, camera, shaft)
    elsewhere = state + np.array([0.02, 0.0, -0.02, 0.0015, -0.0015, 0.002, 0, 0, 0])
    expected, expected_span = edges_of(elsewhere, camera, shaft)
    found = detect_edges(mask, expected, expected_span, GATE)
    ends = np.clip(span, 0, [camera.width - 1, camera.height - 1])
    assert np.abs(offsets_px(expected, ends) - offsets_px(true, ends)).max() > 5
    # A tube of 20 sides deviates by 0.012 radii from a round one.
    assert np.abs(offsets_px(found, ends) - offsets_px(true, ends)).max() < 0.8


def test_edges_are_found_in_a_corrupted_mask(camera: Camera) -> None:
    scene, state = scene_of(camera), resting_state()
    mask = SilhouetteEvaluator(scene.instruments, camera).mask(state)
    true, span = edges_of(state, camera, shaft_of(scene.instruments[0]))
    rng = np.random.default_rng(0)
    ends = np.clip(span, 0, [camera.width - 1, camera.height - 1])
    for _ in range(20):
        found = detect_edges(corrupt(mask, CORRUPTION_LEVELS["strong"], rng), true, span, GATE)
        assert len(found) == 2
        assert np.abs(offsets_px(found, ends) - offsets_px(true, ends)).max() < 3


def test_the_other_arms_edge_is_not_taken_for_ones_own(camera: Camera) -> None:
    scene, state = scene_of(camera), resting_state()
    other = state.copy()
    other[4] += 0.011
    evaluator = SilhouetteEvaluator(scene.instruments, camera)
    shaft = shaft_of(scene.instruments[0])
    both = evaluator.mask(state) | evaluator.mask(other)
    for one in (state, other):
        true, span = edges_of(one, camera, shaft)
        near, near_span = edges_of(one + np.array([0, 0, 0, 0, 0.001, 0, 0, 0, 0]), camera, shaft)
        found = detect_edges(both, near, near_span, GATE)
        ends = np.clip(span, 0, [camera.width - 1, camera.height - 1])
        assert np.abs(offsets_px(found, ends) - offsets_px(true, ends)).max() < 0.8


def test_masks_without_edges_show_none(camera: Camera) -> None:
    expected, span = edges_of(resting_state(), camera, shaft_of(scene_of(camera).instruments[0]))
    shape = camera.height, camera.width
    # The image's border is not where an instrument ends.
    for mask in (np.zeros(shape, bool), np.ones(shape, bool)):
        assert detect_edges(mask, expected, span, GATE).shape == (0, 3)
    assert detect_edges(np.ones(shape, bool), np.full((2, 3), np.nan), span, GATE).shape == (0, 3)


def test_a_shaft_behind_the_camera_is_not_sought(camera: Camera) -> None:
    shaft = shaft_of(scene_of(camera).instruments[0])
    _, span = edges_of(resting_state(-0.5), camera, shaft)
    assert np.isnan(span).all()


def test_a_shaft_that_passes_the_camera_is_cut_there(camera: Camera) -> None:
    state = resting_state()
    state[ANGLES] = [0.02, 0.0, 0.05]
    _, span = edges_of(state, camera, shaft_of(scene_of(camera).instruments[0]))
    assert np.isfinite(span).all()


# --- likelihoods


@given(costs=st.lists(st.floats(0, 5), min_size=4, max_size=4), detected=st.sampled_from([1, 2]))
def test_association_is_the_cheapest_one(costs: list[float], detected: int) -> None:
    """Against SciPy's Hungarian algorithm, where every pair is one."""
    matrix = np.array(costs).reshape(2, 2)[:, :detected]
    rows, columns = linear_sum_assignment(matrix)
    threshold = 6.0
    expected = np.exp(-matrix[rows, columns]).sum() + (2 - len(rows)) * np.exp(-threshold)
    # Where both associations cost the same either will do.
    assume(detected == 1 or abs(matrix[0, 0] + matrix[1, 1] - matrix[0, 1] - matrix[1, 0]) > 1e-9)
    assert association_likelihood(matrix[None], threshold)[0] == pytest.approx(expected, rel=1e-9)


def test_what_is_missing_costs_the_threshold() -> None:
    missed = np.exp(-3.0)
    assert association_likelihood(np.empty((4, 2, 0)), 3.0) == pytest.approx([2 * missed] * 4)
    costs = np.array([[[0.0, 9.0], [9.0, 50.0]], [[np.nan, np.nan], [0.0, np.nan]]])
    assert association_likelihood(costs, 3.0) == pytest.approx([1 + missed, 1 + missed])


def test_better_matches_are_more_likely() -> None:
    """The released code has it the wrong way round for shaft lines (exp(+C))."""
    line = np.array([[0.6, 0.8, 100.0], [0.6, 0.8, 150.0]])
    shifts = np.arange(0.0, 50.0, 5.0)
    particles = np.repeat(line[None], len(shifts), axis=0)
    particles[:, :, 2] += shifts[:, None]
    likelihood = association_likelihood(line_costs(particles, line, 0.05, 7.5), 7.5)
    assert (np.diff(likelihood[:5]) < 0).all()
    assert likelihood[0] == pytest.approx(2.0)


@given(rho=st.floats(-500, 500), turn=st.floats(-0.5, 0.5), shift=st.floats(-30, 30), angle=st.floats(-np.pi, np.pi))
def test_lines_are_compared_whatever_their_sign(rho: float, turn: float, shift: float, angle: float) -> None:
    one = np.array([np.cos(angle), np.sin(angle), rho])
    other = np.array([np.cos(angle + turn), np.sin(angle + turn), rho + shift])
    costs = line_costs(np.array([[one, -one]]), np.stack([other, -other]), 1.0, 10.0)
    np.testing.assert_allclose(costs, abs(shift) + 10 * abs(turn), atol=1e-9)


def test_points_cost_their_distance() -> None:
    projected = np.array([[[0.0, 0.0], [3.0, 4.0]]])
    np.testing.assert_allclose(point_costs(projected, np.array([[0.0, 0.0]]), 0.15), [[[0.0], [0.75]]])


# --- resampling


@given(raw=st.lists(st.floats(0, 1), min_size=2, max_size=40).filter(lambda raw: sum(raw) > 0), seed=st.integers(0, 99))
def test_systematic_resampling_keeps_to_the_weights(raw: list[float], seed: int) -> None:
    weights = np.array(raw) / sum(raw)
    indices = systematic_resample(weights, np.random.default_rng(seed))
    copies = np.bincount(indices, minlength=len(weights))
    assert copies.sum() == len(weights)
    assert (np.abs(copies - len(weights) * weights) < 1 + 1e-9).all()
    np.testing.assert_array_equal(indices, systematic_resample(weights, np.random.default_rng(seed)))


def test_systematic_resampling_is_unbiased() -> None:
    weights = np.array([0.03, 0.47, 0.11, 0.39])
    rng = np.random.default_rng(1)
    copies = np.mean([np.bincount(systematic_resample(weights, rng), minlength=4) for _ in range(4000)], axis=0)
    # Each count has a standard error below 0.5 / sqrt(4000).
    np.testing.assert_allclose(copies, 4 * weights, atol=0.03)


def test_particles_are_drawn_anew_only_below_the_threshold() -> None:
    """N_eff of m equal weights is m: 5 of 10 is not below half, 4 is. The released code never gets there."""
    for heavy, drawn in ((6, False), (5, False), (4, True), (1, True)):
        cloud = ParticleCloud(np.ones(2), 10, np.random.default_rng(0))
        before = cloud.values.copy()
        cloud.weigh((np.arange(10) < heavy).astype(np.float64))
        assert effective_number(cloud.weights) == pytest.approx(heavy)
        assert cloud.resample(0.5 - 1e-9) is drawn
        if drawn:
            assert {tuple(row) for row in cloud.values} == {tuple(row) for row in before[:heavy]}
            np.testing.assert_array_equal(cloud.weights, 0.1)
        else:
            np.testing.assert_array_equal(cloud.values, before)


def test_weights_survive_frames_that_nothing_explains() -> None:
    cloud = ParticleCloud(np.ones(2), 5, np.random.default_rng(0))
    for likelihood in (0.0, np.nan, np.inf):
        cloud.weigh(np.full(5, likelihood))
        np.testing.assert_array_equal(cloud.weights, 0.2)
