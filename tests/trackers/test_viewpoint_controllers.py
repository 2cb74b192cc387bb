"""The published viewpoint controllers: where they go, what they optimise, and that none goes beyond the limits."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import Bounds, minimize

from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray, inverse_transform, is_rigid, rigid_transform, rotation_from_vector
from surgbench.registry import create, find
from surgbench.tasks.viewpoint.conformance.worlds import ZONE_M, circling, feature_poses, make_trial, random_trial
from surgbench.trackers.hierarchical.constrained_ik import ConstrainedIK, SolverConfig, WeightsConfig
from surgbench.trackers.hierarchical.means import PoseMean
from surgbench.trackers.hierarchical.poses import look_from, naive
from surgbench.trackers.hierarchical.steps import to_boundary
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.contract import ViewCommand, ViewpointObservation, ViewpointScene
from surgbench.viewpoint.placement import look_at, naive_pose
from surgbench.viewpoint.scores import course_errors
from surgbench.viewpoint.simulator import Simulation, make_scene
from surgbench.viewpoint.workspace import NoGoZone, Workspace

ARM = CameraArm()
BOUNDS = np.array([ARM.lower, ARM.upper])
CONTROLLERS = ("static", "midpoint", "naive", "autocam", "autocam-published")
OPEN = (0.6, -0.4, 0.7)  # a normal against which nothing speaks
FEATURE_M = np.array([0.0, 0.0, 0.03])

joints_within = st.tuples(*(st.floats(a, b) for a, b in zip(ARM.lower, ARM.upper, strict=True))).map(np.array)


def vectors(size: float) -> st.SearchStrategy[FloatArray]:
    return st.tuples(*(st.floats(-size, size),) * 3).map(np.array)


def controller(name: str, **options: Any) -> Any:
    return create(find("tracker", name), options)


def feature_at(position: Any = FEATURE_M, normal: Any = OPEN) -> FloatArray:
    return np.asarray(feature_poses(np.array([position], dtype=float), np.array([normal], dtype=float))[0])


def scene_of(feature: FloatArray, **changes: Any) -> ViewpointScene:
    scene = make_scene(make_trial(feature[None]))
    return ViewpointScene(**{**scene.__dict__, **changes})


def reach(scene: ViewpointScene, T_world_camera: FloatArray) -> FloatArray:
    """Joints for a camera pose, clipped."""
    middle = np.array([0, 0, 0, -2.8, 0, 0])
    return ARM.clip(ARM.inverse(inverse_transform(scene.T_world_base) @ T_world_camera, middle))


def ask(name: str, scene: ViewpointScene, feature: FloatArray, joints: FloatArray, **options: Any) -> ViewCommand:
    """A fresh controller's first answer."""
    asked = controller(name, **options)
    asked.reset(scene, joints.copy(), np.random.default_rng(0))
    return answer(asked, feature, joints)


def answer(asked: Any, feature: FloatArray, joints: FloatArray, index: int = 0) -> ViewCommand:
    observation = ViewpointObservation(index, index * 0.0126, feature.copy(), joints.copy(), joints.copy(), np.zeros(6))
    command = asked.step(observation)
    return command if isinstance(command, ViewCommand) else ViewCommand(command)


def camera_of(scene: ViewpointScene, target: FloatArray) -> FloatArray:
    """T_world_camera of a command."""
    return target if target.shape == (4, 4) else scene.T_world_base @ ARM.forward(target)


# Poses, boundary, means.


@given(vectors(0.3), vectors(1.0))
def test_compiled_poses_are_those_of_the_placement(position: FloatArray, normal: FloatArray) -> None:
    assume(np.linalg.norm(normal) > 1e-2)
    feature, pose = feature_at(position, normal), np.empty((4, 4))
    naive(feature, 0.11, pose)
    np.testing.assert_allclose(pose, naive_pose(feature), atol=1e-12)
    eye = position + 0.2 * normal
    pose[:3, 3] = eye
    assert look_from(eye, feature, pose)
    np.testing.assert_allclose(pose, look_at(eye, position), atol=1e-9)


def test_a_camera_in_the_feature_looks_nowhere() -> None:
    feature, pose = feature_at(), np.full((4, 4), 7.0)
    assert not look_from(feature[:3, 3], feature, pose)
    assert (pose == 7.0).all()


