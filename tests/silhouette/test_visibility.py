"""Which arm is seen where: against planes and spheres one can work out, and rays cast at every triangle."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from support import resting_state, rigid_instrument

from surgbench.camera import NEAR_M, Camera
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument, load_instrument
from surgbench.silhouette import Reference, SilhouetteEvaluator, VisibleScorer
from surgbench.silhouette.depths import nearest_surface
from surgbench.silhouette.layout import Lens
from surgbench.silhouette.visibility import VisibilityEvaluator

DRIVER = load_instrument("large_needle_driver")


def placed(x: float, y: float, z: float, gamma: float = 0.0) -> FloatArray:
    """State of a rigid body at a place, turned about the camera's y."""
    return np.array([0, 0, gamma, x, y, z, 0, 0, 0], dtype=np.float64)


def rays(camera: Camera) -> FloatArray:
    """Points ``(H, W, 3)`` at z = 1 behind the pixel centres."""
    rows, columns = np.indices((camera.height, camera.width))
    return np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(rows.shape)], axis=-1)


def cast(instrument: Instrument, state: FloatArray, ray: FloatArray, near_m: float = NEAR_M) -> tuple[float, float]:
    """Depth of the nearest surface along a ray, tested against every triangle (Möller and Trumbore 1997).

    Returns:
        The depth, and how far the ray keeps from all edges and from the near plane, relative to their size.
    """
    transforms = instrument.link_transforms(state)
    inside, depths, margin = 0, [np.inf], np.inf
    for name, mesh in instrument.meshes.items():
        T = transforms[instrument.link_index[name]]
        a, b, c = np.moveaxis((mesh.vertices_m @ T[:3, :3].T + T[:3, 3])[mesh.faces], 1, 0)
        p, q = np.cross(ray, c - a), np.cross(-a, b - a)
        determinant = ((b - a) * p).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = -(a * p).sum(axis=1) / determinant, (q * ray).sum(axis=1) / determinant
            z = ((c - a) * q).sum(axis=1) / determinant
        hit = (u > 0) & (v > 0) & (u + v < 1) & (z > near_m)
        inside -= int(np.sign(determinant[hit]).sum())
        depths += z[hit & (determinant > 0)].tolist()
        margin = min(margin, np.nanmin(np.abs([u, v, 1 - u - v, (z - near_m) / near_m])))
    return (near_m if inside > 0 else min(depths)), margin


def surface(points: FloatArray, faces: Any, lens: Lens, wanted: Any) -> FloatArray:
    """Depths of a mesh in the whole picture."""
    depth, room = np.empty(wanted.shape), np.empty(wanted.shape, np.int32)
    z = points[:, 2]
    seen = np.stack([lens.fx * points[:, 0] / z + lens.cx, lens.fy * points[:, 1] / z + lens.cy, 1 / z], axis=-1)
    box = 0, wanted.shape[0], 0, wanted.shape[1]
    cut = bool((z <= lens.near).any())
    nearest_surface(points, seen, faces, cut, lens, wanted, box, room, np.empty((4, 3)), depth)
    return depth


driver_states = st.tuples(
    *[st.floats(-np.pi, np.pi)] * 3,
    *[st.floats(-0.06, 0.06)] * 2,
    st.floats(-0.03, 0.15),
    *[st.floats(-1.39, 1.39)] * 2,
    st.floats(0, 1.57),
).map(np.array)


@pytest.mark.slow
@settings(max_examples=60)
@given(left=driver_states, right=driver_states)
def test_visible_masks_part_the_mask_of_both_arms(small_camera: Camera, left: FloatArray, right: FloatArray) -> None:
    state = np.concatenate([left, right])
    visibility = VisibilityEvaluator([DRIVER, DRIVER], small_camera)
    visible, silhouettes = visibility.visible_masks(state), visibility.silhouettes(state)
    assert np.array_equal(visible.any(axis=0), SilhouetteEvaluator([DRIVER, DRIVER], small_camera).mask(state))
    assert visible.sum(axis=0).max() <= 1
    assert not (visible & ~silhouettes).any()
    depths = visibility.depths_m(state)
    assert np.array_equal(np.isfinite(depths), silhouettes)
    assert depths.min() >= NEAR_M
    assert np.array_equal(np.where(visible, depths, np.inf).min(axis=0), depths.min(axis=0))


