"""Worlds stepped in compiled code, and the Gymnasium environment over them: the simulator's course, to the last bit."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgbench.errors import ConfigError, DatasetError
from surgbench.geometry import FloatArray, inverse_transform
from surgbench.tasks.viewpoint.conformance.worlds import DT_S, circling, feature_poses, make_trial, random_trial
from surgbench.viewpoint.arm_files import load_camera_arm
from surgbench.viewpoint.contract import ViewCommand, ViewpointObservation, ViewpointScene
from surgbench.viewpoint.scores import course_errors
from surgbench.viewpoint.servo import JointServo
from surgbench.viewpoint.simulator import SERVO_LAG_S, Course, Simulation, make_scene
from surgbench.viewpoint.trial import Trial
from surgbench.viewpoint.worlds import DEPTHS, ERRORS, Worlds

DOCUMENT = Path(__file__).parents[2] / "docs" / "viewpoint-bridge.md"
ALL = np.ones(1, dtype=bool)
FIRST = np.zeros(1, dtype=np.int64)


def one_world(trial: Trial, **how: Any) -> Worlds:
    worlds = Worlds([trial], 1, **how)
    worlds.begin(ALL, FIRST)
    return worlds


class Played:
    """A controller that commands the set points of another run."""

    def __init__(self, setpoints: FloatArray) -> None:
        self._setpoints = setpoints

    def reset(self, scene: Any, joints: FloatArray, rng: np.random.Generator) -> None: ...

    def step(self, observation: ViewpointObservation) -> ViewCommand:
        return ViewCommand(self._setpoints[observation.index + 1], mode="servo")


def wild(rng: np.random.Generator, steps: int) -> FloatArray:
    """Shares of the largest velocities that stay for a while, many beyond what a joint can do."""
    return np.repeat(rng.uniform(-1.5, 1.5, (steps // 20 + 1, 6)), 20, axis=0)[:steps]


def beyond(course: Course, trial: Trial, scene: ViewpointScene) -> dict[str, FloatArray]:
    """How far beyond each rule the camera was after each step, by transforms."""
    count, workspace = len(course.goals), scene.workspace
    feature = trial.T_world_feature[np.minimum(np.arange(1, count + 1), len(trial.timestamps_s) - 1), :3, 3]
    found = []
    for joints in (course.joints[1:], course.setpoints[1:]):
        pose = scene.T_world_base @ scene.arm.forward(joints)
        place = pose[:, :3, 3]
        away = np.linalg.norm(place - feature, axis=1)
        side = np.degrees(np.arcsin(pose[:, :3, 1] @ np.array(workspace.preferred_side)))
        depth, below = workspace.zone.depth(place), workspace.below_floor(place)
        found.append([1e3 * depth, 1e3 * below, side, 1e3 * (workspace.proximity_m - away)])
    return dict(zip(DEPTHS, np.max(found, axis=0), strict=True))


# --- worlds


@pytest.mark.slow
@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1))
def test_a_world_is_the_servo_to_the_last_bit_and_keeps_every_limit(seed: int) -> None:
    """For any start and any actions: what is commanded can be done, so that the servo does it without planning."""
    rng = np.random.default_rng(seed)
    trial = random_trial(rng, 120)
    trial.T_world_feature[np.isnan(trial.T_world_feature)] = 0.0  # measured throughout
    worlds, arm = one_world(trial), make_scene(trial).arm
    servo = JointServo(arm, trial.start, DT_S, SERVO_LAG_S)
    servo._plan = None  # type: ignore[assignment, method-assign]
    for shares in wild(rng, 120):
        before = worlds.state[0].copy()
        worlds.step(shares[None])
        setpoint, velocity, joints = worlds.state[0]
        servo.servo(setpoint, np.zeros(6))
        for here, there in ((servo.setpoint, setpoint), (servo.velocity, velocity), (servo.joints, joints)):
            np.testing.assert_array_equal(here, there)
        assert arm.within_limits(setpoint)
        assert (np.abs(velocity) <= np.array(arm.velocity) * (1 + 1e-9)).all()
        assert (np.abs(velocity - before[1]) <= np.array(arm.acceleration) * DT_S * (1 + 1e-8)).all()


def test_a_joint_that_is_told_to_run_into_its_limit_stops_there() -> None:
    worlds, arm = one_world(circling(400)), make_scene(circling(3)).arm
    for _ in range(400):
        worlds.step(np.ones((1, 6)))
    np.testing.assert_allclose(worlds.state[0, 0], arm.upper, atol=1e-4)
    np.testing.assert_allclose(worlds.state[0, 1], 0.0, atol=1e-2)


def test_a_velocity_within_reach_is_kept_exactly_and_no_number_is_rest() -> None:
    worlds = one_world(circling(10))
    share = 0.5 * DT_S * np.array(make_scene(circling(3)).arm.acceleration) / make_scene(circling(3)).arm.velocity
    for _ in range(2):
        worlds.step(share[None])
    np.testing.assert_allclose(worlds.state[0, 1], share * make_scene(circling(3)).arm.velocity, rtol=1e-9)
    for _ in range(2):
        worlds.step(np.full((1, 6), np.nan))
    np.testing.assert_allclose(worlds.state[0, 1], 0.0, atol=1e-12)
    assert np.isfinite(worlds.seen).all()


def test_joints_that_are_locked_stay() -> None:
    """An endoscope's arm, whose wrist is straight."""
    arm = load_camera_arm("ecm").arm()
    worlds = one_world(replace(circling(50), arm=arm, start=arm.middle))
    for shares in wild(np.random.default_rng(0), 50):
        worlds.step(shares[None])
    moved = worlds.state[0, 0] != arm.middle
    np.testing.assert_array_equal(moved, ~arm.locked)


