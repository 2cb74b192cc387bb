"""States, rotations and the search space: analytic truths and properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support import resting_state

from surgbench.camera import Camera
from surgbench.geometry import (
    FloatArray,
    inverse_transform,
    is_rigid,
    look_at_angles,
    look_at_rotation,
    rigid_transform,
    rotation_angle,
    rotation_from_vector,
    rotation_vector,
    wrap_angle,
)
from surgbench.instrument import load_instrument
from surgbench.randomness import generator, seed_from
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.state import STATE_SCALE, ClampedSpace, JointLimits, StateSpace, clip_joints, split_arms, twin

LIMITS = JointLimits(np.array([-1.5707, -1.3963, 0.0]), np.array([1.5707, 1.3963, 1.5707]))

angles = st.floats(-10.0, 10.0)
joints = st.tuples(st.floats(-1.5707, 1.5707), st.floats(-1.3963, 1.3963), st.floats(0.0, 1.5707))
states = st.tuples(st.tuples(*[angles] * 3), st.tuples(*[st.floats(-0.3, 0.3)] * 3), joints).map(
    lambda parts: np.array([*parts[0], *parts[1], *parts[2]])
)


@given(st.tuples(angles, angles, angles).map(np.array))
def test_rotation_is_the_product_of_eq_9(abc: FloatArray) -> None:
    alpha, beta, gamma = abc
    expected = (
        Rotation.from_euler("y", gamma) * Rotation.from_euler("x", alpha) * Rotation.from_euler("z", beta)
    ).as_matrix()
    np.testing.assert_allclose(look_at_rotation(abc), expected, atol=1e-12)
    back = look_at_rotation(look_at_angles(look_at_rotation(abc)))
    np.testing.assert_allclose(back, expected, atol=1e-7)


@given(
    st.tuples(angles, angles, angles).map(np.array).filter(lambda axis: np.linalg.norm(axis) > 1e-3),
    st.one_of(st.floats(0.0, np.pi), st.sampled_from([0.0, 1e-12, 1e-6, np.pi - 1e-9, np.pi])),
)
def test_rotation_vectors(axis: FloatArray, angle: float) -> None:
    vector = angle * axis / np.linalg.norm(axis)
    rotation = rotation_from_vector(vector)
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)
    back = rotation_vector(rotation)
    assert np.linalg.norm(back) == pytest.approx(angle, abs=1e-8)
    np.testing.assert_allclose(rotation_from_vector(back), rotation, atol=1e-14)
    if angle < np.pi - 1e-6:  # half a turn is the same either way round
        np.testing.assert_allclose(back, vector, atol=1e-8)


def test_rigid_transforms() -> None:
    rotations = look_at_rotation(np.array([[0.1, 0.2, 0.3], [-1.0, 2.0, 0.5]]))
    transforms = rigid_transform(rotations, np.array([[1.0, 2.0, 3.0], [0.0, -1.0, 0.5]]))
    np.testing.assert_allclose(inverse_transform(transforms), np.linalg.inv(transforms), atol=1e-12)
    assert is_rigid(transforms[0])
    for wrong in (np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([1.0, 1.0, 1.01, 1.0]), np.diag([1.0, 1.0, 1.0, 2.0])):
        assert not is_rigid(wrong)
    assert not is_rigid(np.full((4, 4), np.nan))


@given(st.tuples(angles, angles, angles).map(np.array), st.floats(0.0, np.pi))
def test_rotation_angle_is_the_angle_turned_by(abc: FloatArray, turn: float) -> None:
    step = Rotation.from_rotvec(turn * np.array([0.6, 0.0, 0.8])).as_matrix()
    assert rotation_angle(step) == pytest.approx(turn, abs=1e-9)
    R = look_at_rotation(abc)
    assert rotation_angle(R.T @ (R @ step)) == pytest.approx(turn, abs=1e-7)


@given(angles)
def test_wrapped_angle_is_the_same_direction(angle: float) -> None:
    wrapped = float(wrap_angle(angle))
    assert -np.pi <= wrapped < np.pi
    assert np.exp(1j * wrapped) == pytest.approx(np.exp(1j * angle), abs=1e-9)


@given(states)
def test_encode_then_decode_returns_the_state(state: FloatArray) -> None:
    space = StateSpace(LIMITS)
    # The cosine is flat at the limits: an error of 1e-16 inside becomes one of 1e-8 there.
    np.testing.assert_allclose(space.decode(space.encode(state)), state, atol=1e-7)


@given(st.lists(st.floats(-1e4, 1e4), min_size=18, max_size=18).map(np.array))
def test_every_vector_is_a_feasible_state(vector: FloatArray) -> None:
    arms = split_arms(StateSpace(LIMITS, arms=2).decode(vector))
    assert (arms[:, 6:] >= LIMITS.lower_rad - 1e-12).all()
    assert (arms[:, 6:] <= LIMITS.upper_rad + 1e-12).all()
    np.testing.assert_allclose(arms[:, :6].ravel(), (vector.reshape(2, 9)[:, :6] * STATE_SCALE[:6]).ravel())


def test_reparameterisation_is_eq_11_and_12() -> None:
    """At the middle of a joint's range the encoded joint equals the joint; at its ends it is at the ends."""
    space = StateSpace(LIMITS, np.ones(9))
    middle = np.array([0, 0, 0, 0, 0, 0.1, 0, 0, 1.5707 / 2])
    np.testing.assert_allclose(space.encode(middle), middle, atol=1e-12)
    ends = np.array([0, 0, 0, 0, 0, 0.1, *LIMITS.upper_rad])
    np.testing.assert_allclose(space.encode(ends), ends, atol=1e-12)