@given(vectors(0.08), vectors(1.0))
def test_the_boundary_is_the_nearest_face_that_can_be_stood_on(position: FloatArray, turn: FloatArray) -> None:
    """Eq. 1: along a face's normal onto its plane. The base is no way out: the floor lies above it."""
    rotation = rotation_from_vector(turn)
    workspace = Workspace(NoGoZone(ZONE_M @ rotation.T))
    zone, floor = workspace.zone, workspace.floor
    start = rotation @ (position + np.array([0, 0, 0.02]))
    moved = start.copy()
    to_boundary(zone.faces, floor, moved)
    assert zone.depth(moved) < 1e-12
    assert workspace.below_floor(moved) < 1e-12
    raised = start + max(float(workspace.below_floor(start)), 0.0) * zone.up
    if zone.depth(raised) < 0:
        np.testing.assert_allclose(moved, raised, atol=1e-15)
    else:
        depths = zone.faces[1:, :3] @ raised - zone.faces[1:, 3]
        assert np.linalg.norm(moved - raised) == pytest.approx(depths.min(), abs=1e-12)
        assert abs((zone.faces[1:, :3] @ moved - zone.faces[1:, 3])[depths.argmin()]) < 1e-12


@pytest.mark.parametrize("window", [5, 20, 140])
def test_a_moving_mean_lags_by_half_its_window(window: int) -> None:
    mean, step, turn = PoseMean(window, window), np.array([1e-3, -2e-3, 5e-4]), np.array([2e-4, 0, 1e-4])
    for k in range(2 * window):
        out = mean(rigid_transform(rotation_from_vector(k * turn), k * step))
    lag = (window - 1) / 2
    np.testing.assert_allclose(out[:3, 3], (2 * window - 1 - lag) * step, atol=1e-12)
    np.testing.assert_allclose(out[:3, :3], rotation_from_vector((2 * window - 1 - lag) * turn), atol=1e-6)


def test_a_mean_has_as_many_members_as_there_are() -> None:
    mean = PoseMean(140, 20)
    for k in range(3):
        out = mean(rigid_transform(np.eye(3), np.full(3, float(k))))
    np.testing.assert_allclose(out, rigid_transform(np.eye(3), np.ones(3)))


@given(st.lists(vectors(3.1), min_size=1, max_size=6))
def test_means_of_any_rotations_are_rotations(turns: list[FloatArray]) -> None:
    mean = PoseMean(4, 4)
    for turn in turns:
        pose = rigid_transform(rotation_from_vector(turn), turn)
        out = mean(pose)
        assert is_rigid(out, 1e-12)
    if len(turns) == 1:
        np.testing.assert_allclose(out, pose, atol=1e-12)


# The objective and its solver.


def problem(joints: FloatArray, offset: FloatArray, shift: FloatArray) -> FloatArray:
    pose = ARM.forward(joints)
    up = rotation_from_vector(0.3 * offset) @ np.array([0.0, 0.0, 1.0])
    return np.array([pose[:3, 3] + 0.11 * pose[:3, 2] + 0.05 * offset, pose[:3, 3] + 0.03 * shift, up])


@pytest.mark.slow
@given(joints_within, vectors(1.0), vectors(1.0), st.booleans())
def test_gradient_of_the_objective(joints: FloatArray, offset: FloatArray, shift: FloatArray, of_tool: bool) -> None:
    solver = ConstrainedIK(ARM, BOUNDS, 0.11, SolverConfig(), WeightsConfig(), of_tool=of_tool)
    points, gradient, nothing = problem(joints, offset, shift), np.empty(6), np.empty(0)
    assert solver.objective(points, joints, gradient) == solver.objective(points, joints, nothing)
    step = 1e-6
    for joint, axis in enumerate(np.eye(6) * step):
        ahead, here, behind = (solver.objective(points, joints + k * axis, nothing) for k in (1, 0, -1))
        slopes = (ahead - here) / step, (here - behind) / step
        assume(abs(slopes[0] - slopes[1]) < 3e-5 * (1 + np.abs(gradient).max()))  # not where |x.w| has its corner
        assert gradient[joint] == pytest.approx(sum(slopes) / 2, abs=1e-6 + 1e-4 * np.abs(gradient).max())