@pytest.mark.slow
@settings(max_examples=60)
@given(state=driver_states, row=st.integers(0, 61), column=st.integers(0, 87))
def test_depth_is_that_of_a_ray(small_camera: Camera, state: FloatArray, row: int, column: int) -> None:
    # Every other pixel of the silhouette as a rule, so that most examples hit something.
    depths = VisibilityEvaluator([DRIVER], small_camera).depths_m(state)[0]
    rows, columns = np.nonzero(np.isfinite(depths))
    if len(rows) and (row + column) % 4:
        row, column = rows[(88 * row + column) % len(rows)], columns[(88 * row + column) % len(rows)]
    depth, margin = cast(DRIVER, state, rays(small_camera)[row, column])
    assume(margin > 1e-9)
    assert depths[row, column] == pytest.approx(depth, rel=1e-6)


def test_sphere_before_a_sphere(camera: Camera) -> None:
    """The nearer hides the farther, and a ray through the middle of a sphere meets it where a quadratic says."""
    near, far = np.array([-0.004, 0.0, 0.10]), np.array([0.006, 0.002, 0.15])
    ball = trimesh.creation.icosphere(5, 0.01)
    visibility = VisibilityEvaluator([rigid_instrument(ball)] * 2, camera)
    state = np.concatenate([placed(*far), placed(*near)])
    masks, depths = visibility.silhouettes(state), visibility.depths_m(state)
    assert (masks[0] & masks[1]).sum() > 1000
    assert np.array_equal(visibility.visible_masks(state), [masks[0] & ~masks[1], masks[1]])
    assert visibility.front_fractions(state).tolist() == [0.0, 1.0]
    directions = rays(camera)
    for depth, mask, centre in zip(depths, masks, (far, near), strict=True):
        a, b = (directions**2).sum(axis=-1), directions @ centre
        discriminant = b**2 - a * (centre @ centre - 0.01**2)
        expected = (b - np.sqrt(np.maximum(discriminant, 0))) / a
        middle = discriminant > 0.25 * discriminant.max()  # away from the rim, where flat facets matter most
        assert np.allclose(depth[middle], expected[middle], atol=1e-5)
        assert np.isinf(depth[~mask]).all()


@pytest.mark.parametrize("first_tilted", [True, False])
def test_slabs_that_run_through_each_other_are_parted_by_pixel(camera: Camera, first_tilted: bool) -> None:
    """A tilted slab comes out of a square one's front face along a known line."""
    slab = rigid_instrument(trimesh.creation.box(bounds=[[-0.03, -0.01, 0.0], [0.03, 0.01, 0.002]]))
    z, gamma = 0.1, 0.3
    square, tilted = placed(0.005, 0, z), placed(0.005, 0, z, gamma)
    state = np.concatenate([tilted, square] if first_tilted else [square, tilted])
    visibility = VisibilityEvaluator([slab, slab], camera)
    depths = visibility.depths_m(state)[:: 1 if first_tilted else -1]
    both = np.isfinite(depths).all(axis=0)
    # Ry(gamma) brings +x nearer: on the tilted front face (p - t) . (sin gamma, 0, cos gamma) = 0.
    normal = np.array([np.sin(gamma), 0, np.cos(gamma)])
    plane = normal @ [0.005, 0, z] / (rays(camera) @ normal)
    assert np.allclose(depths[1][both], z, rtol=1e-12)
    in_front = both & (plane < z)
    assert np.allclose(depths[0][in_front], plane[in_front], rtol=1e-12)
    tilted_seen = visibility.visible_masks(state)[0 if first_tilted else 1]
    assert np.array_equal(tilted_seen & both, in_front)
    assert 0.3 < visibility.front_fractions(state)[0] < 0.7
    assert visibility.front_fractions(state).sum() == pytest.approx(1.0)


@pytest.mark.parametrize("gamma", [-0.6, 0.7, 1.1])
@pytest.mark.parametrize("shape", ["rod", "ring"])
def test_body_cut_by_the_near_plane(small_camera: Camera, shape: str, gamma: float) -> None:
    rod = trimesh.creation.cylinder(0.004, 0.3, sections=9)
    ring = trimesh.creation.torus(0.006, 0.003, major_sections=12, minor_sections=8)
    instrument, near_m = rigid_instrument(rod if shape == "rod" else ring), 0.02
    state = placed(0.001, 0.002, near_m + 0.001, gamma)
    depths = VisibilityEvaluator([instrument], small_camera, near_m).depths_m(state)[0]
    assert np.count_nonzero(depths == near_m) > 500
    assert np.count_nonzero(np.isfinite(depths) & (depths > near_m)) > 500
    directions = rays(small_camera)
    for row, column in np.ndindex(depths.shape):
        if row % 5 == column % 5 == 0:
            depth, margin = cast(instrument, state, directions[row, column], near_m)
            assert margin < 1e-9 or depths[row, column] == pytest.approx(depth, rel=1e-6)


