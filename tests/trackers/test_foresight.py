"""The optimum in hindsight: its derivatives, that the arm can do what it plans, that nobody else sees the future."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from surgbench.geometry import FloatArray
from surgbench.tasks.viewpoint.conformance.worlds import circling
from surgbench.trackers.foreseeing.model import RULES, TERMS, clearances, judge
from surgbench.trackers.foresight import Foresight, ForesightConfig
from surgbench.trackers.gaze import Gaze, GazeConfig
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.contract import ViewpointObservation, ViewpointScene
from surgbench.viewpoint.scores import course_errors
from surgbench.viewpoint.simulator import Simulation, make_scene

ARM = CameraArm()
UP = np.array([0.0, 0.0, 1.0])
FACES = np.array(
    [[0, 0, 1, -0.19], [0, 0, -1, 0.14], [1, 0, 0, -0.1], [-1, 0, 0, -0.1], [0, 1, 0, 0.0], [0, -1, 0, -0.1]]
)
PLANES = np.array([[0, 0, 1, -0.15], [1, 0, 0, 0.08]], dtype=float)
joints_within = st.tuples(*(st.floats(a, b) for a, b in zip(ARM.lower, ARM.upper, strict=True))).map(np.array)
points = st.tuples(*(st.floats(-0.15, 0.15),) * 3).map(np.array)


def slopes(values: Any, joints: FloatArray, step: float = 1e-6) -> FloatArray:
    """``(m, 6)`` central differences of ``(m,)`` values."""
    return np.stack([(values(joints + step * a) - values(joints - step * a)) / (2 * step) for a in np.eye(6)], axis=1)


@given(joints_within, points)
def test_derivatives_of_the_cost(joints: FloatArray, feature: FloatArray) -> None:
    wanted = np.stack([feature, feature + np.array([0.05, 0.0, 0.1])])[None]
    r, J = np.empty((1, TERMS)), np.empty((1, TERMS, 6))

    def at(joints: FloatArray) -> FloatArray:
        judge(ARM.packed, ARM.camera_m, joints[None], wanted, 0.11, np.ones(4), UP, r, J)
        return np.array(r[0])

    place = (ARM.forward(joints))[:3, 3]
    assume(np.linalg.norm(place - feature) > 0.01)
    numeric = slopes(at, joints)
    at(joints)
    np.testing.assert_allclose(J[0], numeric, atol=1e-5)


@given(joints_within, points)
def test_derivatives_of_the_clearances(joints: FloatArray, feature: FloatArray) -> None:
    clear, J = np.empty((1, RULES)), np.empty((1, RULES, 6))

    def at(joints: FloatArray) -> FloatArray:
        clearances(ARM.packed, ARM.camera_m, joints[None], feature[None], PLANES, FACES, clear, J)
        return np.array(clear[0])

    place = ARM.forward(joints)[:3, 3]
    assume(np.linalg.norm(place - feature) > 0.01)
    behind = np.sort(FACES[:, :3] @ place - FACES[:, 3])
    assume(behind[1] - behind[0] > 1e-4)  # where two faces are as near as each other there is no slope
    numeric = slopes(at, joints)
    at(joints)
    np.testing.assert_allclose(J[0], numeric, atol=1e-5)


def test_the_terms_are_those_of_the_cost_that_is_scored() -> None:
    trial = circling(3)
    scene = make_scene(trial)
    course = Simulation(Gaze(GazeConfig()), trial, scene, np.random.default_rng(0)).run()
    foresight = Foresight(ForesightConfig())
    foresight._scene = scene
    problem = foresight._problem(trial.T_world_feature, trial.start, np.zeros(6))
    r, J = np.empty((3, TERMS)), np.empty((3, TERMS, 6))
    judge(
        problem.arm, problem.reach_m, course.joints[1:], problem.wanted, problem.distance_m, problem.weights,
        problem.up, r, J,
    )  # fmt: skip
    scored = course_errors(course, trial, scene)["view_cost"]
    np.testing.assert_allclose((r**2).sum(axis=1), scored, rtol=1e-3, atol=1e-9)


@pytest.mark.extras
@pytest.mark.slow
def test_the_plan_is_what_the_arm_does_and_better_than_any_controllers() -> None:
    pytest.importorskip("clarabel")
    trial = circling(240, radius_m=0.03, period_s=2.5)
    scene = make_scene(trial)

    def mean_cost(controller: Any) -> float:
        course = Simulation(controller, trial, scene, np.random.default_rng(0)).run()
        if isinstance(controller, Foresight):
            np.testing.assert_allclose(course.setpoints[1:], controller._plan, atol=1e-9)
        return float(course_errors(course, trial, scene)["view_cost"].mean())

    foresight = Foresight(ForesightConfig(rounds=6))
    best = mean_cost(foresight)
    assert best < mean_cost(Gaze(GazeConfig()))
    totals = [merit.total for merit in foresight.merits]
    assert totals == sorted(totals, reverse=True)
    assert foresight.merits[-1].broken_m == 0.0


@pytest.mark.extras
@pytest.mark.slow
def test_after_a_gap_it_plans_anew_from_where_the_arm_was_brought_to_rest() -> None:
    pytest.importorskip("clarabel")
    trial = circling(90)
    trial.T_world_feature[40:55] = np.nan
    scene = make_scene(trial)
    foresight = Foresight(ForesightConfig(rounds=3))
    course = Simulation(foresight, trial, scene, np.random.default_rng(0)).run()
    assert not course.asked[40:55].any()
    errors = course_errors(course, trial, scene)
    assert errors["vva_deg"][80:].max() < 0.5
    assert ARM.within_limits(course.setpoints, 1e-9).all()


def test_a_controller_is_told_no_future_unless_it_says_that_it_foresees() -> None:
    told: list[Any] = []

    class Curious:
        name = "curious"
        task = "viewpoint"

        def reset(self, scene: ViewpointScene, joints: FloatArray, rng: np.random.Generator) -> None:
            told.append(scene.future)

        def step(self, observation: ViewpointObservation) -> FloatArray:
            return observation.setpoint

    class Seer(Curious):
        foresees = True

    trial = circling(5)
    for controller in (Curious(), Seer()):
        Simulation(controller, trial, make_scene(trial), np.random.default_rng(0), 4)
    assert told[0] is None
    np.testing.assert_array_equal(told[1], trial.T_world_feature[:4])


def test_without_a_future_it_holds() -> None:
    trial = circling(3)
    foresight = Foresight(ForesightConfig())
    foresight.reset(make_scene(trial), trial.start, np.random.default_rng(0))
    still = np.zeros(6)
    command = foresight.step(ViewpointObservation(0, 0.0, trial.T_world_feature[0], trial.start, trial.start, still))
    np.testing.assert_array_equal(command.target, trial.start)