def test_the_objective_of_an_ideal_view_is_nothing() -> None:
    """And of one that is only in the wrong place, what Table IV makes of that."""
    feature = feature_at()
    scene = scene_of(feature)
    joints = reach(scene, naive_pose(feature))
    back = inverse_transform(scene.T_world_base)
    camera = ARM.forward(joints)
    points = np.array([(back @ feature)[:3, 3], camera[:3, 3], back[:3, 2]])
    solver = ConstrainedIK(ARM, BOUNDS, 0.11, SolverConfig(), WeightsConfig())
    gradient = np.empty(6)
    assert solver.objective(points, joints, gradient) < 1e-20
    assert np.abs(gradient).max() < 1e-9
    for off, loss in ((0.006, 0.5 * 0.006**2), (0.05, 0.01 * (0.05 - 0.005))):  # within Huber's width, and beyond
        points[1] = camera[:3, 3] + off * camera[:3, 0]
        assert solver.objective(points, joints, gradient) == pytest.approx(15 * loss)
    # The published code's desired position is the tool's.
    of_tool = ConstrainedIK(ARM, BOUNDS, 0.11, SolverConfig(), WeightsConfig(), of_tool=True)
    points[1] = camera[:3, 3] - ARM.camera_m * camera[:3, 2]
    assert of_tool.objective(points, joints, gradient) < 1e-20


@pytest.mark.slow
def test_the_optimiser_is_as_good_as_scipys() -> None:
    """Where both run until nothing changes, from the same start."""
    rng = np.random.default_rng(0)
    exact = ConstrainedIK(ARM, BOUNDS, 0.11, SolverConfig(evaluations=2000, x_tolerance=1e-10), WeightsConfig())
    table4 = ConstrainedIK(ARM, BOUNDS, 0.11, SolverConfig(), WeightsConfig())
    middle = np.array([-0.58, -0.5, 0.02, -2.76, -0.28, 0.16])
    worse = []
    for _ in range(30):
        start = ARM.clip(middle + rng.normal(0, 1, 6) * [0.1, 0.1, 0.01, 0.1, 0.1, 0.1])
        # The desired place is above: out of reach, for the insertion ends at 0.
        points = problem(start, rng.normal(0, 0.5, 3), rng.normal(0, 0.5, 3) + np.array([0, 0, 1.5]))

        def value(joints: FloatArray, points: FloatArray = points) -> tuple[float, FloatArray]:
            gradient = np.empty(6)
            return exact.objective(points, joints, gradient), gradient

        other = minimize(
            value,
            start,
            jac=True,
            method="SLSQP",
            bounds=Bounds(BOUNDS[0], BOUNDS[1]),
            options={"ftol": 1e-14, "maxiter": 1000},
        )
        ours = exact.solve(points, start)
        assert ours.cost == exact.objective(points, ours.joints, np.empty(0))
        worse.append(ours.cost / other.fun - 1)
        within_50 = table4.solve(points, start)
        assert ours.cost <= within_50.cost <= exact.objective(points, start, np.empty(0))
        assert within_50.evaluations <= 50
        for solution in (ours, within_50):
            assert ARM.within_limits(solution.joints)
    assert np.median(np.abs(worse)) < 1e-3
    assert max(worse) < 0.05


def test_the_optimiser_finds_a_pose_that_can_be_had() -> None:
    feature = feature_at()
    scene = scene_of(feature)
    wanted = reach(scene, naive_pose(feature))
    back = inverse_transform(scene.T_world_base)
    points = np.array([(back @ feature)[:3, 3], ARM.forward(wanted)[:3, 3], back[:3, 2]])
    solver = ConstrainedIK(ARM, BOUNDS, 0.11, SolverConfig(evaluations=2000, x_tolerance=1e-12), WeightsConfig())
    solution = solver.solve(points, wanted + np.array([0.05, -0.05, 0.005, 0.1, 0.05, -0.05]))
    assert solution.cost < 1e-6
    pose = ARM.forward(solution.joints)
    assert np.linalg.norm(pose[:3, 3] - points[1]) < 1e-3


def test_an_optimiser_that_fails_keeps_what_it_had() -> None:
    solver = ConstrainedIK(ARM, BOUNDS, 0.11, SolverConfig(), WeightsConfig())
    start = ARM.clip(np.full(6, 9.0))
    solution = solver.solve(np.full((3, 3), np.nan), np.full(6, 9.0))
    np.testing.assert_array_equal(solution.joints, start)
    assert not solution.success
    # And it works the next time.
    points = problem(start, np.zeros(3), np.zeros(3))
    fresh = ConstrainedIK(ARM, BOUNDS, 0.11, SolverConfig(), WeightsConfig())
    np.testing.assert_array_equal(solver.solve(points, start).joints, fresh.solve(points, start).joints)


# Controllers.


def test_static_stays() -> None:
    trial = circling(50)
    course = Simulation(controller("static"), trial, make_scene(trial), np.random.default_rng(0)).run()
    np.testing.assert_allclose(course.joints, np.tile(trial.start, (51, 1)), atol=1e-15)


