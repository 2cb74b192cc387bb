"""Rules that were broken: depths by hand, reported and true ones, and their events."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgbench.geometry import FloatArray, inverse_transform, rigid_transform
from surgbench.tasks.viewpoint.conformance.worlds import circling, make_trial
from surgbench.tasks.viewpoint.records import ViewpointFrames
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.placement import CONSTRAINTS, look_at, naive_pose
from surgbench.viewpoint.rules import TWINS, depth_name, find_events, reported_depths, true_depths
from surgbench.viewpoint.simulator import Course, make_scene
from surgbench.viewpoint.trial import Trial

ARM = CameraArm()


def still(trial: Trial, cameras: FloatArray, setpoints: FloatArray | None = None) -> Course:
    """A course whose camera is at ``(T, 4, 4)`` after each step, at once, and its set points there or elsewhere."""
    joints = ARM.inverse(inverse_transform(trial.T_world_base) @ cameras, np.array([0, 0, 0, -2.8, 0, 0]))
    joints = np.concatenate([trial.start[None], joints])
    count = len(cameras)
    none, nothing = np.zeros(count, dtype=bool), np.zeros((count, 5), dtype=bool)
    told = joints if setpoints is None else np.concatenate([trial.start[None], setpoints])
    return Course(joints, told, joints[1:], none, ~none, nothing, none, np.zeros(count))


def test_depths_by_hand() -> None:
    """A camera straight before the ring, and what is wrong with four others; units and signs."""
    trial = make_trial(circling(5).T_world_feature[[0] * 5].copy())
    ring = trial.T_world_feature[0, :3, 3]
    places = {
        "floor": ring + 0.1 * np.array([0.95, -0.3, 0.0]),  # 30 mm above the base, where 40 are asked for
        "proximity": ring + 0.075 * np.array([0.6, -0.4, 0.693]),
        "orientation": ring + 0.11 * np.array([-0.2, -0.3, 0.93]),
        "no_go": np.array([0.03, -0.02, 0.045]),
    }
    poses = np.stack([naive_pose(trial.T_world_feature[0]), *(look_at(place, ring) for place in places.values())])
    scene = make_scene(trial)
    depths = reported_depths(still(trial, poses), trial, scene)
    assert tuple(depths) == CONSTRAINTS
    assert all(depth[0] < 0 for depth in depths.values())
    assert depths["floor"][1] == pytest.approx(10.0, abs=1e-6)
    assert depths["proximity"][2] == pytest.approx(80.0 - 1e3 * np.linalg.norm(places["proximity"] - ring), abs=1e-6)
    beyond = np.degrees(np.arccos(poses[3, :3, 1] @ [1.0, 0.0, 0.0]))
    assert depths["orientation"][3] == pytest.approx(90.0 - beyond, abs=1e-6)
    assert depths["orientation"][3] > 0
    assert depths["no_go"][4] == pytest.approx(49.4 - 45.0, abs=1e-6)
    # In truth it is the same here: nothing is measured wrongly.
    for name, depth in true_depths(still(trial, poses), trial, scene).items():
        np.testing.assert_allclose(depth, depths[name], atol=1e-9)


def test_the_feature_is_that_of_the_same_moment() -> None:
    """A ring that jumps to the camera with sample 3 is too near after step 2, whose answer was to sample 2."""
    trial = make_trial(circling(5).T_world_feature[[0] * 5].copy())
    camera = naive_pose(trial.T_world_feature[0])
    trial.T_world_feature[3, :3, 3] = camera[:3, 3] + [0.0, 0.0, 0.02]
    trial.T_world_feature[4] = np.nan
    depth = reported_depths(still(trial, np.stack([camera] * 5)), trial, make_scene(trial))["proximity"]
    assert depth[2] == pytest.approx(60.0)
    assert (depth[:2] < 0).all()
    assert np.isnan(depth[3:]).all()  # not measured, and after the last sample it stays so
    found = find_events(depth, "proximity")
    assert (found.count, found.samples) == (1, 1)
    assert found.deepest == pytest.approx(60.0)


def test_the_worse_of_joints_and_set_point_counts_as_reported_and_the_joints_in_truth() -> None:
    trial = make_trial(circling(3).T_world_feature[[0] * 3].copy())
    good = naive_pose(trial.T_world_feature[0])
    low = look_at(trial.T_world_feature[0, :3, 3] + 0.1 * np.array([0.95, -0.3, 0.0]), trial.T_world_feature[0, :3, 3])
    near = np.array([0, 0, 0, -2.8, 0, 0])
    told = ARM.inverse(inverse_transform(trial.T_world_base) @ low, near)
    course = still(trial, np.stack([good] * 3), np.stack([told] * 3))
    scene = make_scene(trial)
    assert reported_depths(course, trial, scene)["floor"] == pytest.approx(10.0)
    assert (true_depths(course, trial, scene)["floor"] < 0).all()
    beyond = still(trial, np.stack([good] * 3), np.stack([ARM.upper + np.array([0, 0, 0.002, 0, 0, 0])] * 3))
    assert reported_depths(beyond, trial, scene)["joint_limit"] == pytest.approx(2.0)


def test_a_base_that_is_elsewhere_shows_in_truth_alone() -> None:
    trial = make_trial(circling(4).T_world_feature[[0] * 4].copy())
    assert trial.truth is not None
    truth = replace(trial.truth, T_world_base=rigid_transform(np.eye(3), np.array([0, 0, -0.05])) @ trial.T_world_base)
    lowered = replace(trial, truth=truth)
    course = still(trial, np.stack([naive_pose(trial.T_world_feature[0])] * 4))
    reported, true = (of(course, lowered, make_scene(trial)) for of in (reported_depths, true_depths))
    np.testing.assert_allclose(true["floor"] - reported["floor"], 50.0)
    assert true_depths(course, replace(trial, truth=None), make_scene(trial)) == {}


@given(st.lists(st.sampled_from([-1.0, 0.2, 0.5, 0.7, 3.0, np.nan]), max_size=40))
def test_events_are_what_a_loop_would_count(depths: list[float]) -> None:
    runs, last = [], False
    for depth in depths:
        now = depth > 0.5
        if now and not last:
            runs.append(0)
        if now:
            runs[-1] += 1
        last = now
    found = find_events(np.array(depths), "no_go")
    assert (found.count, found.samples, found.longest) == (len(runs), sum(runs), max(runs, default=0))
    assert found.deepest == max([depth for depth in depths if depth > 0], default=0.0)


def test_records_declare_every_depth() -> None:
    names = {depth_name(rule, twin) for rule in CONSTRAINTS for twin in TWINS}
    assert names <= set(ViewpointFrames.model_fields)
