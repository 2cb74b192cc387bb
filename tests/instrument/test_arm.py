"""The arm's kinematics against values verified on a robot, finite differences and its own inverse."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgbench.errors import ConfigError, NotFoundError
from surgbench.geometry import FloatArray
from surgbench.instrument.arm import CLASSIC_400006, CLASSIC_420006, Manipulator
from surgbench.instrument.arms import load_arm

# A ProGrasp 420093 on a Classic arm: the wrist's two joints after frame 4, and the robot's orientation of the tool tip.
WRIST_LENGTH_M = 0.0107
TOOL_TIP = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])


def link(a_m: float, theta_rad: float) -> FloatArray:
    """One modified Denavit-Hartenberg transform with alpha = -pi/2."""
    c, s = np.cos(theta_rad), np.sin(theta_rad)
    return np.array([[c, -s, 0, a_m], [0, 0, 1, 0], [-s, -c, 0, 0], [0, 0, 0, 1.0]])


def tool(joints: list[float]) -> FloatArray:
    """T_base_tool of all six joints, as the robot gives it."""
    wrist = CLASSIC_420006.forward(np.array(joints[:4]))
    tip = wrist @ link(0.0, joints[4] - np.pi / 2) @ link(WRIST_LENGTH_M, joints[5] - np.pi / 2)
    tip[:3, :3] = tip[:3, :3] @ TOOL_TIP
    return tip


def test_forward_kinematics_are_those_of_the_robot() -> None:
    straight = tool([0, 0, 0.1, 0, 0, 0])
    np.testing.assert_allclose(straight[:3, 3], [0, 0, -0.1459], atol=1e-12)
    np.testing.assert_allclose(straight[:3, :3], [[0, 1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-12)
    bent = tool([0.1, -0.2, 0.15, 0.3, -0.4, 0.5])
    np.testing.assert_allclose(bent[:3, 3], [0.020231140763, 0.042652841338, -0.189302373692], atol=1e-11)
    rotation = [
        [0.215278041887, 0.744776678262, 0.631635230333],
        [0.785017814675, -0.516705468806, 0.341705266492],
        [0.580863491126, 0.422283267515, -0.695898301947],
    ]
    np.testing.assert_allclose(bent[:3, :3], rotation, atol=1e-11)
    camera_arm = tool([-0.584, -0.497, 0.081, -2.758, -0.278, 0.164])
    np.testing.assert_allclose(camera_arm[:3, 3], [-0.06293686482, 0.057915269875, -0.0932357739], atol=1e-10)


def test_jacobian_is_that_of_the_robot() -> None:
    joints = [0.1, -0.2, 0.15, 0.3, -0.4, 0.5]
    jacobian = CLASSIC_420006.jacobian(np.array(joints[:4]))
    lever = tool(joints)[:3, 3] - CLASSIC_420006.forward(np.array(joints[:4]))[:3, 3]
    jacobian[:3] += np.cross(jacobian[3:].T, lever).T
    expected = [
        [0.189302, 0, 0.020231, 0, -1, 0],
        [0.004258, -0.190376, -0.042440, -0.995004, 0, -0.099833],
        [0.097843, 0.198669, -0.975170, 0, 0, 0],
        [0.003985, -0.001207, 0.000154, 0.097843, 0.198669, -0.975170],
    ]
    np.testing.assert_allclose(jacobian.T, expected, atol=6e-7)


# Roll within a turn, so that it is unique; the wrist below the remote centre.
joints_within = st.tuples(
    st.floats(-1.588, 1.588), st.floats(-0.925, 0.925), st.floats(0.02, 0.24), st.floats(-3.14, 3.14)
).map(np.array)
arms = st.sampled_from([CLASSIC_400006, CLASSIC_420006])


@given(joints_within, arms)
def test_inverse_undoes_forward(joints: FloatArray, arm: Manipulator) -> None:
    pose = arm.forward(joints)
    assert arm.within_limits(joints)
    np.testing.assert_allclose(arm.inverse(pose), joints, atol=1e-12)
    np.testing.assert_allclose(arm.reach(pose[:3, 3]), joints[:3], atol=1e-12)
    # The shaft passes through the remote centre.
    np.testing.assert_allclose(np.cross(pose[:3, 3], pose[:3, 2]), 0.0, atol=1e-15)
    assert np.linalg.norm(pose[:3, 3]) == pytest.approx(float(arm.depth_m(joints[2])))


@given(joints_within, arms)
def test_jacobian_is_the_derivative_of_forward(joints: FloatArray, arm: Manipulator) -> None:
    step = 1e-6
    ahead, behind = arm.forward(joints + step * np.eye(4)), arm.forward(joints - step * np.eye(4))
    velocity = (ahead[:, :3, 3] - behind[:, :3, 3]) / (2 * step)
    spin = (ahead[:, :3, :3] - behind[:, :3, :3]) / (2 * step) @ arm.forward(joints)[:3, :3].T
    turning = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    np.testing.assert_allclose(arm.jacobian(joints), np.hstack([velocity, turning]).T, atol=1e-8)


def test_stacks_of_joints_and_limits() -> None:
    joints = np.array([[0.1, -0.2, 0.15, 0.3], [1.6, 0.0, 0.1, 0.0], [0.0, 0.0, 0.25, 0.0]])
    assert CLASSIC_400006.within_limits(joints).tolist() == [True, False, False]
    many = CLASSIC_400006.forward(joints[:, None])
    assert many.shape == (3, 1, 4, 4)
    np.testing.assert_array_equal(many[1, 0], CLASSIC_400006.forward(joints[1]))
    # The shorter instrument of the Classic arm does not reach below the remote centre when drawn out.
    assert CLASSIC_400006.depth_m(0.0) == pytest.approx(-0.0156)
    drawn_out = np.array([0.3, 0.2, 0.0, 1.0])
    np.testing.assert_allclose(CLASSIC_400006.inverse(CLASSIC_400006.forward(drawn_out)), drawn_out, atol=1e-12)


@pytest.mark.parametrize(("name", "arm"), [("classic_400006", CLASSIC_400006), ("classic_420006", CLASSIC_420006)])
def test_arms_of_a_file_are_those_with_a_closed_form(name: str, arm: Manipulator) -> None:
    told = load_arm(name)
    joints = np.array([[0.1, -0.2, 0.15, 0.3], [-1.2, 0.8, 0.05, -2.0]])
    # Offsets in the robot's own files are rounded to the fourth decimal of a radian.
    np.testing.assert_allclose(told.forward(joints), arm.forward(joints), atol=1e-5)
    assert told.wrist_joints == 4
    limits = np.array([joint.limits for joint in told.joints[:4]])
    np.testing.assert_array_equal(limits, np.stack([arm.lower, arm.upper], axis=1))
    assert told.within_limits(np.array([[0.1, -0.2, 0.15, 0.3], [1.6, 0, 0.1, 0]])).tolist() == [True, False]


def test_a_files_whole_chain_ends_where_the_robot_says() -> None:
    bent = np.array([0.1, -0.2, 0.15, 0.3, -0.4, 0.5])
    told = load_arm("classic_420006").forward_tip(bent)
    expected = tool(bent.tolist())
    np.testing.assert_allclose(told[:3, :3], expected[:3, :3], atol=2e-5)
    # That one has a wrist of 10.7 mm, the needle driver one of 9.1 mm.
    assert np.linalg.norm(told[:3, 3] - expected[:3, 3]) == pytest.approx(WRIST_LENGTH_M - 0.0091, abs=1e-5)


def test_the_si_is_as_deep_as_the_classic() -> None:
    """Its insertion begins higher by as much as its instruments are longer."""
    joints = np.array([0.2, 0.1, 0.12, 0.4])
    classic, si, mixed = (load_arm(name).forward(joints) for name in ("classic_400006", "si_420006", "classic_420006"))
    np.testing.assert_allclose(si, classic, atol=1e-12)
    assert np.linalg.norm(mixed[:3, 3] - classic[:3, 3]) == pytest.approx(0.4670 - 0.4162)


def test_an_arm_of_another_make(tmp_path: Path) -> None:
    """Two joints in a plane, as everybody has met them."""
    path = tmp_path / "planar.yaml"
    joints = "[{name: a, kind: revolute, limits: [-3, 3]}, {name: b, kind: revolute, a_m: 0.3, limits: [-3, 3]},"
    joints += " {name: c, kind: prismatic, a_m: 0.2, limits: [0, 1]}]"
    path.write_text(f"format: surgbench-arm-1\nname: planar\ntitle: two links\nwrist: c\njoints: {joints}\n")
    pose = load_arm(path).forward(np.array([0.4, 0.5, 0.1]))
    np.testing.assert_allclose(
        pose[:3, 3], [0.3 * np.cos(0.4) + 0.2 * np.cos(0.9), 0.3 * np.sin(0.4) + 0.2 * np.sin(0.9), 0.1]
    )
    assert np.isnan(load_arm(path).forward(np.array([0.4, np.nan, 0.1]))[0, 3])
    for spoilt, says in (
        (path.read_text().replace("wrist: c", "wrist: d"), "wrist 'd' is none of the joints"),
        (path.read_text().replace("limits: [0, 1]", "limits: [1, 0]"), "limits of 'c' must be"),
        (path.read_text().replace("prismatic,", "prismatic, d_m: 1,"), "'c' is prismatic"),
    ):
        path.with_name("spoilt.yaml").write_text(spoilt)
        with pytest.raises(ConfigError, match=says):
            load_arm(path.with_name("spoilt.yaml"))
    with pytest.raises(NotFoundError, match="did you mean 'classic_400006'"):
        load_arm("clasic_400006")
