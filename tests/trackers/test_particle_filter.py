"""The lumped-error particle filter on scenes whose lumped error is known."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from support import observe, resting_state, scene_of

from surgbench.camera import Camera
from surgbench.contract import Estimate, Observation, Scene, Trace
from surgbench.errors import ConfigError
from surgbench.geometry import (
    FloatArray,
    inverse_transform,
    look_at_angles,
    look_at_rotation,
    rigid_transform,
    rotation_from_vector,
)
from surgbench.metrics import pose_errors
from surgbench.state import split_arms
from surgbench.trackers.observations.lumped_error import LumpedErrorFilter
from surgbench.trackers.particle_filter import ParticleFilterTracker

# Bases of two arms in the camera frame, each about 20 cm from its instrument.
BASES = rigid_transform(
    rotation_from_vector(np.array([[2.0, 0.3, -0.4], [1.5, -0.8, 0.6]])),
    np.array([[-0.12, -0.1, 0.1], [0.14, -0.1, 0.1]]),
)


def pose_of(state: FloatArray) -> FloatArray:
    return rigid_transform(look_at_rotation(state[..., :3]), state[..., 3:6])


def with_pose(state: FloatArray, pose: FloatArray) -> FloatArray:
    return np.concatenate([look_at_angles(pose[..., :3, :3]), pose[..., :3, 3], state[..., 6:]], axis=-1)


def lumped(values: list[float] | FloatArray) -> FloatArray:
    """T_LE of ``[t, r]``, metres and radians."""
    return rigid_transform(rotation_from_vector(np.asarray(values)[..., 3:]), np.asarray(values)[..., :3])


ERROR = lumped([0.0015, -0.001, 0.001, 0.012, -0.008, 0.01])


def robotic(camera: Camera, arms: int = 1) -> Scene:
    return replace(scene_of(camera, arms), T_cam_base=BASES[:arms])


def frame(
    scene: Scene, truth: FloatArray, error: FloatArray = ERROR, index: int = 0, bias: FloatArray | float = 0.0
) -> Observation:
    """What a scene shows in a state, tips included, with readings that are wrong by a lumped error and a bias."""
    assert scene.T_cam_base is not None
    arms = split_arms(truth)
    kinematics = [
        inverse_transform(base @ error) @ pose_of(state) for base, state in zip(scene.T_cam_base, arms, strict=True)
    ]
    joints = arms[:, 6:] + bias
    seen = observe(scene, truth, index, joints[0] if scene.arms == 1 else joints)
    camera = scene.views[0].camera
    tips = tuple(camera.project(one.tips_cam(state)) for one, state in zip(scene.instruments, arms, strict=True))
    return replace(seen, views=(replace(seen.views[0], keypoints=tips),), kinematics=np.stack(kinematics))


def off(scene: Scene, truth: FloatArray, error: FloatArray = ERROR) -> FloatArray:
    """The state that the readings alone would give."""
    assert scene.T_cam_base is not None
    arms = split_arms(truth)
    places = zip(scene.T_cam_base, arms, strict=True)
    poses = [base @ inverse_transform(base @ error) @ pose_of(state) for base, state in places]
    return np.concatenate([with_pose(state, pose) for state, pose in zip(arms, poses, strict=True)])


def tracker(scene: Scene, start: FloatArray, seed: int = 0, **options: object) -> ParticleFilterTracker:
    made = ParticleFilterTracker(ParticleFilterTracker.Config.model_validate(options))
    made.reset(scene, start, np.random.default_rng(seed))
    return made


def errors(scene: Scene, estimate: FloatArray, truth: FloatArray) -> dict[str, float]:
    found = pose_errors(scene.instruments[0], scene.views[0].camera, estimate[None], truth[None])
    return {name: float(values[0]) for name, values in found.items()}


def test_it_finds_the_lumped_error_of_a_still_scene(camera: Camera) -> None:
    scene, truth = robotic(camera), resting_state()
    start = off(scene, truth)
    before = errors(scene, start, truth)
    assert before["translation_error_m"] > 2e-3
    filter_ = tracker(scene, start, particles=1000, joint_errors=False)
    seen = frame(scene, truth)
    estimates = [filter_.step(seen) for _ in range(40)][20:]
    late = [errors(scene, estimate.state, truth) for estimate in estimates]
    # Depth is told by the shaft's width alone, and its tube has 20 sides: 1 % of the width, 1 mm of depth.
    shares = {"keypoint_error_px": 0.1, "translation_error_m": 0.75, "tip_error_m": 0.75}
    for name, share in shares.items():
        assert np.mean([found[name] for found in late]) < share * before[name]
    assert np.mean([estimate.confidence for estimate in estimates]) > 0.94


@pytest.mark.slow
def test_it_follows_a_moving_arm_far_better_than_its_readings(camera: Camera) -> None:
    """The error drifts, too."""
    scene = robotic(camera)
    steps = np.linspace(0, 1, 40)[:, None]
    truths = resting_state() + steps * np.array([0.15, 0.3, 0.1, 8e-3, 6e-3, 5e-3, 0.4, 0.3, 0.1])
    drift = np.array([0.0015, -0.001, 0.001, 0.012, -0.008, 0.01]) + steps * np.array([5e-4, 0, 5e-4, 2e-3, -2e-3, 0])
    filter_ = tracker(scene, off(scene, truths[0]), particles=1000, joint_errors=False)
    prior: list[list[float]] = []
    posterior: list[list[float]] = []
    resampled = 0
    for index, (truth, error) in enumerate(zip(truths, lumped(drift), strict=True)):
        estimate = filter_.step(frame(scene, truth, error, index))
        resampled += filter_._arms[0].resampled
        for found, state in ((prior, off(scene, truth, error)), (posterior, estimate.state)):
            found.append([errors(scene, state, truth)[name] for name in ("keypoint_error_px", "tip_error_m")])
        assert not estimate.lost
    pixels, metres = np.mean(posterior[20:], axis=0) / np.mean(prior[20:], axis=0)
    assert pixels < 0.15
    assert metres < 0.6
    assert 1 <= resampled < 40


@pytest.mark.slow
def test_it_finds_the_errors_of_the_wrists_readings(camera: Camera) -> None:
    scene, truth = robotic(camera), resting_state()
    bias = np.array([0.05, -0.04, 0.04])
    seen = frame(scene, truth, np.eye(4), bias=bias)
    found, told = (tracker(scene, truth, particles=1000, joint_errors=asked) for asked in (True, False))
    joints = np.array([[each.step(seen).state[6:] for each in (found, told)] for _ in range(60)])[30:].mean(axis=0)
    np.testing.assert_allclose(joints[1], truth[6:] + bias)
    assert np.abs(joints[0] - truth[6:]).mean() < 0.75 * np.abs(bias).mean()


def test_the_first_particles_surround_the_start(camera: Camera) -> None:
    """Whatever the kinematics say: the lumped error is what lies between them and the start."""
    scene, truth = robotic(camera), resting_state()
    blind = frame(scene, truth, lumped([0.05, 0.02, -0.04, 0.5, -0.9, 2.0]))
    blind = replace(blind, views=(replace(blind.views[0], keypoints=(None,)),))
    estimate = tracker(scene, truth, particles=4000, shaft=False).step(blind)
    found = errors(scene, estimate.state, truth)
    # 1 mm, and 10 mrad at 0.2 m, over the root of 4000.
    assert found["translation_error_m"] < 2e-4
    assert found["rotation_error_rad"] < 1e-3


def test_a_second_camera_alone_is_enough(camera: Camera) -> None:
    """What the reference camera does not see, the other one tells."""
    scene, truth = robotic(camera), resting_state()
    T_view_cam = lumped([-0.02, 0.0, 0.0, 0.0, -0.15, 0.0])
    beside = with_pose(truth, T_view_cam @ pose_of(truth))
    other = replace(frame(scene, beside).views[0], T_view_cam=T_view_cam)
    scene = replace(scene, views=(*scene.views, replace(other, mask=np.zeros_like(other.mask), keypoints=(None,))))
    seen = frame(scene, truth)
    blind = replace(seen.views[0], mask=np.zeros_like(seen.mask), keypoints=(None,))
    seen = replace(seen, views=(blind, other))
    start = off(scene, truth)
    filter_ = tracker(scene, start, particles=1000, joint_errors=False)
    late = np.mean([errors(scene, filter_.step(seen).state, truth)["keypoint_error_px"] for _ in range(30)][15:])
    assert late < 0.3 * errors(scene, start, truth)["keypoint_error_px"]


@pytest.mark.slow
def test_two_arms_in_one_mask_have_clouds_of_their_own(camera: Camera) -> None:
    scene = robotic(camera, arms=2)
    left, right = resting_state(), resting_state()
    left[[2, 3]], right[[2, 3]] = [0.8, -0.02], [-0.8, 0.025]
    truth = np.concatenate([left, right])
    start = off(scene, truth)
    filter_ = tracker(scene, start, particles=600)
    seen = frame(scene, truth)
    states = np.array([filter_.step(seen).state for _ in range(40)])[20:]
    assert states.shape == (20, 18)
    for arm, true in enumerate(split_arms(truth)):
        before = errors(scene, split_arms(start)[arm], true)["keypoint_error_px"]
        after = np.mean([errors(scene, split_arms(state)[arm], true)["keypoint_error_px"] for state in states])
        assert after < 0.2 * before


@pytest.mark.parametrize("arms", [1, 2])
def test_it_is_finite_and_says_when_it_is_lost(small_camera: Camera, arms: int) -> None:
    scene, truth = robotic(small_camera, arms), np.tile(resting_state(), arms)
    seen = frame(scene, truth)
    filter_ = tracker(scene, truth)
    for mask in (np.zeros_like(seen.mask), np.ones_like(seen.mask), seen.mask):
        for keypoints in ((None,) * arms, seen.views[0].keypoints):
            estimate = filter_.step(replace(seen, views=(replace(seen.views[0], mask=mask, keypoints=keypoints),)))
            assert np.isfinite(estimate.state).all()
            assert estimate.lost == (mask is not seen.mask)
            assert 0 <= estimate.confidence <= 1


def test_an_instrument_behind_the_camera_gives_no_nan(small_camera: Camera) -> None:
    scene, truth = robotic(small_camera), resting_state()
    estimate = tracker(scene, resting_state(-0.1)).step(frame(scene, truth))
    assert estimate.lost
    assert np.isfinite(estimate.state).all()


def test_joints_stay_within_their_limits(small_camera: Camera) -> None:
    scene, truth = robotic(small_camera), resting_state()
    truth[8] = 0.0
    filter_ = tracker(scene, truth, init_joint_rad=0.5)
    assert filter_.step(frame(scene, truth)).state[8] >= 0.0


def test_the_same_seed_gives_the_same_result_here_and_in_another_process(small_camera: Camera) -> None:
    scene, truth = robotic(small_camera), resting_state()
    seen = frame(scene, truth)
    one, again, other = (tracker(scene, off(scene, truth), seed) for seed in (0, 0, 1))
    for _ in range(3):
        states = [each.step(seen).state for each in (one, again, other)]
        np.testing.assert_array_equal(states[0], states[1])
        assert not np.array_equal(states[0], states[2])
        again = pickle.loads(pickle.dumps(again))


def test_without_kinematics_it_says_what_it_needs(small_camera: Camera) -> None:
    scene, truth = robotic(small_camera), resting_state()
    seen = frame(scene, truth)
    with pytest.raises(ConfigError, match="needs kinematics: a dataset with them, and --joints"):
        tracker(replace(scene, T_cam_base=None), truth)
    for missing in (replace(seen, kinematics=None), replace(seen, joints=None)):
        with pytest.raises(ConfigError, match="needs kinematics"):
            tracker(scene, truth).step(missing)


def test_a_frame_without_a_reading_is_taken_at_the_last_one(small_camera: Camera) -> None:
    scene, truth = robotic(small_camera), resting_state()
    seen = frame(scene, truth)
    one, other = tracker(scene, truth), tracker(scene, truth)
    for each in (one, other):
        each.step(seen)
    estimate = one.step(replace(seen, kinematics=None, joints=None))
    np.testing.assert_array_equal(estimate.state, other.step(seen).state)


def test_the_trace_holds_the_particles_heaviest_first(small_camera: Camera) -> None:
    scene, truth = robotic(small_camera, arms=2), np.tile(resting_state(), 2)
    filter_ = tracker(scene, truth)
    filter_.trace = Trace()
    estimate = filter_.step(frame(scene, truth))
    assert isinstance(estimate, Estimate)
    assert [states.shape for states in filter_.trace.states] == [(200, 18)]
    assert (np.diff(filter_.trace.losses[0]) >= 0).all()
    # The estimate is the mean of these particles by these weights (those of one arm here).
    one = filter_._arms[0]
    assert isinstance(one, LumpedErrorFilter)
    states, weights = one.ranked()
    np.testing.assert_allclose(weights @ states[:, 3:], estimate.state[3:9], atol=1e-12)
