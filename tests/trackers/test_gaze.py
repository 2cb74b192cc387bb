"""Our viewpoint controller: what it fits, where it goes, and that nothing brings it beyond the limits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from surgbench.geometry import FloatArray, inverse_transform
from surgbench.tasks.viewpoint.conformance.worlds import circling, feature_poses, make_trial, random_trial
from surgbench.trackers.gaze import Gaze, GazeConfig
from surgbench.trackers.viewing.approach import chase, track
from surgbench.trackers.viewing.fit import RESIDUALS, fit, residuals
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.rules import reported_depths
from surgbench.viewpoint.scores import course_errors
from surgbench.viewpoint.simulator import Course, Simulation, make_scene
from surgbench.viewpoint.trial import Trial

ARM = CameraArm()
# Up and the pole; the floor at z = -0.15; the side; the zone's margin.
RULES = np.array([[0, 0, 1, 0.99], [0, 0, 1, -0.15], [1, 0, 0, 0.1], [0, 0, 0, 0.004]])
FACES = np.array(
    [[0, 0, 1, -0.19], [0, 0, -1, 0.14], [1, 0, 0, -0.1], [-1, 0, 0, -0.1], [0, 1, 0, 0.0], [0, -1, 0, -0.1]]
)
WEIGHTS = 1 / np.array([2e-3, 2e-3, 1e-3, 2e-2, 3e-4, 1.0])


def run(trial: Trial, **options: float) -> Course:
    """The course of a trial."""
    return Simulation(Gaze(GazeConfig(**options)), trial, make_scene(trial), np.random.default_rng(0)).run()


joints_within = st.tuples(*(st.floats(a, b) for a, b in zip(ARM.lower, ARM.upper, strict=True))).map(np.array)


@given(joints_within, st.tuples(*(st.floats(-0.15, 0.15),) * 3).map(np.array))
def test_derivatives_of_the_residuals(joints: FloatArray, feature: FloatArray) -> None:
    def at(joints: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        r, J = np.empty(RESIDUALS), np.empty((RESIDUALS, 6))
        wanted = feature + np.array([0.05, 0.0, 0.1])
        cost = residuals(ARM.packed, 0.045, joints, feature - [0, 0, 0.12], 0.11, wanted, RULES, FACES, WEIGHTS, r, J)
        return cost, r, J

    cost, r, J = at(joints)
    step = 1e-7
    ahead = np.array([at(joints + step * axis)[0] - cost for axis in np.eye(6)]) / step
    behind = np.array([cost - at(joints - step * axis)[0] for axis in np.eye(6)]) / step
    tolerance = 1e-3 * (1 + np.abs(ahead).max())
    assume((np.abs(ahead - behind) < tolerance).all())  # not at a rule's border, where there is no slope
    # The cost's slope is J'r, Huber's loss and all.
    np.testing.assert_allclose(J.T @ r, (ahead + behind) / 2, atol=tolerance)


@pytest.mark.slow
def test_the_fit_reaches_the_naive_pose_where_it_can_be_had() -> None:
    trial = circling(1)
    base = inverse_transform(trial.T_world_base)
    feature = (base @ trial.T_world_feature[0])[:3, 3]
    wanted = ARM.forward(trial.start)[:3, 3]
    joints = ARM.clip(trial.start + np.array([0.1, 0.1, 0.01, 0.1, 0.1, 0.1]))
    far = np.array([[0, 0, 1, 1], [0, 0, 1, -9], [1, 0, 0, -9], [0, 0, 0, 0]], dtype=float)
    faces = np.array([[0, 0, 1.0, 9.0]])
    cost = fit(ARM.packed, 0.045, joints, ARM.lower, ARM.upper, feature, 0.11, wanted, far, faces, WEIGHTS, 50)
    assert cost < 1e-9
    np.testing.assert_allclose(ARM.forward(joints), ARM.forward(trial.start), atol=1e-6)


@pytest.mark.slow
def test_joints_whose_bounds_are_one_stay() -> None:
    trial = circling(1)
    feature = (inverse_transform(trial.T_world_base) @ trial.T_world_feature[0])[:3, 3]
    joints = ARM.clip(trial.start + np.array([0.05, 0.05, 0.01, 0.1, 0.1, 0.1]))
    lower, upper = ARM.lower, ARM.upper
    lower, upper = lower.copy(), upper.copy()
    lower[:3] = upper[:3] = joints[:3]
    kept = joints[:3].copy()
    fit(
        ARM.packed,
        0.045,
        joints,
        lower,
        upper,
        feature,
        0.11,
        np.zeros(3),
        RULES,
        FACES[:1] * 0 - [[0, 0, 0, -9]],
        WEIGHTS,
        50,
    )
    np.testing.assert_array_equal(joints[:3], kept)
    pose = ARM.forward(joints)
    towards = feature - pose[:3, 3]
    # Roll and wrist alone turn the camera to the feature, and level it.
    np.testing.assert_allclose(pose[:3, 2], towards / np.linalg.norm(towards), atol=1e-3)


def test_joints_meet_their_goals_together_and_do_not_pass_them() -> None:
    place, velocity, after, dt = np.zeros(2), np.zeros(2), np.empty(2), 0.0126
    goal, acceleration = np.array([0.4, -0.1]), np.array([1.5, 0.5])
    arrivals = np.zeros(2)
    for _ in range(200):
        change = acceleration * dt
        box = np.array([place + (velocity - change) * dt, place + (velocity + change) * dt])
        chase(place, goal, np.zeros(2), box, acceleration, dt, 1.0, after)
        velocity, place = (after - place) / dt, after.copy()
        assert (np.abs(place) <= np.abs(goal) + 1e-5).all()
        arrivals += np.abs(place - goal) > 1e-6
    np.testing.assert_allclose(place, goal)
    np.testing.assert_allclose(velocity, 0.0, atol=1e-9)
    assert abs(arrivals[0] - arrivals[1]) <= 1


def test_the_filter_follows_an_even_motion_without_lag() -> None:
    place, velocity = np.zeros(3), np.zeros(3)
    for k in range(1, 200):
        track(np.array([0.01, 0.02, -0.01]) * k, 0.5, 0.0126, place, velocity)
    np.testing.assert_allclose(place, np.array([0.01, 0.02, -0.01]) * 199, atol=1e-9)
    np.testing.assert_allclose(velocity * 0.0126, [0.01, 0.02, -0.01], atol=1e-9)


def test_an_unconstrained_ring_is_kept_in_view_at_the_wanted_distance() -> None:
    trial = circling(1200)
    errors = course_errors(run(trial), trial, make_scene(trial))
    settled = slice(100, None)
    assert errors["vva_deg"][settled].max() < 0.25
    assert errors["fd_mm"][settled].max() < 0.2
    assert errors["pf_deg"][settled].max() < 0.05
    # And in truth, at one moment, there is no lag: the prediction makes good period and servo.
    assert errors["vva_true_deg"][settled].mean() < 0.05


def test_a_normal_on_the_wrong_side_keeps_the_view_on_the_right_one() -> None:
    """The naive camera would be across; ours stays on its side, looks at the ring, and violates nothing."""
    steps = 600
    positions = np.tile([0.0, 0.0, 0.03], (steps, 1))
    normals = np.tile([0.6, -0.4, 0.7], (steps, 1))
    normals[100:] = [-0.5, -0.3, 0.8]
    trial = make_trial(feature_poses(positions, normals))
    course, scene = run(trial), make_scene(trial)
    errors = course_errors(course, trial, scene)
    poses = scene.T_world_base @ ARM.forward(course.joints)
    assert poses[-1, 0, 3] >= 0.0
    assert errors["vva_deg"].max() < 1.5
    assert errors["vva_deg"][-1] < 0.01
    assert errors["fd_mm"][-1] < 0.5
    assert reported_depths(course, trial, scene)["no_go"].max() < 0
    # No nearer place is allowed: the camera is on the border of its side.
    assert poses[-1, 0, 3] < 0.03


def test_the_same_trial_gives_the_same_course() -> None:
    trial = circling(300)
    np.testing.assert_array_equal(run(trial).setpoints, run(trial).setpoints)


@pytest.mark.slow
def test_no_world_brings_it_beyond_the_limits() -> None:
    """10,000 worlds of a few steps: features that jump, are far away, or in the camera; starts inside the zone."""
    rng = np.random.default_rng(0)
    for world in range(10_000):
        trial = random_trial(rng, 4)
        course = run(trial)
        assert np.isfinite(course.joints).all(), world
        assert ARM.within_limits(course.goals).all(), world
        assert ARM.within_limits(course.setpoints).all(), world
        assert ARM.within_limits(course.joints, 1e-12).all(), world
        assert not course.clipped.any(), world