@pytest.mark.parametrize("name", ["naive", "autocam"])
def test_where_nothing_speaks_against_it_the_naive_pose_is_reached(name: str) -> None:
    feature = feature_at()
    scene = scene_of(feature)
    joints = reach(scene, naive_pose(feature_at(FEATURE_M + 0.004)))
    command = ask(name, scene, feature, joints)
    np.testing.assert_allclose(camera_of(scene, command.target), naive_pose(feature), atol=1e-9)
    assert command.active == ()
    assert not command.solver
    assert command.mode == "move"


@pytest.mark.parametrize("name", CONTROLLERS[1:])
def test_a_ring_that_rests_is_seen_in_the_end(name: str) -> None:
    away = circling(1)
    trial = make_trial(np.tile(feature_at(), (500, 1, 1)), start=away.start)
    course = Simulation(controller(name), trial, make_scene(trial), np.random.default_rng(0)).run()
    errors = course_errors(course, trial, make_scene(trial))
    for error, most in (("vva_deg", 0.01), ("fd_mm", 0.01), ("pf_deg", 0.01)):
        assert errors[error][-1] < most
    if name != "midpoint":  # which does not heed the normal
        assert errors["an_deg"][-1] < 0.01
    assert not course.solver.any()


@given(st.integers(0, 2**32 - 1))
def test_naive_joints_are_the_closed_form_clipped(seed: int) -> None:
    trial = random_trial(np.random.default_rng(seed), 1)
    feature = trial.T_world_feature[0]
    assume(np.isfinite(feature).all())
    scene = make_scene(trial)
    command = ask("naive", scene, feature, trial.start)
    exact = ARM.inverse(inverse_transform(scene.T_world_base) @ naive_pose(feature), trial.start)
    exact[3] -= 2 * np.pi * np.sign(exact[3]) * (abs(exact[3]) > ARM.upper[3])  # the turn that can be had
    np.testing.assert_allclose(command.target, ARM.clip(exact), atol=1e-9)
    assert ("joint_limit" in command.active) != bool(ARM.within_limits(exact))


