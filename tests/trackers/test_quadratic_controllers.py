"""Controllers that solve quadratic programs: what they linearise, their priorities, and that they keep limits."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray, inverse_transform
from surgbench.registry import create, find
from surgbench.tasks.viewpoint.conformance.worlds import circling, feature_poses, make_trial, random_trial
from surgbench.trackers.hierarchy import descend
from surgbench.trackers.horizon import HorizonConfig, Program
from surgbench.trackers.linearised.task import ViewTask
from surgbench.trackers.linearised.view import ERRORS, RULES, linearise
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.contract import ViewpointObservation
from surgbench.viewpoint.rules import reported_depths
from surgbench.viewpoint.scores import course_errors
from surgbench.viewpoint.simulator import Course, Simulation, make_scene
from surgbench.viewpoint.trial import Trial

pytestmark = pytest.mark.extras
pytest.importorskip("daqp")

ARM = CameraArm()
NAMES = ("horizon", "hierarchy")
WIDE = np.array([np.full(6, -10.0), np.full(6, 10.0)])
joints_within = st.tuples(*(st.floats(a, b) for a, b in zip(ARM.lower, ARM.upper, strict=True))).map(np.array)


def run(name: str, trial: Trial, **options: Any) -> Course:
    """The course of a trial."""
    return Simulation(create(find("tracker", name), options), trial, make_scene(trial), np.random.default_rng(0)).run()


def task() -> ViewTask:
    return ViewTask(make_scene(circling(2)), 0.7, 0.5)


# What is linearised.


@given(joints_within, st.tuples(*(st.floats(-0.1, 0.1),) * 3).map(np.array))
def test_derivatives_of_errors_and_depths(joints: FloatArray, feature: FloatArray) -> None:
    one = task()

    def at(joints: FloatArray) -> tuple[FloatArray, FloatArray]:
        error, J, depth, slope = np.empty(ERRORS), np.empty((ERRORS, 6)), np.empty(RULES), np.empty((RULES, 6))
        linearise(
            one.arm, one.reach_m, joints, feature - [0, 0, 0.2], feature, 0.11, one.rules, one.faces, error, J, depth,
            slope,
        )  # fmt: skip
        return np.concatenate([error, depth]), np.concatenate([J, slope])

    step = 1e-6
    value, slopes = at(joints)
    ahead = np.column_stack([at(joints + step * axis)[0] - value for axis in np.eye(6)]) / step
    behind = np.column_stack([value - at(joints - step * axis)[0] for axis in np.eye(6)]) / step
    assume((np.abs(ahead - behind) < 1e-3 * (1 + np.abs(ahead))).all())  # not at an edge of the zone
    np.testing.assert_allclose(slopes, (ahead + behind) / 2, atol=2e-4 * (1 + np.abs(ahead).max()))


def test_depths_are_those_of_the_scores() -> None:
    """In the arm's own frame what the world's rules say."""
    trial = circling(2)
    scene, one = make_scene(trial), task()
    feature = (inverse_transform(scene.T_world_base) @ trial.T_world_feature[0])[:3, 3]
    error, J, depth, slope = np.empty(ERRORS), np.empty((ERRORS, 6)), np.empty(RULES), np.empty((RULES, 6))
    linearise(one.arm, one.reach_m, trial.start, feature, feature, 0.11, one.rules, one.faces, error, J, depth, slope)
    place = (scene.T_world_base @ ARM.forward(trial.start))[:3, 3]
    apart = np.linalg.norm(place - trial.T_world_feature[0, :3, 3])
    assert depth[0] == pytest.approx(float(scene.workspace.below_floor(place)))
    assert depth[1] == pytest.approx(float(scene.workspace.zone.depth(place)))
    assert depth[2] == pytest.approx(scene.workspace.proximity_m - apart)
    assert error[4] == pytest.approx(apart - 0.11)
    np.testing.assert_allclose(error[:4], 0.0, atol=1e-9)  # the trial starts where it sees the ring


@given(joints_within, st.tuples(*(st.floats(-1, 1),) * 6).map(np.array), st.integers(0, 1))
def test_from_what_is_reachable_every_joint_can_stop(joints: FloatArray, share: FloatArray, side: int) -> None:
    one = task()
    # A velocity from which it can stop.
    toward = np.where(share > 0, one.upper - joints, joints - one.lower)
    fastest = np.minimum(one.velocity, np.sqrt(2 * one.acceleration * np.maximum(toward, 0.0)))
    setpoint, velocity = joints.copy(), 0.9 * share * fastest
    for _ in range(40):
        box = one.reachable(setpoint, velocity)
        assert (box[0] <= box[1] + 1e-15).all()
        after = box[side]
        change = (after - setpoint) / one.dt_s
        assert (np.abs(change) <= one.velocity * (1 + 1e-9)).all()
        assert (np.abs(change - velocity) <= one.acceleration * one.dt_s * (1 + 1e-6) + 1e-9).all()
        assert ARM.within_limits(after)
        setpoint, velocity = after, change


# The order of priorities.


@given(st.integers(0, 2**32 - 1))
def test_no_task_is_done_at_the_cost_of_one_before_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    box = np.array([-rng.uniform(0.1, 1, 6), rng.uniform(0.1, 1, 6)])
    tasks = [(rng.normal(size=(rows, 6)), rng.normal(size=rows), box) for rows in (2, 1, 1, 3)]
    slope, allowed = rng.normal(size=(2, 6)), rng.uniform(0, 0.3, 2)
    misses = []
    for count in range(1, 5):
        step = descend(box, slope, allowed, tasks[:count])
        assert (step >= box[0] - 1e-12).all()
        assert (step <= box[1] + 1e-12).all()
        assert (slope @ step <= allowed + 1e-6).all()
        misses.append([np.linalg.norm(matrix @ step - wanted) for matrix, wanted, _ in tasks[:count]])
    for fewer, more in pairwise(misses):
        np.testing.assert_allclose(more[: len(fewer)], fewer, atol=1e-5)


@given(st.integers(0, 2**32 - 1))
def test_with_nothing_in_the_way_it_is_the_task_priority_of_the_textbooks(seed: int) -> None:
    """The second task in the null space of the first (Siciliano and Slotine 1991)."""
    rng = np.random.default_rng(seed)
    (A, a), (B, b) = ((rng.normal(size=(rows, 6)), 0.1 * rng.normal(size=rows)) for rows in (2, 3))
    step = descend(WIDE, np.zeros((1, 6)), np.ones(1), [(A, a, WIDE), (B, b, WIDE)])
    first = np.linalg.pinv(A) @ a
    free = np.eye(6) - np.linalg.pinv(A) @ A
    expected = first + np.linalg.pinv(B @ free) @ (b - B @ first)
    np.testing.assert_allclose(step, expected, atol=1e-5)


def test_a_rule_that_cannot_be_kept_is_broken_as_little_as_can_be_and_not_for_a_task() -> None:
    box = np.array([np.full(6, -0.1), np.full(6, 0.1)])
    slope, allowed = np.eye(6)[:1], np.array([-0.5])  # as far back as it can go is not far enough
    step = descend(box, slope, allowed, [(np.eye(6)[:1], np.array([0.1]), box)])
    assert step[0] == pytest.approx(-0.1)


def test_a_task_does_not_leave_its_own_box() -> None:
    own = np.array([np.full(6, -0.01), np.full(6, 0.02)])
    step = descend(WIDE, np.zeros((1, 6)), np.ones(1), [(np.eye(6), np.full(6, 0.5), own)])
    np.testing.assert_allclose(step, 0.02, atol=1e-9)


# The horizon's program.


def test_with_no_constraint_at_work_the_program_is_newtons_step() -> None:
    rng, one = np.random.default_rng(0), task()
    steps = np.array([1, 2, 4])
    middle = (one.lower + one.upper) / 2
    plan = np.tile(middle, (3, 1))
    factors = rng.normal(size=(3, 6, 6))
    hessian = factors @ np.swapaxes(factors, 1, 2) + np.eye(6)
    gradient = 1e-7 * rng.normal(size=(3, 6))
    config = HorizonConfig(steps=(1, 2, 4), effort=1e-12)
    box = middle + np.array([[-1.0], [1.0]])
    change = Program(one, steps, config).solve(
        plan, middle, np.zeros(6), box, hessian, gradient, np.full((3, RULES), -1.0), np.zeros((3, RULES, 6))
    )
    expected = -np.linalg.solve(hessian, gradient[:, :, None])[:, :, 0]
    np.testing.assert_allclose(change, expected, rtol=1e-3, atol=1e-11)


def test_the_planned_set_points_keep_velocities_accelerations_and_rules() -> None:
    one = task()
    steps = np.array([1, 2, 4, 8])
    middle = (one.lower + one.upper) / 2
    plan = np.tile(middle, (4, 1))
    hessian = np.tile(np.eye(6), (4, 1, 1))
    gradient = np.full((4, 6), -1e3)  # on, as far as it goes
    slope = np.zeros((4, RULES, 6))
    slope[:, 0, 0] = 1.0
    depth = np.full((4, RULES), -1.0)
    depth[:, 0] = -0.03
    change = Program(one, steps, HorizonConfig(steps=(1, 2, 4, 8))).solve(
        plan, middle, np.zeros(6), one.reachable(middle, np.zeros(6)), hessian, gradient, depth, slope
    )
    between_s = one.dt_s * steps[:, None]
    velocity = np.diff(change, axis=0, prepend=np.zeros((1, 6))) / between_s
    assert (velocity <= one.velocity + 1e-6).all()
    gained = np.diff(velocity, axis=0, prepend=np.zeros((1, 6)))
    over_s = (between_s + np.vstack([between_s[:1], between_s[:-1]])) / 2
    assert (np.abs(gained) <= one.acceleration * over_s * (1 + 1e-6) + 1e-6).all()
    assert change[:, 0].max() == pytest.approx(0.03 - 0.002, abs=1e-5)


# As controllers.


@pytest.mark.parametrize(("name", "most_fd_mm"), [("horizon", 0.5), ("hierarchy", 1.0)])
def test_an_unconstrained_ring_is_kept_in_view(name: str, most_fd_mm: float) -> None:
    trial = circling(500)
    errors = course_errors(run(name, trial), trial, make_scene(trial))
    settled = slice(100, None)
    assert errors["vva_deg"][settled].max() < 0.25
    assert errors["pf_deg"][settled].max() < 0.05
    assert errors["fd_mm"][settled].max() < most_fd_mm
    assert errors["pn_full_mm"][settled].max() < 3.0


@pytest.mark.parametrize("name", NAMES)
def test_a_normal_on_the_wrong_side_breaks_no_rule(name: str) -> None:
    steps = 400
    positions = np.tile([0.0, 0.0, 0.03], (steps, 1))
    normals = np.tile([0.6, -0.4, 0.7], (steps, 1))
    normals[100:] = [-0.5, -0.3, 0.8]
    trial = make_trial(feature_poses(positions, normals))
    course, scene = run(name, trial), make_scene(trial)
    errors = course_errors(course, trial, scene)
    assert errors["vva_deg"].max() < 3.0
    assert errors["vva_deg"][-1] < 0.1
    assert errors["fd_mm"][-1] < 1.0
    depths = reported_depths(course, trial, scene)
    for rule in ("no_go", "floor", "proximity"):
        assert depths[rule].max() < 0.0
    place = (scene.T_world_base @ ARM.forward(course.joints[-1]))[:3, 3]
    assert -0.002 < place[0] < 0.03  # at the border of its side


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, 0.0])
def test_a_feature_that_is_none_holds_the_set_point(name: str, value: float) -> None:
    trial = circling(3)
    asked = create(find("tracker", name), {})
    asked.reset(make_scene(trial), trial.start, np.random.default_rng(0))
    still = np.zeros(6)
    asked.step(ViewpointObservation(0, 0.0, trial.T_world_feature[0].copy(), trial.start, trial.start, still))
    command = asked.step(ViewpointObservation(1, 0.01, np.full((4, 4), value), trial.start, trial.start, still))
    np.testing.assert_array_equal(command.target, trial.start)
    after = asked.step(ViewpointObservation(2, 0.02, trial.T_world_feature[2], trial.start, trial.start, still))
    assert np.isfinite(after.target).all()


@pytest.mark.slow
@settings(max_examples=30)
@given(st.sampled_from(NAMES), st.integers(0, 2**32 - 1))
def test_no_world_brings_them_beyond_the_limits(name: str, seed: int) -> None:
    for world in range(5):
        course = run(name, random_trial(np.random.default_rng([seed, world]), 4))
        assert np.isfinite(course.joints).all()
        assert ARM.within_limits(course.setpoints).all()
        assert not course.clipped.any()


@pytest.mark.parametrize("name", NAMES)
def test_a_camera_in_the_feature_is_no_division_by_zero(name: str) -> None:
    trial = circling(20)
    scene = make_scene(trial)
    trial.T_world_feature[:, :3, 3] = (scene.T_world_base @ ARM.forward(trial.start))[:3, 3]
    course = run(name, replace(trial))
    assert np.isfinite(course.joints).all()
    assert not course.clipped.any()


@pytest.mark.parametrize("name", NAMES)
def test_without_its_solver_it_says_what_to_install(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surgbench.extras.find_spec", lambda module: None)
    assert find("tracker", name).unavailable == "daqp is not installed: pip install 'surgbench[control]'"
    with pytest.raises(ConfigError, match="daqp is not installed"):
        run(name, circling(2))


def test_options_are_checked() -> None:
    for name, options in (("horizon", {"steps": (3,)}), ("horizon", {"gaze_rad": 0.0}), ("hierarchy", {"settle_s": 0})):
        with pytest.raises(ConfigError):
            create(find("tracker", name), options)
