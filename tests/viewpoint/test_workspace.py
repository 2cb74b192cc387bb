"""The rules on where the camera may be, the naive placement, and the registration of the two arms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from surgbench.geometry import FloatArray, is_rigid, rigid_transform, rotation_angle, rotation_from_vector
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.placement import CONSTRAINTS, look_at, naive_pose, view_along, violations
from surgbench.viewpoint.registration import Method, RegistrationError, Touches, register, residual_m
from surgbench.viewpoint.workspace import NoGoZone, Workspace, WorkspaceError

# The published zone, in the frame of the arm that touched it (metres).
PUBLISHED = np.array([
    [-0.02562659, 0.19977891, -0.09145149],
    [-0.10775786, 0.19640249, -0.08759377],
    [-0.10963935, 0.13565024, -0.1298436],
    [-0.0273852, 0.13670756, -0.13512043],
    [-0.07120856, 0.2261429, -0.12999408],
])  # fmt: skip
# An upright box, 80 x 70 x 50 mm, around the origin.
BOX = np.array([[-40, -35, 0], [40, -35, 0], [40, 35, 0], [-40, 35, 0], [5, 5, 50]]) * 1e-3
unit_vectors = (
    st.tuples(*(st.floats(-1, 1),) * 3)
    .map(np.array)
    .filter(lambda v: np.linalg.norm(v) > 0.1)
    .map(lambda v: v / np.linalg.norm(v))
)
points = st.tuples(*(st.floats(-0.2, 0.2),) * 3).map(np.array)


def test_the_published_zone_has_its_published_size() -> None:
    zone = NoGoZone(PUBLISHED)
    sides = np.linalg.norm(np.roll(PUBLISHED[:4], -1, axis=0) - PUBLISHED[:4], axis=1)
    np.testing.assert_allclose(1e3 * sides, [82.3, 74.0, 82.4, 76.8], atol=0.5)
    assert np.linalg.norm(zone.height) == pytest.approx(0.0494, abs=1e-4)
    assert zone.depth(zone.corners.mean(axis=0)) > 0.02


@given(points)
def test_depth_is_that_of_a_box(point: FloatArray) -> None:
    low, high = np.array([-0.04, -0.035, 0.0]), np.array([0.04, 0.035, 0.05])
    expected = min((point - low).min(), (high - point).min())
    assert NoGoZone(BOX).depth(point) == pytest.approx(expected, abs=1e-15)


def test_the_published_code_never_tests_the_side_from_d_to_a() -> None:
    beyond = np.array([-0.3, 0.0, 0.02])
    assert NoGoZone(BOX).depth(beyond) < 0
    assert NoGoZone(BOX, missing_face=True).depth(beyond) > 0
    assert NoGoZone(BOX, missing_face=True).depth(np.array([0.3, 0.0, 0.02])) < 0


@given(points)
def test_points_are_raised_onto_the_top(point: FloatArray) -> None:
    raised = NoGoZone(BOX).project_to_top(point)
    np.testing.assert_allclose(raised, [point[0], point[1], 0.05], atol=1e-15)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [0, 0, 1.0]]), "collinear"),
        (np.zeros((5, 3)), "collinear"),
        (np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0.0]]), "no height"),
        (np.array([[0, 0, 0], [1, 1, 0], [1, 0, 0], [0, 1, 0], [0.5, 0.5, 1.0]]), "follow each other"),
        (np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, np.nan, 1.0]]), "finite"),
    ],
)
def test_points_that_span_no_box_are_an_error(points: FloatArray, message: str) -> None:
    with pytest.raises(WorkspaceError, match=message):
        NoGoZone(points)


def test_the_floor_is_a_plane_above_the_base() -> None:
    workspace = Workspace(NoGoZone(BOX))
    np.testing.assert_allclose(workspace.below_floor(np.array([[0, 0, 0.03], [9, 9, 0.05]])), [0.01, -0.01], atol=1e-15)


@given(unit_vectors)
@example(np.array([1.2e-10, 0.0, 1.0]))
@example(np.array([0.0, 1e-9, 1.0]))
@example(np.array([0.0, -1.1e-9, -1.0]))
def test_views_are_level_and_look_along_their_axis(axis: FloatArray) -> None:
    rotation = view_along(axis)
    assert is_rigid(rigid_transform(rotation, np.zeros(3)), 1e-9)
    np.testing.assert_allclose(rotation[:, 2], axis, atol=1e-15)
    assert rotation[2, 0] == pytest.approx(0.0, abs=1e-12)
    if np.hypot(axis[0], axis[1]) > 1e-9:
        assert rotation[2, 1] >= -1e-12  # y points up
    else:  # what counts as vertical is turned one way only, not as rounding has it
        np.testing.assert_array_equal(rotation[:, 0], [0, -1, 0])


@given(points, unit_vectors)
@example(np.array([0.1, -0.2, 0.05]), np.array([1e-8, 0.0, 1.0]))
@example(np.array([0.1, -0.2, 0.05]), np.array([0.0, 1e-9, -1.0]))
def test_the_naive_camera_sees_the_ring_face_on(point: FloatArray, normal: FloatArray) -> None:
    feature = rigid_transform(np.stack([np.cross(normal, [1, 2, 3]), normal, normal], axis=-1), point)
    camera = naive_pose(feature)
    np.testing.assert_allclose(camera[:3, 3] + 0.11 * camera[:3, 2], point, atol=1e-15)
    np.testing.assert_allclose(camera[:3, 2], -normal, atol=1e-15)
    again = look_at(camera[:3, 3], point)
    np.testing.assert_allclose(again[:3, 2:], camera[:3, 2:], atol=1e-9)
    # In between, the place's rounding turns a nearly vertical view, or makes it count as vertical.
    if not 1e-10 < np.hypot(normal[0], normal[1]) < 1e-6:
        np.testing.assert_allclose(again, camera, atol=1e-9)


def test_a_camera_in_the_feature_looks_down() -> None:
    np.testing.assert_array_equal(look_at(np.zeros(3), np.zeros(3))[:3, 2], [0, 0, -1])


def test_every_rule_is_seen_alone() -> None:
    """Cameras around a ring in the middle of the box, on an arm that stands beside it."""
    arm, workspace = CameraArm(), Workspace(NoGoZone(BOX))
    base = np.eye(4)
    base[:3, 3] = [0.165, -0.118, 0.19]
    ring = np.array([0.0, 0.0, 0.02])
    cases = {
        (): ring + 0.11 * np.array([0.6, -0.2, 0.775]),
        ("no_go", "floor", "proximity"): ring + np.array([0.03, -0.01, 0.01]),
        ("floor",): ring + 0.11 * np.array([0.95, -0.3, 0.09]),
        ("orientation",): ring + 0.11 * np.array([-0.2, -0.3, 0.9]),
        ("joint_limit",): ring + 0.11 * np.array([0.5, 0.8, 0.4]),
    }
    for expected, place in cases.items():
        pose = look_at(place, ring)
        found = violations(pose, ring, workspace, arm, base)
        flags = dict(zip(CONSTRAINTS, found.stacked(), strict=True))
        if "joint_limit" not in expected:
            flags.pop("joint_limit")
        assert tuple(name for name in CONSTRAINTS if flags.get(name)) == expected
        assert bool(found.any) == bool(found.stacked().any())


TOUCHED = np.array([[-0.04, -0.035, 0.0], [0.04, -0.03, 0.01], [0.04, 0.035, 0.0], [-0.03, 0.03, 0.03], [0, 0, 0.05]])


@pytest.mark.parametrize(("method", "exact_m"), [("rigid", 1e-12), ("lad", 1e-9)])
@settings(max_examples=20)
@given(st.tuples(*(st.floats(-1, 1),) * 3), points)
def test_a_registration_of_exact_points_recovers_the_base(
    method: Method, exact_m: float, turn: tuple[float, ...], place: FloatArray
) -> None:
    true = rigid_transform(rotation_from_vector(np.array(turn)), place)
    touches = Touches(TOUCHED, (TOUCHED - true[:3, 3]) @ true[:3, :3])
    found = register(np.eye(4), touches, method)
    np.testing.assert_allclose(found, true, atol=exact_m)
    assert residual_m(found, touches) < exact_m


@pytest.mark.parametrize("bad", range(len(TOUCHED)))
def test_one_bad_touch_does_not_move_a_registration_by_least_absolute_error(bad: int) -> None:
    """Nor does it matter how bad it is; least squares go along with it."""
    true = rigid_transform(rotation_from_vector(np.radians([6.0, 6.0, 5.0])), np.array([0.1, 0.2, 0.3]))
    base = (TOUCHED - true[:3, 3]) @ true[:3, :3]
    for by_m in (0.003, 0.03):
        world = TOUCHED.copy()
        world[bad] += by_m * np.array([0.6, -0.64, 0.48])
        touches = Touches(world, base)
        np.testing.assert_allclose(register(np.eye(4), touches, "lad"), true, atol=1e-8)
        moved = register(np.eye(4), touches, "rigid")
        assert np.linalg.norm((moved - true)[:3, 3]) > 0.1 * by_m


def test_least_absolute_error_is_the_least() -> None:
    """No small motion about it, of any kind, brings the points nearer to each other; least squares bring them less."""
    rng = np.random.default_rng(3)
    touches = Touches(TOUCHED + 0.002 * rng.standard_normal(TOUCHED.shape), TOUCHED)
    found = register(np.eye(4), touches, "lad")
    least = residual_m(found, touches)
    assert least < residual_m(register(np.eye(4), touches, "rigid"), touches)
    for size in (1e-3, 1e-5):
        for turn, shift in rng.standard_normal((50, 2, 3)):
            other = rigid_transform(rotation_from_vector(10 * size * turn), size * shift) @ found
            assert residual_m(other, touches) >= least - 1e-12


def test_a_translation_leaves_the_rotation_and_some_millimetres() -> None:
    """Ten degrees of rotation, as on the robot: what remains is of the size that was measured there."""
    true = rigid_transform(rotation_from_vector(np.radians([6.0, 6.0, 5.0])), np.array([0.1, 0.2, 0.3]))
    reported = np.eye(4)
    touches = Touches(TOUCHED, (TOUCHED - true[:3, 3]) @ true[:3, :3])
    found = register(reported, touches, "translation")
    np.testing.assert_array_equal(found[:3, :3], reported[:3, :3])
    assert 0.002 < residual_m(found, touches) < 0.01
    assert np.degrees(rotation_angle(found[:3, :3].T @ true[:3, :3])) == pytest.approx(9.8, abs=0.1)
    assert register(reported, touches, "none") is not reported
    np.testing.assert_array_equal(register(reported, touches, "none"), reported)


def test_touches_that_register_nothing_are_an_error() -> None:
    line = np.outer(np.arange(5.0), [0.01, 0, 0])
    for method in ("rigid", "lad"):
        with pytest.raises(RegistrationError, match="not on a line"):
            register(np.eye(4), Touches(line, line), method)
    with pytest.raises(RegistrationError, match="finite"):
        register(np.eye(4), Touches(line * np.nan, line), "translation")
    with pytest.raises(RegistrationError, match="as many"):
        register(np.eye(4), Touches(line[:3], line), "translation")
