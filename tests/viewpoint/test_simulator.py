"""The loop between controllers and the arm: limits, lag, commands of all kinds, and errors by hand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray, inverse_transform, is_rigid, rigid_transform, rotation_from_vector
from surgbench.tasks.viewpoint.conformance.worlds import DT_S, circling, feature_poses, make_trial
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.contract import ViewCommand, ViewpointObservation, ViewpointScene
from surgbench.viewpoint.placement import naive_pose
from surgbench.viewpoint.receiver import InvalidCommandError, Receiver, _rigid
from surgbench.viewpoint.rules import find_events, reported_depths
from surgbench.viewpoint.scores import course_errors, naive_violations, view_errors
from surgbench.viewpoint.servo import JointServo
from surgbench.viewpoint.simulator import Course, Simulation, make_scene
from surgbench.viewpoint.trial import Trial

ARM = CameraArm()
HOME = np.array([-0.6, -0.5, 0.1, -2.8, -0.3, 0.2])


class Scripted:
    """A controller that does what a function says."""

    def __init__(self, answer: Callable[[ViewpointObservation, ViewpointScene], Any]) -> None:
        self._answer = answer

    def reset(self, scene: ViewpointScene, joints: FloatArray, rng: np.random.Generator) -> None:
        """Remember the scene."""
        self._scene = scene

    def step(self, observation: ViewpointObservation) -> Any:
        """Ask the function."""
        return self._answer(observation, self._scene)


def simulate(answer: Callable[[ViewpointObservation, ViewpointScene], Any], trial: Trial, **scene: Any) -> Course:
    """The course of a function as controller."""
    return Simulation(Scripted(answer), trial, make_scene(trial, **scene), np.random.default_rng(0)).run()


def test_joints_follow_a_step_with_their_time_constant() -> None:
    servo = JointServo(ARM, HOME, DT_S, 0.015)
    servo.servo(HOME + 1e-5, np.zeros(6))
    # The set point moves evenly during the step; the joint trails by the lag less what decayed.
    expected = 1e-5 - 1e-5 / DT_S * 0.015 * (1 - np.exp(-DT_S / 0.015))
    np.testing.assert_allclose(servo.joints - HOME, expected, rtol=1e-9)
    for _ in range(60):
        servo.servo(HOME + 1e-5, np.zeros(6))
    np.testing.assert_allclose(servo.joints, HOME + 1e-5, atol=1e-12)


def test_a_move_brings_all_joints_at_the_same_time_and_to_rest() -> None:
    servo = JointServo(ARM, HOME, DT_S, 0.0)
    goal = HOME + np.array([0.4, 0.1, 0.02, 1.0, 0.2, 0.1])
    shares = []
    for _ in range(400):
        servo.move(goal)
        shares.append((servo.setpoint - HOME) / (goal - HOME))
    shares_of_joints = np.array(shares)
    np.testing.assert_allclose(shares_of_joints[-1], 1.0, atol=1e-9)
    np.testing.assert_allclose(servo.velocity, 0.0, atol=1e-9)
    arrival = (shares_of_joints < 1 - 1e-6).sum(axis=0)
    assert np.ptp(arrival) <= 1
    # The yaw joint takes longest: 0.4 rad up and down at 90 deg/s^2.
    assert arrival[0] * DT_S == pytest.approx(2 * np.sqrt(0.4 / np.radians(90)), abs=2 * DT_S)


numbers = st.lists(st.floats(-6, 6), min_size=6, max_size=6).map(np.array)


@pytest.mark.slow
@given(st.lists(st.tuples(st.sampled_from(["move", "servo", "hold"]), numbers, numbers), min_size=1, max_size=40))
def test_no_command_brings_a_joint_beyond_its_limits(commands: list[tuple[str, FloatArray, FloatArray]]) -> None:
    """Of place, velocity and acceleration."""
    servo = JointServo(ARM, HOME, DT_S, 0.015)
    for mode, target, velocity in commands:
        before, speed = servo.setpoint, servo.velocity
        if mode == "move":
            servo.move(target)
        elif mode == "servo":
            servo.servo(before + 0.1 * target, velocity)
        else:
            servo.hold()
        assert ARM.within_limits(servo.setpoint)
        assert ARM.within_limits(servo.joints, 1e-12)
        assert (np.abs(servo.velocity) <= np.array(ARM.velocity) * (1 + 1e-6)).all()
        assert (np.abs(servo.velocity - speed) <= np.array(ARM.acceleration) * DT_S * (1 + 1e-6)).all()
        assert (np.abs(servo.setpoint - before) <= np.array(ARM.velocity) * DT_S * (1 + 1e-6)).all()


def test_an_arm_that_is_told_the_naive_pose_arrives_there() -> None:
    """A feature at rest: all errors vanish, as reported and in truth, for there is no registration error."""
    poses = np.repeat(feature_poses(np.array([[0.01, 0.0, 0.03]]), np.array([[0.6, -0.4, 0.7]])), 300, axis=0)
    start = ARM.inverse(inverse_transform(make_trial(poses).T_world_base) @ naive_pose(poses[0]))
    trial = make_trial(poses, start=ARM.clip(start + np.array([0.1, 0.1, 0.02, 0.2, 0.1, 0.1])))
    for answer in (
        lambda observation, scene: naive_pose(observation.T_world_feature),
        lambda observation, scene: scene.arm.inverse(
            inverse_transform(scene.T_world_base) @ naive_pose(observation.T_world_feature), observation.joints
        ),
    ):
        course = simulate(answer, trial)
        errors = course_errors(course, trial, make_scene(trial))
        assert not course.clipped.any()
        for name in ("vva_deg", "fd_mm", "pf_deg", "an_deg", "pn_mm", "vva_true_deg", "fd_true_mm"):
            assert errors[name][0] > 0.1 or name == "pf_deg"
            assert errors[name][-1] == pytest.approx(0.0, abs=1e-5)


def test_view_errors_by_hand() -> None:
    camera, feature = np.eye(4), feature_poses(np.array([0.0, 0.02, 0.1]), np.array([0.0, 0.0, -1.0]))
    camera[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    errors = view_errors(camera, feature, 0.11)
    assert errors["vva_deg"] == pytest.approx(np.degrees(np.arctan(0.2)))
    assert errors["fd_signed_mm"] == pytest.approx(1e3 * (np.hypot(0.02, 0.1) - 0.11))
    assert errors["fd_mm"] == pytest.approx(abs(errors["fd_signed_mm"]))
    assert errors["pf_deg"] == pytest.approx(0.0)
    assert errors["an_deg"] == pytest.approx(0.0, abs=1e-9)
    tilted = camera.copy()
    tilted[:3, :3] = camera[:3, :3] @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    assert view_errors(tilted, feature, 0.11)["an_deg"] == pytest.approx(90.0)


def test_the_distance_to_a_far_naive_pose_is_halved_as_published() -> None:
    """An arm that stays: from 40 mm away half of it counts, from 10 mm all."""
    trial = circling(3)
    scene = make_scene(trial)
    course = simulate(lambda observation, scene: observation.setpoint, trial)
    for shift, expected in ((0.04, 20.0), (0.01, 10.0)):
        moved = make_trial(trial.T_world_feature.copy(), start=trial.start)
        moved.T_world_feature[:, 0, 3] += shift
        errors = course_errors(course, moved, scene)
        assert errors["pn_full_mm"][0] == pytest.approx(1e3 * shift, rel=0.02)
        assert errors["pn_mm"][0] == pytest.approx(expected, rel=0.05)


def test_registration_error_shows_in_truth_alone() -> None:
    """Five millimetres across the view at 11 cm are 2.6 degrees."""
    trial = circling(200)
    assert trial.truth is not None
    across = (trial.T_world_base @ ARM.forward(trial.start))[:3, 0]
    trial.truth.T_world_base[:3, 3] += 0.005 * across
    course = simulate(lambda observation, scene: naive_pose(observation.T_world_feature), trial)
    errors = course_errors(course, trial, make_scene(trial, registration="none"))
    shift = errors["vva_true_deg"][150:] - errors["vva_deg"][150:]
    assert shift.mean() == pytest.approx(np.degrees(np.arctan(5 / 110)), abs=0.6)


def test_where_the_feature_is_not_measured_the_arm_comes_to_rest_and_nobody_is_asked() -> None:
    trial = circling(200)
    trial.T_world_feature[60:140] = np.nan
    asked = []

    def answer(observation: ViewpointObservation, scene: ViewpointScene) -> Any:
        asked.append(observation.index)
        return naive_pose(observation.T_world_feature)

    course = simulate(answer, trial)
    assert asked == [*range(60), *range(140, 200)]
    assert np.isfinite(course.joints).all()
    assert np.isnan(course.latency_ms[60:140]).all()
    np.testing.assert_allclose(course.joints[135:141], course.joints[[135]].repeat(6, axis=0), atol=1e-6)
    assert np.abs(course.joints[199] - course.joints[140]).max() > 1e-3
    errors = course_errors(course, trial, make_scene(trial))
    np.testing.assert_array_equal(np.isnan(errors["vva_deg"]), [60 <= k < 140 for k in range(200)])


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (None, "not a command|NaN"),
        (np.full(6, np.nan), "NaN or infinity"),
        (np.zeros(5), r"shape \(5,\)"),
        ([10**400, 0, 0, 0, 0, 0], "list, not a command of numbers"),
        (np.diag([2.0, 1, 1, 1]), r"no rotation: 1 off the nearest \(tolerance 0\.001"),
        (np.diag([-1.0, 1, 1, 1]), "a mirror image"),
        (rigid_transform(np.eye(3), np.array([0.1, 0.2, 0.3])).T, r"last row is 0\.3 off 0, 0, 0, 1.*transposed"),
        ("left", "str"),
        (ViewCommand(np.zeros(6), mode="fly"), "mode 'fly'"),  # type: ignore[arg-type]
        (ViewCommand(np.zeros(6), mode="servo", velocity=np.zeros(3)), r"velocity of shape \(3,\)"),
        (ViewCommand(np.zeros(6), active=("gravity",)), "unknown rule 'gravity'"),
    ],
)
def test_answers_that_are_no_commands_are_told_in_one_line(answer: Any, message: str) -> None:
    with pytest.raises(InvalidCommandError, match=message) as caught:
        simulate(lambda observation, scene: answer, circling(3))
    assert "\n" not in str(caught.value)


@given(st.integers(0, 2**32 - 1), st.sampled_from(["rounded", "scaled", "float16", "float32"]))
def test_a_pose_that_is_nearly_rigid_is_taken_as_the_nearest(seed: int, how: str) -> None:
    """As a file, a message or a lesser precision has it: the arm goes where the exact pose would have sent it."""
    rng = np.random.default_rng(seed)
    pose = rigid_transform(rotation_from_vector(rng.normal(0.0, 1.0, 3)), np.zeros(3))
    nearly = {
        "rounded": np.round(pose, 4),
        "scaled": pose * np.array([[1 + 1e-4] * 3 + [1.0]] * 3 + [[1.0] * 4]),
        "float16": pose.astype(np.float16).astype(np.float64),
        "float32": pose.astype(np.float32).astype(np.float64),
    }[how]
    taken = _rigid(nearly)
    assert is_rigid(taken)
    assert np.abs(taken - pose).max() < {"rounded": 1e-4, "scaled": 1e-12, "float16": 1e-3, "float32": 1e-6}[how]


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1e-9, 1e-7, 1e-6, 1e-4]))
def test_a_pose_is_received_as_the_arm_s_inverse_to_the_last_bit(seed: int, noise: float) -> None:
    """Compiled or not: the same joints, clipped, of poses that are rigid, nearly so, and out of reach."""
    rng = np.random.default_rng(seed)
    base = rigid_transform(rotation_from_vector(rng.normal(0.0, 0.1, 3)), rng.normal(0.0, 0.2, 3))
    scene = make_scene(make_trial(circling(3).T_world_feature, base, HOME), registration="none")
    near = rng.uniform(ARM.lower, ARM.upper)
    pose = base @ ARM.forward(rng.uniform(1.2 * ARM.lower, 1.2 * ARM.upper))
    pose[:3, :3] += rng.normal(0.0, noise, (3, 3))
    received = Receiver(scene)(pose, near)
    joints = ARM.inverse(inverse_transform(base) @ _rigid(pose), near)
    np.testing.assert_array_equal(received.goal, ARM.clip(joints))
    assert received.clipped == (np.abs(joints - ARM.clip(joints)).max() > 1e-9)
    assert (received.velocity, received.active, received.solver) == (None, (), False)


def test_an_exact_pose_stays_as_it_is_to_the_last_bit() -> None:
    pose = rigid_transform(rotation_from_vector(np.array([0.3, 1.0, -0.4])), np.array([0.1, 0.2, 0.3]))
    assert _rigid(pose) is pose


def test_what_was_done_before_a_bad_answer_is_kept() -> None:
    trial = circling(10)
    bad = Scripted(lambda observation, scene: observation.setpoint if observation.index < 4 else None)
    simulation = Simulation(bad, trial, make_scene(trial), np.random.default_rng(0))
    with pytest.raises(InvalidCommandError):
        simulation.run()
    assert (len(simulation.course.goals), len(simulation.course.joints)) == (4, 5)


def test_commands_beyond_the_limits_are_clipped_and_counted() -> None:
    course = simulate(lambda observation, scene: scene.arm.upper + 0.1, circling(400))
    assert course.clipped.all()
    np.testing.assert_allclose(course.joints[-1], ARM.upper, atol=1e-6)


def test_going_into_the_zone_is_one_event() -> None:
    trial = circling(200)
    scene = make_scene(trial)
    into = naive_pose(feature_poses(np.array([0.0, 0.0, 0.02]), np.array([0.6, -0.2, 0.7])), 0.01)
    course = simulate(lambda observation, scene: into, trial)
    found = find_events(reported_depths(course, trial, scene)["no_go"], "no_go")
    assert (found.count, found.longest) == (1, found.samples)
    assert found.deepest > 10.0
    away = simulate(lambda observation, scene: observation.setpoint, trial)
    assert find_events(reported_depths(away, trial, scene)["no_go"], "no_go").count == 0


def test_an_arm_that_starts_outside_its_limits_is_an_error() -> None:
    trial = make_trial(circling(3).T_world_feature, start=ARM.upper + 0.1)
    with pytest.raises(DatasetError, match="outside its joint limits"):
        make_scene(trial)


def test_the_same_samples_are_constrained_whatever_the_controller_does() -> None:
    trial = circling(300)
    assert not naive_violations(trial, make_scene(trial)).any.any()
    normals = np.tile([-0.5, 0.1, 0.8], (300, 1))
    turned = make_trial(feature_poses(trial.T_world_feature[:, :3, 3], normals))
    assert naive_violations(turned, make_scene(turned)).orientation.all()
