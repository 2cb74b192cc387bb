"""All six joints of the camera arm against values verified on a robot, finite differences and its own inverses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgbench.geometry import FloatArray, is_rigid
from surgbench.instrument.arm import CLASSIC_420006
from surgbench.viewpoint import kinematics
from surgbench.viewpoint.camera_arm import CameraArm

ARM = CameraArm()
# Without a camera, so that poses are those of the tool's tip, as the robot gives them.
TOOL = CameraArm(camera_m=0.0)

# Roll within a turn, so that it is unique; the wrist below the remote centre.
joints_within = st.tuples(
    st.floats(-1.588, 1.588),
    st.floats(-0.925, 0.925),
    st.floats(0.02, 0.24),
    st.floats(-3.14, 3.14),
    st.floats(-1.396, 1.396),
    st.floats(-1.396, 1.396),
).map(np.array)


def test_forward_kinematics_are_those_of_the_robot() -> None:
    """A ProGrasp 420093; the third is a typical pose of an arm that holds a camera."""
    straight = TOOL.forward(np.array([0, 0, 0.1, 0, 0, 0]))
    np.testing.assert_allclose(straight[:3, 3], [0, 0, -0.1459], atol=1e-12)
    np.testing.assert_allclose(straight[:3, :3], [[0, 1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-12)
    bent = TOOL.forward(np.array([0.1, -0.2, 0.15, 0.3, -0.4, 0.5]))
    np.testing.assert_allclose(bent[:3, 3], [0.020231140763, 0.042652841338, -0.189302373692], atol=1e-11)
    rotation = [
        [0.215278041887, 0.744776678262, 0.631635230333],
        [0.785017814675, -0.516705468806, 0.341705266492],
        [0.580863491126, 0.422283267515, -0.695898301947],
    ]
    np.testing.assert_allclose(bent[:3, :3], rotation, atol=1e-11)
    typical = TOOL.forward(np.array([-0.584, -0.497, 0.081, -2.758, -0.278, 0.164]))
    np.testing.assert_allclose(typical[:3, 3], [-0.06293686482, 0.057915269875, -0.0932357739], atol=1e-10)


def test_jacobian_is_that_of_the_robot() -> None:
    jacobian = np.empty((6, 6))
    kinematics.jacobian(ARM.packed, np.array([0.1, -0.2, 0.15, 0.3, -0.4, 0.5]), 0.0, jacobian)
    expected = [
        [0.189302, 0, 0.020231, 0, -1, 0],
        [0.004258, -0.190376, -0.042440, -0.995004, 0, -0.099833],
        [0.097843, 0.198669, -0.975170, 0, 0, 0],
        [0.003985, -0.001207, 0.000154, 0.097843, 0.198669, -0.975170],
        [-0.002303, -0.008400, -0.006215, -0.956425, 0.289629, -0.036957],
        [0, 0, 0, -0.215278, -0.785018, -0.580863],
    ]
    np.testing.assert_allclose(jacobian.T, expected, atol=6e-7)


def test_the_first_four_joints_are_those_of_the_manipulator() -> None:
    """With a straight wrist the tool lies on the shaft's line, beyond the wrist."""
    joints = np.array([0.3, -0.4, 0.12, 0.8, 0.0, 0.0])
    wrist, tool = CLASSIC_420006.forward(joints[:4]), TOOL.forward(joints)
    np.testing.assert_allclose(tool[:3, 3], wrist[:3, 3] + ARM.wrist_length_m * wrist[:3, 2], atol=1e-15)
    np.testing.assert_allclose(tool[:3, 2], wrist[:3, 2], atol=1e-15)


@given(joints_within)
def test_the_camera_looks_along_the_tool(joints: FloatArray) -> None:
    camera, tool = ARM.forward(joints), TOOL.forward(joints)
    assert is_rigid(camera, 1e-12)
    np.testing.assert_array_equal(camera[:3, :3], tool[:3, :3])
    np.testing.assert_allclose(camera[:3, 3], tool[:3, 3] + 0.045 * tool[:3, 2], atol=1e-15)


@given(joints_within)
def test_inverse_undoes_forward(joints: FloatArray) -> None:
    np.testing.assert_allclose(ARM.inverse(ARM.forward(joints)), joints, atol=1e-11)


@given(joints_within, st.floats(-4.5, 4.5))
def test_the_roll_is_given_in_the_nearest_turn(joints: FloatArray, near: float) -> None:
    close = np.array([0, 0, 0, near, 0, 0])
    roll = ARM.inverse(ARM.forward(joints), close)[3]
    assert abs(roll - near) <= np.pi + 1e-9
    assert np.cos(roll - joints[3]) == pytest.approx(1.0, abs=1e-10)


@given(joints_within)
def test_jacobian_is_the_derivative_of_forward(joints: FloatArray) -> None:
    step, jacobian = 1e-6, np.empty((6, 6))
    kinematics.jacobian(ARM.packed, joints, ARM.camera_m, jacobian)
    ahead, behind = ARM.forward(joints + step * np.eye(6)), ARM.forward(joints - step * np.eye(6))
    velocity = (ahead[:, :3, 3] - behind[:, :3, 3]) / (2 * step)
    spin = (ahead[:, :3, :3] - behind[:, :3, :3]) / (2 * step) @ ARM.forward(joints)[:3, :3].T
    turning = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    np.testing.assert_allclose(jacobian, np.hstack([velocity, turning]).T, atol=1e-8)


@given(joints_within, st.lists(st.floats(-0.15, 0.15), min_size=6, max_size=6))
def test_newton_finds_what_the_closed_form_finds(joints: FloatArray, away: list[float]) -> None:
    """From as far as a hand moves the feature in a second; near the remote centre the insertion's step is smaller."""
    start = ARM.clip(joints + np.array(away) * [1, 1, 0.1, 1, 1, 1])
    found, converged = ARM.newton(ARM.forward(joints), start)
    assert converged
    np.testing.assert_allclose(ARM.forward(found), ARM.forward(joints), atol=1e-8)


@given(st.lists(st.floats(-2.0, 2.0), min_size=12, max_size=12))
def test_poses_out_of_reach_have_finite_joints(numbers: list[float]) -> None:
    """Even where the camera is in the remote centre itself."""
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(np.reshape(numbers[:9], (3, 3)) + 1e-3 * np.eye(3))[0]
    pose[:3, 3] = numbers[9:]
    assert np.isfinite(ARM.inverse(pose)).all()
    centre = np.eye(4)
    centre[2, 3] = ARM.camera_m
    assert np.isfinite(ARM.inverse(centre)).all()