def test_the_errors_are_those_of_a_run_with_the_same_set_points() -> None:
    """Every error, every depth and the cost, of a camera that goes astray, and into the zone."""
    rng = np.random.default_rng(3)
    normals = np.column_stack([rng.normal(0.5, 0.3, 300), rng.normal(-0.3, 0.3, 300), np.full(300, 0.4)])
    places = np.array([0.0, 0.0, 0.01]) + np.cumsum(rng.normal(0, 3e-4, (300, 3)), axis=0)
    trial = make_trial(feature_poses(places, normals))
    assert trial.truth is not None
    trial.T_world_base[:3, 3] += 0.02  # the registration has something to do
    worlds, scene = one_world(trial, registration="rigid"), make_scene(trial, registration="rigid")
    states, views, costs, seen = [worlds.state[0, 0].copy()], [], [], []
    for shares in wild(rng, 300):
        seen.append(worlds.seen[0].copy())
        worlds.step(0.05 * shares[None])
        states.append(worlds.state[0, 0].copy())
        views.append(worlds.views[0].copy())
        costs.append(worlds.costs[0, 0])
    course = Simulation(Played(np.array(states)), trial, scene, rng).run()
    np.testing.assert_array_equal(course.setpoints, states)
    np.testing.assert_array_equal(course.joints[-1], worlds.state[0, 2])
    expected = course_errors(course, trial, scene)
    for name, values in zip(ERRORS, np.array(views).T[: len(ERRORS)], strict=True):
        np.testing.assert_allclose(values, expected[name], rtol=1e-7, atol=1e-7, err_msg=name)
    np.testing.assert_allclose(costs, expected["view_cost"], rtol=1e-7)
    for name, values in zip(DEPTHS, np.array(views).T[len(ERRORS) :], strict=True):
        np.testing.assert_allclose(values, beyond(course, trial, scene)[name], atol=1e-8, err_msg=name)
    # What is seen before each step, by transforms.
    T_camera_world = inverse_transform(scene.T_world_base @ scene.arm.forward(course.joints[:-1]))
    feature = T_camera_world @ trial.T_world_feature
    up = T_camera_world[:, :3, 2]
    in_base = inverse_transform(scene.T_world_base) @ trial.T_world_feature
    parts = [feature[:, :3, 3], feature[:, :3, 1], up, in_base[:, :3, 3], in_base[:, :3, 1]]
    np.testing.assert_allclose(seen, np.hstack(parts), atol=1e-12)


