"""What the robot reads of its own tool, against the true pose."""

from __future__ import annotations

import numpy as np
import pytest

from surgbench.dataset import tables
from surgbench.generators.generate import plan_dataset
from surgbench.generators.observations import Kinematic, cable_tension, observe_arm, observe_free_tool, observe_joints
from surgbench.generators.presets import Readings, load_preset
from surgbench.generators.sections import Kinematics
from surgbench.generators.sequence import make_tables
from surgbench.geometry import (
    FloatArray,
    inverse_transform,
    is_rigid,
    look_at_rotation,
    rigid_transform,
    rotation_from_vector,
    rotation_vector,
)
from surgbench.instrument.arm import CLASSIC_400006
from surgbench.randomness import generator
from surgbench.state import ANGLES, POSITION
from surgbench.tasks.instrument.tables import KINEMATICS_COLUMNS, arm_columns

DT_S = 1 / 30
EXACT = Kinematics.model_validate({name: 0.0 for name in Kinematics.model_fields})
BASE = rigid_transform(rotation_from_vector(np.array([0.4, -1.0, 2.0])), np.array([-0.12, 0.02, 0.01]))


def arm_joints(frames: int) -> FloatArray:
    """All four joints swing to and fro, one way for at least 2 s."""
    phase = 2 * np.pi * np.arange(frames) * DT_S / 4.0
    swing = np.stack([np.sin(phase), np.cos(phase), 0.1 * np.sin(phase), np.sin(phase)], axis=1)
    joints: FloatArray = np.array([0.1, -0.2, 0.16, 0.5]) + 0.2 * swing
    return joints


def read(settings: Kinematics, seed: int = 0, frames: int = 600) -> tuple[Kinematic, FloatArray]:
    """Readings of an arm, and the joints that they are the forward kinematics of, less the true ones."""
    joints = arm_joints(frames)
    seen = observe_arm(joints, CLASSIC_400006, BASE, settings, DT_S, generator(test=seed))
    return seen, CLASSIC_400006.inverse(seen.T_base_tool) - joints


def still_state() -> FloatArray:
    return np.tile([-0.3, 0.4, 0.8, 0.01, -0.01, 0.13, 0.0, 0.0, 0.0], (600, 1))


def test_without_errors_the_robot_knows_its_tool() -> None:
    seen, errors = read(EXACT)
    np.testing.assert_allclose(seen.T_cam_base, BASE, atol=1e-15)
    np.testing.assert_allclose(errors, 0.0, atol=1e-12)
    states = still_state()
    free = observe_free_tool(states, EXACT, generator(test=0))
    true = rigid_transform(look_at_rotation(states[:, ANGLES]), states[:, POSITION])
    np.testing.assert_allclose(free.T_base_tool, true, atol=1e-15)
    np.testing.assert_array_equal(free.T_cam_base, np.eye(4))


@pytest.mark.slow
def test_hand_eye_calibration_errs_by_what_it_is_told() -> None:
    settings = EXACT.model_copy(update={"hand_eye_rad": 0.02, "hand_eye_m": 0.003})
    errors, lumped = [], []
    for seed in range(300):
        joints = arm_joints(2)
        seen = observe_arm(joints, CLASSIC_400006, BASE, settings, DT_S, generator(test=seed))
        errors.append(inverse_transform(seen.T_cam_base) @ BASE)
        # The base is wrong, what the robot reads in it is not.
        np.testing.assert_allclose(seen.T_base_tool, CLASSIC_400006.forward(joints), atol=1e-15)
        state = still_state()[:2]
        free = observe_free_tool(state, settings, generator(test=seed))
        true = rigid_transform(look_at_rotation(state[:, ANGLES]), state[:, POSITION])
        lumped.append((true @ inverse_transform(free.T_base_tool))[0])
    for transforms in (np.array(errors), np.array(lumped)):
        assert rotation_vector(transforms[:, :3, :3]).std() == pytest.approx(0.02, rel=0.1)
        assert transforms[:, :3, 3].std() == pytest.approx(0.003, rel=0.1)