def test_looking_into_a_solid_through_the_near_plane(small_camera: Camera) -> None:
    """Inside a box that encloses a ball the depth is the near plane's, not the ball's; behind it nothing is seen."""
    solid: Any = trimesh.util.concatenate([trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.icosphere(2, 0.01)])
    visibility = VisibilityEvaluator([rigid_instrument(solid), DRIVER], small_camera)
    state = np.concatenate([placed(0, 0, 0.03), resting_state()])
    depths, visible = visibility.depths_m(state), visibility.visible_masks(state)
    assert (depths[0] == NEAR_M).all()
    assert np.isfinite(depths[1]).any()
    assert visible[0].all()
    assert not visible[1].any()


@settings(max_examples=60)
@given(st.integers(0, 30), st.integers(40, 80), st.integers(0, 25), st.integers(35, 60), st.floats(0.01, 0.2))
def test_edges_on_pixel_centres_have_a_depth(
    small_camera: Camera, left: int, right: int, top: int, bottom: int, z: float
) -> None:
    """Where rounding decides whether a pixel belongs to the silhouette, it still has the depth of the surface there."""
    low, high = z * rays(small_camera)[[top, bottom], [left, right]]
    box = rigid_instrument(trimesh.creation.box(bounds=np.array([low, high]) - [[0, 0, z], [0, 0, z - 0.01]]))
    depth = VisibilityEvaluator([box], small_camera).depths_m(placed(0, 0, z))[0]
    seen = np.isfinite(depth)
    assert seen[top + 1 : bottom, left + 1 : right].all()
    assert np.allclose(depth[seen], z, rtol=1e-9)


def test_pixel_that_no_face_covers_takes_the_nearest_edge() -> None:
    """A box from pixel 2 to 5 covers 2, 3 and 4; asked for 5 as well, its front edge answers."""
    box = trimesh.creation.box(bounds=[[0, 0, 1], [3, 3, 2]])
    wanted = np.zeros((8, 8), dtype=bool)
    wanted[2:6, 2:6] = True
    lens = Lens(16, 16, 1.0, 1.0, 2.0, 2.0, NEAR_M)
    depth = surface(np.array(box.vertices), np.array(box.faces, dtype=np.int32), lens, wanted)
    assert np.array_equal(depth, np.where(wanted, 1.0, np.inf))


def test_face_seen_edge_on_is_nowhere_deeper_than_its_corners() -> None:
    """Its plane holds the ray, so that the depth there is 0 / 0 but for rounding."""
    lens, rng = Lens(88, 62, 113.2, 113.1, 36.3, 29.4, NEAR_M), np.random.default_rng(0)
    wanted = np.zeros((62, 88), dtype=bool)
    faces = np.array([[0, 1, 2], [0, 2, 1]], dtype=np.int32)
    for _ in range(200):
        row, column = rng.integers(5, 57), rng.integers(88)
        z, v = rng.uniform(0.05, 0.2, 3), row + np.array([-3.0, 0.5, 4.0])
        points = np.stack([(column - lens.cx) / lens.fx * z, (v - lens.cy) / lens.fy * z, z], axis=-1)
        wanted[:] = False
        wanted[row, column] = True
        depth = surface(points, faces, lens, wanted)
        assert z.min() <= depth[row, column] * (1 + 1e-12)
        assert depth[row, column] <= z.max() * (1 + 1e-12)


def test_of_equal_depths_the_first_arm_is_seen(small_camera: Camera) -> None:
    visibility = VisibilityEvaluator([DRIVER, DRIVER], small_camera)
    visible = visibility.visible_masks(np.tile(resting_state(), 2))
    assert visible[0].any()
    assert not visible[1].any()