def test_where_the_feature_is_not_measured_the_arm_comes_to_rest_and_the_last_place_is_seen() -> None:
    trial = circling(120)
    trial.T_world_feature[:5] = np.nan
    trial.T_world_feature[40:100] = np.nan
    worlds = one_world(trial)
    place = []
    for index in range(119):
        assert worlds.measured[0] == trial.measured[index]
        place.append(worlds.seen[0, 9:12].copy())
        assert np.isfinite(worlds.seen).all()
        if index < 5:  # it has never been measured: straight ahead
            np.testing.assert_allclose(worlds.seen[0, :6], [0, 0, trial.distance_m, 0, 0, -1], atol=1e-12)
            assert (worlds.costs[0] == 0.0).all()
        worlds.step(np.full((1, 6), 0.05))
        if index < 5 or 80 < index < 100:
            np.testing.assert_array_equal(worlds.state[0, 1], 0.0)
    np.testing.assert_array_equal(place[40:100], np.tile(place[39], (60, 1)))
    assert np.abs(worlds.state[0, 1]).max() > 0


@pytest.mark.slow
def test_strange_worlds_stay_finite_and_within_the_limits() -> None:
    rng = np.random.default_rng(0)
    trials = [random_trial(rng, 6) for _ in range(200)]
    worlds = Worlds(trials, 200)
    worlds.begin(np.ones(200, dtype=bool), np.arange(200))
    for _ in range(6):
        worlds.step(rng.choice([-9.0, -1.0, 0.0, 1.0, np.nan, np.inf], (200, 6)))
        for values in (worlds.state, worlds.seen, worlds.views):
            assert np.isfinite(values).all()
        assert make_scene(trials[0]).arm.within_limits(worlds.state[:, 0]).all()
    assert worlds.ended.all()


def test_no_trial_is_no_environment() -> None:
    with pytest.raises(DatasetError, match="at least one trial"):
        Worlds([], 1)


# --- the environment


@pytest.fixture
def gym() -> Any:
    """Gymnasium, with the environment registered."""
    gymnasium = pytest.importorskip("gymnasium")
    import surgbench.viewpoint.environment  # noqa: F401 (registers it)

    return gymnasium


TRIALS = [circling(40), circling(60, radius_m=0.01, period_s=5.0)]


@pytest.mark.extras
def test_what_is_wrong_is_told_in_one_line(gym: Any) -> None:
    from surgbench.viewpoint.environment import ViewpointEnv, ViewpointVectorEnv

    for wrong, said in (({"registration": "rigit"}, "did you mean 'rigid'"), ({"steps": 0}, "steps is 0")):
        with pytest.raises(ConfigError, match=said):
            ViewpointEnv(trials=TRIALS, **wrong)
    one, many = ViewpointEnv(trials=TRIALS), ViewpointVectorEnv(2, trials=TRIALS)
    for environment in (one, many):
        with pytest.raises(ConfigError, match="unknown option of reset 'trail'; did you mean 'trial'"):
            environment.reset(options={"trail": TRIALS[0].id})
        environment.reset()
    with pytest.raises(ConfigError, match=r"an action is of shape \(6,\), one velocity for each joint; not \(5,\)"):
        one.step(np.zeros(5))
    with pytest.raises(ConfigError, match=r"of shape \(2, 6\).*; not \(6,\)"):
        many.step(np.zeros(6))


@pytest.mark.extras
def test_gymnasium_s_own_checks_pass(gym: Any) -> None:
    from gymnasium.utils.env_checker import check_env

    check_env(gym.make("surgbench.viewpoint.environment:surgbench/Viewpoint-v0", trials=TRIALS).unwrapped)


@pytest.mark.extras
def test_an_episode_is_a_trial_and_its_reward_is_the_cost(gym: Any) -> None:
    from surgbench.viewpoint.environment import BROKEN_COST, observation_slices

    env = gym.make("surgbench/Viewpoint-v0", trials=TRIALS[:1], steps=30)
    observation, info = env.reset(seed=0)
    assert info == {"trial": "world"}
    parts = observation_slices()
    assert parts["measured"] == slice(37, 38)
    np.testing.assert_allclose(observation[parts["joints"]], TRIALS[0].start, atol=1e-6)
    actions, rewards, setpoints = wild(np.random.default_rng(0), 30).clip(-1, 1).astype(np.float32), [], []
    for index, action in enumerate(actions):
        observation, reward, terminated, truncated, info = env.step(action)
        rewards.append(reward)
        setpoints.append(env.unwrapped.episodes.worlds.state[0, 0].copy())
        assert env.observation_space.contains(observation)
        assert (terminated, truncated) == (False, index == 29)
    with pytest.raises(gym.error.ResetNeeded):
        env.unwrapped.step(actions[0])
    scene = make_scene(TRIALS[0])
    played = Played(np.array([TRIALS[0].start, *setpoints]))
    course = Simulation(played, TRIALS[0], scene, np.random.default_rng(0), 30).run()
    broken = np.sum([np.maximum(depth, 0.0) for depth in beyond(course, TRIALS[0], scene).values()], axis=0)
    cost = course_errors(course, TRIALS[0], scene)["view_cost"] + BROKEN_COST * broken
    np.testing.assert_allclose(rewards, -cost, rtol=1e-6)
    assert info["vva_deg"] == pytest.approx(course_errors(course, TRIALS[0], scene)["vva_deg"][-1])


