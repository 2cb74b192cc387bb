"""The proof that a broken rule could not have been avoided: analytic cases, and samples that must not refute it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray, rigid_transform
from surgbench.tasks.viewpoint.conformance.worlds import DT_S, feature_poses, make_trial
from surgbench.viewpoint.avoidable import IMPOSSIBLE, POSSIBLE, broken_m, decide, lag_steps, reach, unavoidable
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.servo import JointServo
from surgbench.viewpoint.simulator import Course, make_scene
from surgbench.viewpoint.trial import Trial
from surgbench.viewpoint.workspace import NoGoZone, Workspace

ARM = CameraArm()
# Straight down; the camera is 0.0352 + 0.1 + 0.0107 + 0.045 m below the remote centre.
DOWN = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
DEPTH_M = 0.1909
SPEED_UP_M = ARM.acceleration[2] * DT_S**2


def resting(joints: FloatArray, steps: int, feature_m: FloatArray) -> tuple[Course, Trial, ViewpointScene]:
    """An arm that rests, and a feature ``(steps, 3)``; the zone is far away, its base 1 m below the remote centre."""
    trial = make_trial(feature_poses(feature_m, np.tile([1.0, 0.0, 0.5], (steps, 1))), np.eye(4), joints)
    far = np.array([[5.0, 5, -1], [5.1, 5, -1], [5.1, 5.1, -1], [5, 5.1, -1], [5, 5, -0.9]])
    scene = make_scene(trial)
    scene = replace(scene, T_world_base=rigid_transform(np.eye(3), np.zeros(3)), workspace=Workspace(NoGoZone(far)))
    still = np.tile(joints, (steps + 1, 1))
    no = np.zeros(steps, dtype=bool)
    course = Course(still, still, still[1:], no, no, np.zeros((steps, 5), dtype=bool), no, np.zeros(steps))
    return course, trial, scene


def with_floor(scene: ViewpointScene, depth_m: float) -> ViewpointScene:
    """The floor so far above the camera that hangs straight down."""
    return replace(scene, workspace=replace(scene.workspace, floor_m=1.0 - DEPTH_M + depth_m))


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_below_the_floor_the_insertion_decides(steps: int) -> None:
    """From rest n steps of full acceleration raise the set point by a dt^2 n (n + 1) / 2; tilts add very little."""
    course, trial, scene = resting(DOWN, 40, np.tile([0.2, 0.0, -0.2], (40, 1)))
    # Beside that, what is not known of the velocity: half a step's acceleration, all the time.
    possible_m = SPEED_UP_M * (steps * (steps + 1) / 2 + steps / 2)
    for depth_m, proven in ((5e-4 + 0.9 * possible_m, False), (5e-4 + 1.2 * possible_m + 1e-4, True)):
        found = unavoidable(course, trial, with_floor(scene, depth_m), "floor", steps, of="setpoints")
        assert found[steps + 1 :].all() == proven
        assert found[steps + 1 :].any() == proven


def test_what_is_not_broken_is_not_unavoidable() -> None:
    course, trial, scene = resting(DOWN, 10, np.tile([0.2, 0.0, -0.2], (10, 1)))
    for rule in ("floor", "no_go", "proximity"):
        assert not unavoidable(course, trial, scene, rule).any()
    # By less than half a millimetre it does not count.
    assert not unavoidable(course, trial, with_floor(scene, 4e-4), "floor").any()


def test_a_feature_that_jumps_at_the_camera_cannot_be_evaded_at_once() -> None:
    feature = np.tile([0.2, 0.0, -DEPTH_M], (120, 1))
    feature[60:] = [0.07, 0.0, -DEPTH_M]
    course, trial, scene = resting(DOWN, 120, feature)
    assert unavoidable(course, trial, scene, "proximity")[60:].all()
    long = unavoidable(course, trial, scene, "proximity", 40)
    assert not long[60:].any()  # had it been known half a second earlier
    assert not unavoidable(course, trial, scene, "proximity")[:60].any()


def test_inside_the_zone_any_face_is_a_way_out() -> None:
    course, trial, scene = resting(DOWN, 6, np.tile([0.2, 0.0, -0.2], (6, 1)))
    # The camera 3 mm below the top and 0.6 mm from the side at the right.
    points = np.array([[-0.1, -0.1, -0.25], [0.0006, -0.1, -0.25], [0.0006, 0.1, -0.25], [-0.1, 0.1, -0.25], [0, 0, 0]])
    points[4, 2] = -DEPTH_M + 0.003
    near = replace(scene, workspace=Workspace(NoGoZone(points)))
    assert not unavoidable(course, trial, near, "no_go")[3:].any()
    points[1:3, 0] = 0.01
    deep = replace(scene, workspace=Workspace(NoGoZone(points)))
    assert unavoidable(course, trial, deep, "no_go").all()


def test_an_unknown_rule() -> None:
    with pytest.raises(ConfigError, match="did you mean 'floor'"):
        unavoidable(*resting(DOWN, 3, np.zeros((3, 3))), "flor")


def test_the_lag_in_whole_steps() -> None:
    scene = resting(DOWN, 3, np.zeros((3, 3)))[2]
    assert lag_steps(replace(scene, servo_lag_s=0.0)) == 1
    assert lag_steps(replace(scene, servo_lag_s=DT_S)) == 1
    assert lag_steps(replace(scene, servo_lag_s=1.01 * DT_S)) == 2


def test_a_feature_that_is_not_known_is_not_near() -> None:
    scene = resting(DOWN, 3, np.zeros((3, 3)))[2]
    found = broken_m(np.zeros((2, 3)), np.array([[np.nan] * 3, [0.03, 0.0, 0.04]]), scene)
    assert np.isnan(found["proximity"][0])
    assert found["proximity"][1] == pytest.approx(0.03)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_what_the_servo_reaches_lies_within_reach(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start = rng.uniform(ARM.lower, ARM.upper)
    course, _, scene = resting(start, 30, np.zeros((30, 3)))
    servo = JointServo(ARM, start, scene.dt_s, scene.servo_lag_s)
    joints, setpoints = course.joints.copy(), course.setpoints.copy()
    for k in range(1, 31):
        if rng.random() < 0.3:
            servo.move(rng.uniform(ARM.lower, ARM.upper))
        else:
            wild = rng.uniform(-1, 1, 6) * np.array(ARM.velocity)
            servo.servo(servo.setpoint + wild * scene.dt_s, wild)
        joints[k], setpoints[k] = servo.joints, servo.setpoint
    moved = replace(course, joints=joints, setpoints=setpoints)
    sample, steps = int(rng.integers(1, 31)), int(rng.integers(1, 12))
    for of, there in (("joints", joints), ("setpoints", setpoints)):
        box = reach(moved, scene, sample, steps, of)  # type: ignore[arg-type]
        assert (there[sample] >= box[0] - 1e-9).all()
        assert (there[sample] <= box[1] + 1e-9).all()


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_no_sample_of_a_box_refutes_the_decision(seed: int, plane: bool) -> None:
    rng = np.random.default_rng(seed)
    middle = rng.uniform(ARM.lower + 0.02, ARM.upper - 0.02)
    half = rng.uniform(0, 1, 6) * np.array([0.03, 0.03, 0.01, 0.15, 0.15, 0.15]) * rng.choice([0.1, 1.0])
    box = np.array([middle - half, middle + half])
    direction = rng.normal(0, 1, 3)
    demand = np.append(float(plane), direction / np.linalg.norm(direction) * (1.0 if plane else 0.15))
    inside = rng.uniform(box[0], box[1], (500, 6))
    inside[:64] = np.where(np.arange(64)[:, None] >> np.arange(6) & 1, box[1], box[0])
    places = ARM.forward(inside)[:, :3, 3]
    values = places @ demand[1:] if plane else np.linalg.norm(places - demand[1:], axis=1)
    best = float(values.max())
    assert decide(ARM.packed, ARM.camera_m, box, demand, best - 1e-6, 100_000) == POSSIBLE
    # The largest value is proven within a micron and a millionth of what the box spans.
    spans = float(np.ptp(values))
    assert decide(ARM.packed, ARM.camera_m, box, demand, best + 0.3 * spans + 1e-4, 100_000) == IMPOSSIBLE