@pytest.mark.slow
@given(joints_within.filter(lambda joints: joints[2] > 0.12), st.integers(0, 2**32 - 1))
def test_midpoint_points_the_shaft_at_the_feature(joints: FloatArray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    base = rigid_transform(rotation_from_vector(rng.normal(0, 0.3, 3)), rng.normal(0, 0.1, 3))
    scene = scene_of(feature_at(), T_world_base=base)
    # On the shaft's axis; nearer than it is to the remote centre the camera cannot be.
    straight = base @ ARM.forward(np.array([*joints[:3], 0, 0, 0]))
    feature = feature_at(straight[:3, 3] + 0.11 * straight[:3, 2], rng.normal(size=3))
    command = ask("midpoint", scene, feature, joints)
    assert command.target[:3] == pytest.approx(joints[:3], abs=1e-9)
    assert command.target[4:] == pytest.approx([0, 0])
    pose = camera_of(scene, command.target)
    assert np.linalg.norm(feature[:3, 3] - pose[:3, 3]) == pytest.approx(0.11)
    if np.hypot(*pose[:2, 2]) > 1e-3:
        assert abs(pose[2, 0]) < 1e-9  # level, up to the roll's limits: these allow every direction
        assert pose[2, 1] > 0
    kept = ask("midpoint", scene, feature, joints, roll="keep")
    assert kept.target[3] == pytest.approx(joints[3])


@pytest.mark.parametrize(("distance_m", "way"), [(0.25, 1), (0.11, 0), (0.05, -1)])
def test_midpoints_zones(distance_m: float, way: int) -> None:
    """A millimetre a step, from 0.3 s on; 40 mm fill the dead zone's share of the picture at 11 cm."""
    scene = scene_of(feature_at())
    joints = np.array([0.1, 0.2, 0.1, -2.8, 0.0, 0.0])
    pose = camera_of(scene, joints)
    feature = feature_at(pose[:3, 3] + distance_m * pose[:3, 2])
    asked = controller("midpoint", insertion="zones")
    asked.reset(scene, joints, np.random.default_rng(0))
    deep = np.array([answer(asked, feature, joints, index).target[2] for index in range(31)])
    np.testing.assert_allclose(deep[:25], 0.1, atol=1e-12)  # 24 steps are 0.3024 s; what follows is seen a step later
    np.testing.assert_allclose(np.diff(deep[24:30]), 1e-3 * way, atol=1e-12)


def test_midpoint_does_not_zoom_while_the_feature_moves() -> None:
    scene = scene_of(feature_at())
    joints = np.array([0.1, 0.2, 0.1, -2.8, 0.0, 0.0])
    pose = camera_of(scene, joints)
    asked = controller("midpoint", insertion="zones")
    asked.reset(scene, joints, np.random.default_rng(0))
    for index in range(100):
        feature = feature_at(pose[:3, 3] + 0.25 * pose[:3, 2] + [0.0005 * index, 0, 0])
        assert answer(asked, feature, joints, index).target[2] == pytest.approx(0.1)


@pytest.mark.parametrize("away_m", [0.0, 0.005, 0.03])
def test_in_the_pan_zone_nothing_is_turned_and_beyond_it_only_as_far_as_must_be(away_m: float) -> None:
    """The feature stays within a tenth of the picture's width of the middle, which at 11 cm are 13.3 mm."""
    feature, moved = feature_at(), feature_at(FEATURE_M + np.array([0.0, away_m, 0.0]))
    scene = scene_of(feature)
    asked = controller("midpoint", pan_zone=0.1)
    asked.reset(scene, reach(scene, naive_pose(feature)), np.random.default_rng(0))
    first = answer(asked, feature, ARM.clip(np.array([0.0, 0, 0.1, 0, 0, 0])))
    second = answer(asked, moved, first.target, 1)
    off_rad = np.arccos(np.clip(camera_of(scene, first.target)[:3, 2] @ camera_of(scene, second.target)[:3, 2], -1, 1))
    zone_m = 0.1 / 0.829 * 0.11
    if away_m < zone_m:
        assert off_rad < 1e-6
    else:
        reached_m = np.linalg.norm(moved[:3, 3] - scene.T_world_base[:3, 3])
        assert off_rad == pytest.approx((away_m - zone_m) / reached_m, rel=0.1)


def test_the_published_midpoint_keeps_depth_and_roll() -> None:
    feature = feature_at()
    scene = scene_of(feature)
    joints = reach(scene, naive_pose(feature))
    published, plain = (ask(name, scene, feature, joints).target for name in ("midpoint-published", "midpoint"))
    np.testing.assert_allclose(published[:2], plain[:2])  # the same direction
    assert published[2] == pytest.approx(joints[2])
    assert published[3] == pytest.approx(joints[3])
    same = ask("midpoint", scene, feature, joints, insertion="zones", roll="keep").target
    np.testing.assert_array_equal(published, same)


def test_a_far_place_is_gone_to_half_way() -> None:
    feature = feature_at()
    scene = scene_of(feature)
    joints = reach(scene, naive_pose(feature_at(FEATURE_M + np.array([0.0, 0.02, 0.01]))))
    now, wanted = camera_of(scene, joints), naive_pose(feature)
    for share in (0.5, 0.2):
        target = camera_of(scene, ask("autocam", scene, feature, joints, interpolate_share=share).target)
        np.testing.assert_allclose(target[:3, 3], now[:3, 3] + share * (wanted - now)[:3, 3], atol=1e-9)
        np.testing.assert_allclose(target[:3, :3], wanted[:3, :3], atol=1e-9)
    target = camera_of(scene, ask("autocam", scene, feature, joints, interpolate_beyond_m=0.1).target)
    np.testing.assert_allclose(target, wanted, atol=1e-9)


@pytest.mark.parametrize(("name", "reach_m"), [("autocam", 0.0), ("autocam-published", -ARM.camera_m)])
def test_on_the_wrong_side_the_arm_stays_and_looks(name: str, reach_m: float) -> None:
    """The article's camera stays; the code's tool does, and turns as the camera would have to."""
    seen = feature_at()
    scene = scene_of(seen)
    joints = reach(scene, naive_pose(seen))
    now = camera_of(scene, joints)
    feature = feature_at(FEATURE_M + np.array([0.01, 0.005, 0]), (-0.6, -0.3, 0.7))
    command = ask(name, scene, feature, joints)
    assert "orientation" in command.active
    assert not command.solver
    target = camera_of(scene, command.target)
    stays = now[:3, 3] + reach_m * now[:3, 2]
    np.testing.assert_allclose(target[:3, 3] + reach_m * target[:3, 2], stays, atol=1e-9)
    np.testing.assert_allclose(target[:3, :3], look_at(now[:3, 3], feature[:3, 3])[:3, :3], atol=1e-9)


def test_a_camera_that_looks_up_is_on_the_wrong_side_for_the_code_only() -> None:
    """The article has it by the viewing axis, the code by the camera's y axis, which points ahead when looking up."""
    feature = feature_at(normal=(0.6, -0.4, -0.2))
    scene = scene_of(feature)
    joints = reach(scene, naive_pose(feature_at()))
    assert "orientation" in ask("autocam-published", scene, feature, joints, interpolate_share=1).active
    assert "orientation" not in ask("autocam", scene, feature, joints, interpolate_share=1).active


def below() -> tuple[ViewpointScene, FloatArray, FloatArray, FloatArray]:
    """A ring whose naive camera would be in the zone: scene, feature, joints near there, and the naive pose."""
    feature = feature_at((-0.075, 0.06, 0.014), (0.9, -0.5, 0.15))
    scene = scene_of(feature)
    pose = naive_pose(feature)
    assert scene.workspace.zone.depth(pose[:3, 3]) > 0
    return scene, feature, reach(scene, look_at(pose[:3, 3] + [0.003, -0.003, 0.005], feature[:3, 3])), pose


def test_a_camera_in_the_zone_is_brought_onto_its_boundary() -> None:
    scene, feature, joints, pose = below()
    command = ask("autocam", scene, feature, joints)
    assert "no_go" in command.active
    assert "floor" in command.active
    target = camera_of(scene, command.target)
    if not command.solver:
        expected = pose[:3, 3].copy()
        to_boundary(scene.workspace.zone.faces, scene.workspace.floor, expected)
        np.testing.assert_allclose(target, look_at(expected, feature[:3, 3]), atol=1e-9)
    assert abs(scene.workspace.zone.depth(target[:3, 3])) < 1e-9


def test_the_code_projects_the_tool_onto_the_top() -> None:
    scene, feature, joints, pose = below()
    command = ask("autocam-published", scene, feature, joints)
    assert {"no_go", "floor"} <= set(command.active)
    target, now = camera_of(scene, command.target), camera_of(scene, joints)
    tool = target[:3, 3] - ARM.camera_m * target[:3, 2]
    wanted = scene.workspace.zone.project_to_top(pose[:3, 3] - ARM.camera_m * pose[:3, 2])
    np.testing.assert_allclose(tool, wanted, atol=1e-9)
    np.testing.assert_allclose(target[:3, :3], look_at(now[:3, 3], feature[:3, 3])[:3, :3], atol=1e-9)


def test_too_near_the_optimiser_keeps_the_distance() -> None:
    """From below, raised to the top of the zone, the camera would be 7 cm from the ring."""
    feature = feature_at((0.0, 0.0, 0.12), (0.1, -0.1, -0.99))
    scene = scene_of(feature)
    joints = reach(scene, look_at(np.array([0.05, -0.03, 0.06]), feature[:3, 3]))
    command = ask("autocam", scene, feature, joints, interpolate_beyond_m=1.0)
    assert command.active == ("no_go", "floor", "proximity")
    assert command.solver
    distance = np.linalg.norm(camera_of(scene, command.target)[:3, 3] - feature[:3, 3])
    assert 0.09 < distance < 0.115
    nearer = Workspace(scene.workspace.zone, proximity_m=0.05)
    command = ask("autocam", scene_of(feature, workspace=nearer), feature, joints, interpolate_beyond_m=1.0)
    assert "proximity" not in command.active


def published_solution(scene: ViewpointScene, feature: FloatArray, tool: Any, weights: Any, start: Any) -> FloatArray:
    """T_world_camera that the published optimiser finds for a desired place of the tool."""
    bounds = BOUNDS.copy()
    bounds[:, 0] = -4.7124, 4.7124
    back = inverse_transform(scene.T_world_base)
    position, orientation, distance = weights
    config = WeightsConfig(position=position, orientation=orientation, distance=distance)
    solver = ConstrainedIK(ARM, bounds, 0.11, SolverConfig(), config, of_tool=True)
    points = np.array([(back @ feature)[:3, 3], back[:3, :3] @ tool + back[:3, 3], back[:3, 2]])
    return np.asarray(scene.T_world_base @ ARM.forward(solver.solve(points, start).joints))


def test_the_codes_weights_are_those_of_its_branches() -> None:
    scene, feature, joints, pose = below()
    near = Workspace(scene.workspace.zone, proximity_m=0.2)
    command = ask("autocam-published", scene_of(feature, workspace=near), feature, joints)
    assert command.active == ("no_go", "floor", "proximity")
    assert command.solver
    tool = scene.workspace.zone.project_to_top(pose[:3, 3] - ARM.camera_m * pose[:3, 2])
    expected = published_solution(scene, feature, tool, (15, 30, 25), joints)
    np.testing.assert_allclose(camera_of(scene, command.target), expected, atol=1e-6)

    feature = feature_at(normal=(0.3, 0.9, 0.3))
    scene, pose = scene_of(feature), naive_pose(feature)
    joints = reach(scene, look_at(np.array([0.08, 0.0, 0.09]), feature[:3, 3]))
    options = {"position_window": 1, "rotation_window": 1, "feature_window": 1, "interpolate_beyond_m": 1.0}
    asked = controller("autocam-published", **options)
    asked.reset(scene, joints, np.random.default_rng(0))
    # At first it goes there, whatever the limits say.
    first = answer(asked, feature, joints)
    look = look_at(camera_of(scene, joints)[:3, 3], feature[:3, 3])
    naive_tool = pose[:3, 3] - ARM.camera_m * pose[:3, 2]
    assert first.active == ("joint_limit",)
    assert not first.solver
    np.testing.assert_allclose(first.target[:3, 3] - ARM.camera_m * first.target[:3, 2], naive_tool, atol=1e-9)
    # Then it optimises, and keeps the place only: the camera is turned as it would have to be where it is now.
    second = answer(asked, feature, joints, 1)
    assert second.solver
    found = published_solution(scene, feature, naive_tool, (25, 30, 10), joints)
    tool = found[:3, 3] - ARM.camera_m * found[:3, 2]
    np.testing.assert_allclose(second.target[:3, 3] - ARM.camera_m * second.target[:3, 2], tool, atol=1e-6)
    for command in (first, second):
        np.testing.assert_allclose(command.target[:3, :3], look[:3, :3], atol=1e-9)


def test_the_placeholder_of_the_yaws_limit() -> None:
    """Beyond 1.588 the code's check sees nothing; the arm clips."""
    joints = np.array([1.7, -0.3, 0.12, 0.5, 0.1, -0.1])
    base = rigid_transform(rotation_from_vector(np.array([0.0, 1.7, 0.0])), np.array([0.2, 0.0, 0.3]))
    pose = base @ ARM.forward(joints)
    feature = feature_at(pose[:3, 3] + 0.11 * pose[:3, 2], -pose[:3, 2])
    free = Workspace(NoGoZone(ZONE_M - [0, 0, 9]), preferred_side=(0.0, 0.0, 0.0))
    scene = scene_of(feature, T_world_base=base, workspace=free)
    start = ARM.clip(reach(scene, naive_pose(feature)))
    options = {"interpolate_beyond_m": 1.0}
    assert ask("autocam-published", scene, feature, start, **options).active == ()
    limited = ask("autocam-published", scene, feature, start, placeholder_yaw_limit=False, **options)
    assert limited.active == ("joint_limit",)


def test_the_code_lags_by_its_means() -> None:
    """A ring that moves evenly, seen by an arm that is always where it is told: 140 positions are 69.5 steps."""
    step = np.array([2e-5, -1e-5, 5e-6])
    scene = scene_of(feature_at())
    asked = controller("autocam-published")
    joints = reach(scene, naive_pose(feature_at()))
    asked.reset(scene, joints, np.random.default_rng(0))
    for index in range(400):
        feature = feature_at(FEATURE_M + index * step)
        target = answer(asked, feature, joints, index).target
        joints = ARM.inverse(inverse_transform(scene.T_world_base) @ target, joints)
    lag = (5 - 1) / 2 + (140 - 1) / 2
    wanted = naive_pose(feature_at(FEATURE_M + (399 - lag) * step))
    tool = target[:3, 3] - ARM.camera_m * target[:3, 2]
    np.testing.assert_allclose(tool, wanted[:3, 3] - ARM.camera_m * wanted[:3, 2], atol=1e-9)


def test_the_missing_face_is_the_zones_and_not_the_controllers() -> None:
    """Beyond the side from D to A the published zone never ends."""
    feature = feature_at((-0.18, 0.05, 0.04), (0.9, -0.4, 0.05))
    scene = scene_of(feature)
    assert naive_pose(feature)[0, 3] < ZONE_M[:, 0].min()
    endless = Workspace(NoGoZone(ZONE_M, missing_face=True))
    joints = reach(scene, naive_pose(feature))
    for name in ("autocam", "autocam-published"):
        assert "no_go" not in ask(name, scene, feature, joints, interpolate_beyond_m=1.0).active
        flagged = ask(name, scene_of(feature, workspace=endless), feature, joints, interpolate_beyond_m=1.0)
        assert "no_go" in flagged.active


def test_out_of_reach_the_optimiser_looks_better_than_clipped_joints() -> None:
    feature = feature_at(normal=(0.3, 0.9, 0.3))
    scene = scene_of(feature)
    joints = reach(scene, look_at(np.array([0.08, 0.0, 0.09]), feature[:3, 3]))
    plain = ask("naive", scene, feature, joints)
    assert plain.active == ("joint_limit",)
    command = ask("autocam", scene, feature, joints, interpolate_beyond_m=1.0)
    assert command.active == ("joint_limit",)
    assert command.solver
    assert ARM.within_limits(command.target)

    def view_angle(target: FloatArray) -> float:
        pose = camera_of(scene, target)
        ray = feature[:3, 3] - pose[:3, 3]
        return float(np.degrees(np.arccos(ray @ pose[:3, 2] / np.linalg.norm(ray))))

    assert view_angle(command.target) < 10 < view_angle(plain.target)


def test_the_codes_sleep_is_in_flagged_steps_only(monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    monkeypatch.setattr("time.sleep", slept.append)
    scene, feature, joints, _ = below()
    ask("autocam-published", scene, feature, joints)
    assert slept == []
    ask("autocam-published", scene, feature, joints, sleep_s=0.005)
    assert slept == [0.005]
    ask("autocam-published", scene, feature_at(), reach(scene, naive_pose(feature_at())), sleep_s=0.005)
    assert slept == [0.005]


# Whatever happens.


@pytest.mark.slow
@settings(max_examples=100)
@given(st.sampled_from(CONTROLLERS), st.integers(0, 2**32 - 1))
def test_no_world_brings_them_beyond_the_limits(name: str, seed: int) -> None:
    """Features that jump, are far away, in the camera, or vanish; bases and starts anyhow, also inside the zone."""
    for world in range(20):
        trial = random_trial(np.random.default_rng([seed, world]), 4)
        course = Simulation(controller(name), trial, make_scene(trial), np.random.default_rng(0)).run()
        assert np.isfinite(course.joints).all()
        assert ARM.within_limits(course.goals).all()
        assert ARM.within_limits(course.joints, 1e-12).all()
        if name != "autocam-published":  # which commands poses, and leaves the limits to the arm
            assert not course.clipped.any()


@pytest.mark.parametrize("name", [*CONTROLLERS[1:], "gaze"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, 0.0])
def test_a_feature_that_is_none_holds_the_set_point(name: str, value: float) -> None:
    scene = scene_of(feature_at())
    joints = reach(scene, naive_pose(feature_at()))
    asked = controller(name)
    asked.reset(scene, joints, np.random.default_rng(0))
    before = answer(asked, feature_at(), joints)
    command = answer(asked, np.full((4, 4), value), joints, 1)
    np.testing.assert_array_equal(command.target, joints)
    assert not command.solver
    # And it goes on as if nothing had been.
    after = answer(asked, feature_at(), joints, 2)
    np.testing.assert_allclose(camera_of(scene, after.target), camera_of(scene, before.target), atol=1e-9)


@pytest.mark.parametrize("name", ["autocam", "autocam-published"])
def test_a_camera_in_the_feature_holds_the_set_point(name: str) -> None:
    scene = scene_of(feature_at())
    joints = reach(scene, naive_pose(feature_at()))
    now = camera_of(scene, joints)
    command = ask(name, scene, feature_at(now[:3, 3], (-0.6, -0.3, 0.7)), joints)
    np.testing.assert_array_equal(command.target, joints)


def test_a_feature_in_the_remote_centre_holds_the_midpoint() -> None:
    scene = scene_of(feature_at())
    joints = reach(scene, naive_pose(feature_at()))
    command = ask("midpoint", scene, feature_at(scene.T_world_base[:3, 3]), joints)
    np.testing.assert_array_equal(command.target, joints)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_pickled_in_the_middle_it_goes_on_the_same(name: str) -> None:
    trial = circling(60, radius_m=0.06)
    scene = make_scene(trial)
    one = controller(name)
    one.reset(scene, trial.start, np.random.default_rng(0))
    two = one
    for index, feature in enumerate(trial.T_world_feature):
        if index == 30:
            two = pickle.loads(pickle.dumps(one))
        if index < 30:
            answer(one, feature, trial.start, index)
            continue
        here, there = (answer(each, feature, trial.start, index).target for each in (one, two))
        np.testing.assert_array_equal(here, there)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("static", {"speed": 1}),
        ("naive", {"speed": 1}),
        ("midpoint", {"insertion": "deep"}),
        ("midpoint", {"zoom_m": 0.0}),
        ("autocam", {"interpolate_share": 0.0}),
        ("autocam", {"weights": {"position": -1.0}}),
        ("autocam", {"solver": {"evaluations": 0}}),
        ("autocam-published", {"position_window": 0}),
        ("autocam-published", {"sleep_s": float("nan")}),
        ("autocam-published", {"smoothing": True}),
    ],
)
def test_options_are_checked(name: str, options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(options))):
        controller(name, **options)