@pytest.mark.parametrize(
    ("part", "within", "between"),
    [("bias", 0.0, 1.0), ("noise", 1.0, 0.0)],
)
def test_encoders_have_bias_and_noise(part: str, within: float, between: float) -> None:
    settings = EXACT.model_copy(update={f"{part}_rad": 0.01, f"{part}_m": 0.001})
    errors = np.array([read(settings, seed, frames=100)[1] for seed in range(200)]) / [0.01, 0.01, 0.001, 0.01]
    np.testing.assert_allclose(errors.std(axis=1).mean(axis=0), within, atol=0.05)
    np.testing.assert_allclose(errors.mean(axis=1).std(axis=0), between, atol=0.2)


def test_drift_is_slow_and_stationary() -> None:
    settings = EXACT.model_copy(update={"drift_rad": 0.01, "drift_m": 0.001, "drift_rho": 0.99})
    errors = np.array([read(settings, seed, frames=300)[1] for seed in range(200)]) / [0.01, 0.01, 0.001, 0.01]
    for frame in (0, 299):
        np.testing.assert_allclose(errors[:, frame].std(axis=0), 1.0, rtol=0.2)
    np.testing.assert_allclose(np.diff(errors, axis=1).std(axis=(0, 1)), np.sqrt(2 * (1 - 0.99)), rtol=0.05)
    states = still_state()
    true = rigid_transform(look_at_rotation(states[:, ANGLES]), states[:, POSITION])
    free = [observe_free_tool(states, settings, generator(test=seed)).T_base_tool for seed in range(50)]
    lumped = true @ inverse_transform(np.array(free))
    assert rotation_vector(lumped[..., :3, :3]).std() == pytest.approx(0.01, rel=0.2)
    assert np.diff(lumped[..., :3, 3], axis=1).std() == pytest.approx(0.001 * np.sqrt(0.02), rel=0.05)


def test_stretched_cables_let_readings_run_ahead() -> None:
    settings = EXACT.model_copy(update={"stretch_rad": 0.01, "stretch_m": 0.001})
    _, errors = read(settings)
    ahead = np.sign(np.gradient(arm_joints(600), axis=0))
    size = np.array([0.01, 0.01, 0.001, 0.01])
    assert (np.abs(errors) <= size * (1 + 1e-9)).all()
    # Fully but for the turning points.
    assert (np.abs(errors - ahead * size) < 0.1 * size).mean() > 0.8
    assert not cable_tension(np.zeros((5, 2)), DT_S, 0.02).any()
    # The wrist's joints too, if the preset says so.
    states = np.zeros((600, 9))
    states[:, 6:] = arm_joints(600)[:, :3]
    exact = {"bias_rad": 0.0, "drift_rad": 0.0, "noise_rad": 0.0}
    wrist = observe_joints(states, Readings(**exact, stretch_rad=0.02), DT_S, generator(test=0)) - states[:, 6:]
    assert (np.abs(wrist - 0.02 * ahead[:, :3]) < 0.002)[:, :2].mean() > 0.8


@pytest.mark.parametrize("name", ["mini", "paper-rcm"])
def test_what_a_preset_makes(name: str) -> None:
    plan = plan_dataset(load_preset(name, pairs=1, frames=60))
    made = make_tables(plan.preset, plan.sequences[0], plan.real_instrument, plan.real_camera)
    for index, arm in enumerate(plan.sequences[0].arms):
        poses = tables.stack(made.observed, arm_columns(arm, KINEMATICS_COLUMNS))
        read_pose = rigid_transform(rotation_from_vector(poses[:, :3]), poses[:, 3:])
        nominal = np.reshape(made.T_cam_base[arm], (4, 4))
        assert is_rigid(nominal)
        assert np.array_equal(nominal, np.eye(4)) == (name == "mini")
        states = made.states[:, index]
        seen = nominal @ read_pose
        error_m = np.linalg.norm(seen[:, :3, 3] - states[:, POSITION], axis=1)
        assert 1e-4 < error_m.mean() < 0.02
        assert error_m.std() < 0.002
        if name == "paper-rcm":
            # What the arm's first four joints give: the shaft passes through the base's origin.
            across = np.cross(read_pose[:, :3, 3], read_pose[:, :3, 2])
            np.testing.assert_allclose(across, 0.0, atol=1e-9)