@pytest.mark.extras
def test_many_worlds_are_as_many_single_ones(gym: Any) -> None:
    """Over the ends of their trials, each with its own seed."""
    count = 5
    many = gym.make_vec("surgbench/Viewpoint-v0", num_envs=count, trials=TRIALS)
    singles = [gym.make("surgbench/Viewpoint-v0", trials=TRIALS).unwrapped for _ in range(count)]
    observations, _ = many.reset(seed=7)
    np.testing.assert_array_equal(many.reset(seed=np.int64(7))[0], observations)
    begun = [env.reset(seed=7 + n) for n, env in enumerate(singles)]
    np.testing.assert_array_equal(observations, [observation for observation, _ in begun])
    assert len({env.episodes.worlds.trial[0] for env in singles}) == 2
    rng, ended = np.random.default_rng(0), [False] * count
    for _ in range(150):
        actions = rng.uniform(-1, 1, (count, 6)).astype(np.float32)
        observations, rewards, terminated, truncated, info = many.step(actions)
        assert not terminated.any()
        for n, env in enumerate(singles):
            if ended[n]:
                expected, reward, ended[n] = env.reset()[0], 0.0, False
                assert not info["_vva_deg"][n]
            else:
                expected, reward, _, ended[n], told = env.step(actions[n])
                assert info["vva_deg"][n] == told["vva_deg"]
            np.testing.assert_array_equal(observations[n], expected)
            assert (rewards[n], truncated[n]) == (reward, ended[n])
    many.close()


@pytest.mark.extras
def test_trials_come_from_a_dataset_and_one_can_be_asked_for(gym: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from surgbench.viewpoint import environment

    trials = {name: replace(trial, id=name) for name, trial in zip(("000", "001"), TRIALS, strict=True)}
    units = [SimpleNamespace(sequence=name) for name in trials]
    opened = SimpleNamespace(task="viewpoint", units=lambda: units, trial=trials.__getitem__)
    monkeypatch.setattr(environment, "open_dataset", lambda path: opened)
    env = environment.ViewpointEnv("data/chaser", registration="rigid")
    assert env.reset(options={"trial": "001"})[1] == {"trial": "001"}
    with pytest.raises(DatasetError, match="unknown trial '01'; did you mean '001'"):
        env.reset(options={"trial": "01"})
    with pytest.raises(DatasetError, match="either a dataset's folder or trials"):
        environment.ViewpointEnv()
    del opened.trial
    with pytest.raises(DatasetError, match="expected trials of a camera"):
        environment.ViewpointEnv("data/mini")


@pytest.mark.extras
def test_the_document_s_examples_run(gym: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from surgbench.viewpoint import environment

    units = [SimpleNamespace(sequence=0), SimpleNamespace(sequence=1)]
    opened = SimpleNamespace(task="viewpoint", units=lambda: units, trial=TRIALS.__getitem__)
    monkeypatch.setattr(environment, "open_dataset", lambda path: opened)
    blocks = re.findall(r"^```py\n(.*?)^```$", DOCUMENT.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    names: dict[str, Any] = {}
    for block in blocks:
        exec(compile(block, str(DOCUMENT), "exec"), names)
    assert names["truncated"]
    assert names["vector"].reset(seed=0)[0].shape == (64, 38)
    for part in environment.OBSERVED:
        assert f"`{part}`" in DOCUMENT.read_text(encoding="utf-8")


def test_without_gymnasium_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "surgbench.viewpoint.environment", raising=False)
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(ModuleNotFoundError, match=r"gymnasium is not installed: pip install 'surgbench\[gym\]'"):
        import surgbench.viewpoint.environment  # noqa: F401