def test_one_arm_is_seen_whole_and_arms_apart_have_no_order(small_camera: Camera) -> None:
    one = VisibilityEvaluator([DRIVER], small_camera)
    mask = SilhouetteEvaluator([DRIVER], small_camera).mask(resting_state())
    assert np.array_equal(one.visible_masks(resting_state()), mask[None])
    assert np.isnan(one.front_fractions(resting_state())).all()


def test_states_that_are_not_finite_or_of_another_size(small_camera: Camera) -> None:
    visibility = VisibilityEvaluator([DRIVER, DRIVER], small_camera)
    broken = np.tile(resting_state(), 2)
    broken[12] = np.nan
    # As in the mask of both: one broken arm leaves nothing.
    assert not SilhouetteEvaluator([DRIVER, DRIVER], small_camera).mask(broken).any()
    assert not visibility.visible_masks(broken).any()
    assert np.isinf(visibility.depths_m(broken)).all()
    with pytest.raises(ValueError, match=r"\(18,\); got \(9,\)"):
        visibility.visible_masks(resting_state())


@pytest.mark.slow
@settings(max_examples=60)
@given(left=driver_states, right=driver_states, alike=st.booleans())
def test_scores_are_the_counts_of_the_visible_masks(
    small_camera: Camera, left: FloatArray, right: FloatArray, alike: bool
) -> None:
    """Arms that overlap or not, are cut by the near plane, or lie in the same place; each against a mask of its own."""
    states = np.array([np.concatenate(pair) for pair in ((left, right), (right, left), (left, left))])
    states[1, 3:6] += 0.002 * alike
    visibility, scorer = VisibilityEvaluator([DRIVER, DRIVER], small_camera), VisibleScorer([DRIVER] * 2, small_camera)
    masks = visibility.silhouettes(states[0])
    for _ in range(2):  # the scratch of one call is nothing to the next
        score = scorer.score(states, [Reference(mask) for mask in masks])
        for number, state in enumerate(states):
            visible = visibility.visible_masks(state)
            assert score.area[number].tolist() == visible.sum(axis=(1, 2)).tolist()
            assert score.overlap[number].tolist() == (visible & masks).sum(axis=(1, 2)).tolist()
            assert score.silhouette[number].tolist() == visibility.silhouettes(state).sum(axis=(1, 2)).tolist()


@settings(max_examples=60)
@given(left=driver_states, offset=st.tuples(*[st.floats(-1, 1)] * 9).map(np.array), exponent=st.floats(-9, -1))
def test_arms_that_run_through_each_other_are_counted_as_their_masks(
    small_camera: Camera, left: FloatArray, offset: FloatArray, exponent: float
) -> None:
    """However near to each other, in any number of threads; a broken state among them changes nothing."""
    states = np.array([[*left, *(left + 10**exponent * offset)], [*left, *left], [*left, *(np.nan * left)]])
    scorer, shared = (VisibleScorer([DRIVER] * 2, small_camera, threads=threads) for threads in (1, 2))
    masks = scorer.visibility.silhouettes(states[1])
    references = [Reference(mask) for mask in masks]
    score = scorer.score(states, references)
    visible = np.array([scorer.visibility.visible_masks(state) for state in states])
    assert np.array_equal(score.area, visible.sum(axis=(2, 3)))
    assert np.array_equal(score.overlap, (visible & masks).sum(axis=(2, 3)))
    assert all(np.array_equal(*pair) for pair in zip(score, shared.score(states, references), strict=True))


def test_of_three_arms_each_hides_what_is_behind_it(small_camera: Camera) -> None:
    states = np.concatenate([placed(0.002 * arm, 0, 0.13 - 0.01 * arm) for arm in range(3)])
    ball = [rigid_instrument(trimesh.creation.icosphere(3, 0.01))] * 3
    visibility, scorer = VisibilityEvaluator(ball, small_camera), VisibleScorer(ball, small_camera)
    reference = Reference(np.ones((small_camera.height, small_camera.width), dtype=bool))
    score = scorer.score([states], [reference] * 3)
    visible = visibility.visible_masks(states).sum(axis=(1, 2))
    assert score.area[0].tolist() == score.overlap[0].tolist() == visible.tolist()
    assert visible[2] == score.silhouette[0, 2] > visible[1] > visible[0] > 0
    assert scorer.score([np.append(states[:-1], np.nan)], [reference] * 3).area.tolist() == [[0, 0, 0]]
    with pytest.raises(ValueError, match=r"\(N, 27\)"):
        scorer.score([states[:18]], [reference] * 3)