def test_readings_outside_the_limits_are_clipped_before_eq_11() -> None:
    space = StateSpace(LIMITS)
    state = np.array([0, 0, 0, 0, 0, 0.1, 2.0, -3.0, -0.1])
    assert np.isfinite(space.encode(state)).all()
    np.testing.assert_allclose(space.decode(space.encode(state)), clip_joints(state, LIMITS), atol=1e-7)


def test_decoding_does_not_depend_on_memory_layout() -> None:
    vectors = np.random.default_rng(0).normal(size=(5, 9))
    space = StateSpace(LIMITS)
    np.testing.assert_array_equal(space.decode(np.asfortranarray(vectors)), space.decode(vectors))


@pytest.mark.parametrize("arms", [1, 2])
def test_pull_back_is_the_chain_rule(arms: int) -> None:
    """The derivative of a linear function of the states, by central differences of the search vectors."""
    rng = np.random.default_rng(0)
    limits = LIMITS if arms == 1 else JointLimits(np.tile(LIMITS.lower_rad, (2, 1)), np.tile(LIMITS.upper_rad, (2, 1)))
    space = StateSpace(limits, arms=arms)
    vectors, gradient = rng.normal(size=(5, 9 * arms)), rng.normal(size=(5, 9 * arms))
    pulled = space.pull_back(np.asfortranarray(vectors), gradient)
    for k, step in enumerate(1e-5 * np.eye(9 * arms)):
        rate = (space.decode(vectors + step) - space.decode(vectors - step)) / 2e-5
        np.testing.assert_allclose(pulled[:, k], (gradient * rate).sum(axis=1), rtol=1e-6, atol=1e-10)


@given(states)
def test_twin_of_the_twin_is_the_state(state: FloatArray) -> None:
    again = twin(twin(state))
    np.testing.assert_allclose(wrap_angle(again[:3] - state[:3]), 0, atol=1e-9)
    np.testing.assert_array_equal(again[3:], state[3:])


def test_twin_has_nearly_the_same_silhouette_and_the_same_tips(small_camera: Camera) -> None:
    instrument = load_instrument("large_needle_driver")
    evaluator = SilhouetteEvaluator([instrument], small_camera)
    state = resting_state()
    one, other = evaluator.mask(state), evaluator.mask(twin(state))
    assert np.count_nonzero(one & other) / np.count_nonzero(one | other) > 0.95
    np.testing.assert_allclose(
        instrument.tips_cam(twin(state)).mean(axis=0), instrument.tips_cam(state).mean(axis=0), atol=1e-12
    )


def test_streams_depend_on_the_names_of_their_axes_only() -> None:
    assert seed_from(a=0, b="x") == seed_from(b="x", a=0)
    assert seed_from(a=0) != seed_from(a=1) != seed_from(b=1)
    assert seed_from(frame=5, seed=0) != seed_from(frame=1, seed=5)
    np.testing.assert_array_equal(generator(seed=0).normal(size=3), generator(seed=0).normal(size=3))


def test_a_clamped_space_clips_joints_and_has_a_slope_on_their_limits() -> None:
    limits = JointLimits(np.array([-1.5, -1.4, 0.0]), np.array([1.5, 1.4, 1.5]))
    space = ClampedSpace(limits)
    state = np.array([0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.2, -0.1, 0.3])
    np.testing.assert_allclose(space.decode(space.encode(state)), state, atol=1e-15)
    beyond = space.encode(state) + np.array([0, 0, 0, 0, 0, 0, 100, -100, -100])
    closed = space.decode(beyond)
    np.testing.assert_array_equal(closed[6:], [1.5, -1.4, 0.0])
    np.testing.assert_allclose(space.nearest(beyond) * STATE_SCALE, closed, atol=1e-15)
    np.testing.assert_array_equal(space.pull_back(space.nearest(beyond), np.ones(9)), STATE_SCALE)
