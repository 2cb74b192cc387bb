"""The tool follows the hand as seen in the picture; it never jumps to another place."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgbench.camera import Camera
from surgbench.geometry import FloatArray, inverse_transform, is_rigid, rigid_transform, rotation_from_vector
from surgbench.viewpoint.optics.teleoperation import Teleoperation, TeleoperationError, TeleoperationSettings

CAMERA = Camera(width=512, height=384, fx=387.365, fy=385.763, cx=247.653, cy=187.991)
RIGHT, DOWN, FORWARD = np.eye(3)
SEEN = rigid_transform(rotation_from_vector(np.array([0.3, -0.8, 0.4])), np.array([0.01, -0.02, 0.11]))


def vectors(size: float) -> st.SearchStrategy[FloatArray]:
    return st.tuples(*[st.floats(-size, size)] * 3).map(np.array)


poses = st.builds(rigid_transform, vectors(3.0).map(rotation_from_vector), vectors(0.3))


def moved(pose: FloatArray, by_m: FloatArray) -> FloatArray:
    other = pose.copy()
    other[:3, 3] += by_m
    return other


def turned(pose: FloatArray, rotation: FloatArray) -> FloatArray:
    return rigid_transform(rotation @ pose[:3, :3], pose[:3, 3])


def started(master: FloatArray, camera: FloatArray, settings: TeleoperationSettings | None = None) -> Teleoperation:
    """A tool that the camera sees 11 cm before it, wherever the camera is."""
    operation = Teleoperation(settings)
    operation.reset(master, camera, camera @ SEEN)
    return operation


@pytest.mark.slow
@given(poses, poses)
def test_right_is_right_in_the_picture(master: FloatArray, camera: FloatArray) -> None:
    """So are down and away; 10 mm of the hand are 2 mm of the tool."""
    where = CAMERA.project(SEEN[:3, 3])
    for direction, pixels in ((RIGHT, (CAMERA.fx, 0)), (DOWN, (0, CAMERA.fy))):
        tool = started(master, camera).step(moved(master, 0.01 * direction), camera)
        now = CAMERA.project((inverse_transform(camera) @ tool)[:3, 3])
        np.testing.assert_allclose(now - where, np.array(pixels) * 0.002 / 0.11, atol=1e-6)
    tool = started(master, camera).step(moved(master, 0.01 * FORWARD), camera)
    np.testing.assert_allclose(inverse_transform(camera) @ tool, moved(SEEN, 0.002 * FORWARD), atol=1e-9)


@given(poses, poses, vectors(1.5))
def test_the_tool_turns_in_the_picture_as_the_master_before_the_display(
    master: FloatArray, camera: FloatArray, turn: FloatArray
) -> None:
    rotation = rotation_from_vector(turn)
    tool = started(master, camera).step(turned(master, rotation), camera)
    np.testing.assert_allclose(inverse_transform(camera) @ tool, turned(SEEN, rotation), atol=1e-9)


@given(st.floats(0.05, 2.0))
def test_scale(scale: float) -> None:
    operation = started(np.eye(4), np.eye(4), TeleoperationSettings(scale=scale))
    for count in range(1, 6):
        tool = operation.step(moved(np.eye(4), 0.003 * count * RIGHT), np.eye(4))
    np.testing.assert_allclose(tool, moved(SEEN, 0.015 * scale * RIGHT), atol=1e-12)


@pytest.mark.slow
@given(poses, poses, poses, poses)
def test_the_tool_rests_while_the_clutch_is_pressed_and_does_not_jump_on_release(
    master: FloatArray, elsewhere: FloatArray, camera: FloatArray, farther: FloatArray
) -> None:
    """Whatever hand and camera did meanwhile; then motion goes on from there, in the view as it is now."""
    operation = started(master, camera, TeleoperationSettings(mean_of=1))
    before = operation.step(moved(master, 0.02 * RIGHT), camera)
    for hand, eye in ((master, camera), (elsewhere, farther), (elsewhere, farther)):
        np.testing.assert_array_equal(operation.step(hand, eye, clutch=True), before)
        np.testing.assert_array_equal(operation.view, camera)
    hand = moved(elsewhere, 0.05 * DOWN)
    np.testing.assert_array_equal(operation.step(hand, farther), before)
    np.testing.assert_allclose(operation.step(hand, farther), before, atol=1e-9)
    after = operation.step(moved(hand, 0.01 * RIGHT), farther)
    np.testing.assert_allclose(after, moved(before, 0.002 * operation.view[:3, :3] @ RIGHT), atol=1e-9)
    if np.linalg.norm(farther[:3, 3] - camera[:3, 3]) > 0.0101:
        np.testing.assert_allclose(operation.view, farther, atol=1e-12)


def test_a_master_that_is_held_keeps_its_alignment_through_the_clutch() -> None:
    """As on the robot, where the clutch locks its orientation."""
    master, camera = turned(np.eye(4), rotation_from_vector(np.array([0.2, 0.4, -0.3]))), np.eye(4)
    operation = started(master, camera)
    align = operation.align
    for _ in range(1000):
        operation.step(master, camera, clutch=True)
        operation.step(master, camera)
    np.testing.assert_allclose(operation.align, align, atol=1e-12)
    assert is_rigid(operation.tool, 1e-12)


@pytest.mark.slow
@given(poses, poses, vectors(0.5))
def test_a_view_taken_anew_turns_the_tool_with_it_and_leaves_it_in_its_place(
    master: FloatArray, camera: FloatArray, turn: FloatArray
) -> None:
    operation = started(master, camera, TeleoperationSettings(mean_of=1))
    before = operation.step(master, camera)
    near = moved(turned(camera, rotation_from_vector(turn)), 0.0099 * RIGHT)
    np.testing.assert_array_equal(operation.step(master, near), before)
    far = moved(near, 0.0002 * RIGHT)
    after = operation.step(master, far)
    np.testing.assert_array_equal(after[:3, 3], before[:3, 3])
    seen = far[:3, :3].T @ after[:3, :3]
    np.testing.assert_allclose(seen, camera[:3, :3].T @ before[:3, :3], atol=1e-9)
    # Later movements take the new direction.
    now = operation.step(moved(master, 0.01 * RIGHT), far)
    np.testing.assert_allclose(now[:3, 3] - after[:3, 3], 0.002 * far[:3, 0], atol=1e-9)


def test_the_camera_is_averaged_over_25_steps() -> None:
    """One that shakes by 20 mm about its place takes no view anew; one that goes away does when its mean has."""
    operation = started(np.eye(4), np.eye(4))
    for step in range(100):
        operation.step(np.eye(4), moved(np.eye(4), (-1) ** step * 0.02 * RIGHT) if step else np.eye(4))
        np.testing.assert_array_equal(operation.view, np.eye(4))
    operation = started(np.eye(4), np.eye(4))
    for _ in range(24):
        operation.step(np.eye(4), np.eye(4))
    turn = rotation_from_vector(0.5 * FORWARD)
    away = rigid_transform(turn, 0.0201 * RIGHT)
    for _ in range(12):
        operation.step(np.eye(4), away)
    np.testing.assert_array_equal(operation.view, np.eye(4))
    operation.step(np.eye(4), away)
    np.testing.assert_allclose(operation.view[:3, 3], 13 / 25 * 0.0201 * RIGHT, atol=1e-12)
    # The mean of 12 at 0 and 13 at 0.5 rad about one axis.
    angle = np.arctan2(13 * np.sin(0.5), 12 + 13 * np.cos(0.5))
    np.testing.assert_allclose(operation.view[:3, :3], rotation_from_vector(angle * FORWARD), atol=1e-3)


def test_answers_and_inputs_may_be_changed_without_harm() -> None:
    master, camera = np.eye(4), np.eye(4)
    operation = started(master, camera)
    camera[:] = 7
    operation.step(master, np.eye(4))[:] = 7
    master[:3, 3] = 7
    np.testing.assert_allclose(operation.step(np.eye(4), np.eye(4)), SEEN, atol=1e-12)


@pytest.mark.parametrize("wrong", [np.full((4, 4), np.nan), np.zeros((4, 4)), np.eye(3), np.diag([1.0, 1, -1, 1])])
def test_a_pose_that_is_none_changes_nothing(wrong: FloatArray) -> None:
    operation = started(np.eye(4), np.eye(4))
    message = r"^teleoperation: pose of the camera is not a rigid transform \(4x4, finite\)$"
    with pytest.raises(TeleoperationError, match=message):
        operation.step(moved(np.eye(4), RIGHT), wrong)
    with pytest.raises(TeleoperationError, match="pose of the master"):
        operation.step(wrong, np.eye(4))
    with pytest.raises(TeleoperationError, match="pose of the tool"):
        operation.reset(np.eye(4), np.eye(4), wrong)
    np.testing.assert_allclose(operation.step(np.eye(4), np.eye(4)), SEEN, atol=1e-12)


def test_a_step_needs_a_reset() -> None:
    with pytest.raises(TeleoperationError, match=r"^teleoperation: step before reset$"):
        Teleoperation().step(np.eye(4), np.eye(4))
