"""The silhouette evaluator against geometry one can work out and a rasteriser that tests every triangle."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from support import resting_state, rigid_instrument

from surgbench.camera import Camera
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument, load_instrument
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.silhouette.layout import NEAR_M


def clip_to_near(polygon: FloatArray) -> FloatArray:
    """Sutherland-Hodgman against z = near; edges are cut from their lower-index end to the last bit."""
    kept = []
    for k in range(len(polygon)):
        a, b = polygon[k], polygon[(k + 1) % len(polygon)]
        if a[2] > NEAR_M:
            kept.append(a)
        if (a[2] > NEAR_M) != (b[2] > NEAR_M):
            kept.append(a + (NEAR_M - a[2]) / (b[2] - a[2]) * (b - a))
    return np.array(kept).reshape(-1, 3)


def brute_force(instruments: list[Instrument], camera: Camera, state: FloatArray) -> np.ndarray:
    """Every triangle of either facing, filled row by row at pixel centres; no contour, no facing, no winding."""
    image = np.zeros((camera.height, camera.width), dtype=bool)
    for instrument, arm_state in zip(instruments, state.reshape(-1, 9), strict=True):
        transforms = instrument.link_transforms(arm_state)
        for name, mesh in instrument.meshes.items():
            T = transforms[instrument.link_index[name]]
            for triangle in (mesh.vertices_m @ T[:3, :3].T + T[:3, 3])[mesh.faces]:
                polygon = clip_to_near(triangle)
                if len(polygon) < 3:
                    continue
                z = np.maximum(polygon[:, 2], NEAR_M)
                u = camera.fx * polygon[:, 0] / z + camera.cx
                v = camera.fy * polygon[:, 1] / z + camera.cy
                for row in range(max(0, int(np.ceil(v.min()))), min(camera.height, int(np.ceil(v.max())))):
                    crossings = []
                    for k in range(len(u)):
                        low, high = sorted((k, (k + 1) % len(u)), key=lambda i: v[i])
                        if v[low] <= row < v[high]:
                            slope = (u[high] - u[low]) / (v[high] - v[low])
                            crossings.append(np.ceil(u[low] + (row - v[low]) * slope))
                    begin, end = np.clip([min(crossings), max(crossings)], 0, camera.width).astype(int)
                    image[row, begin:end] = True
    return image


def bodies() -> dict[str, Any]:
    box = trimesh.creation.box((0.02, 0.03, 0.05))
    ring = trimesh.creation.torus(0.02, 0.006, major_sections=12, minor_sections=8)
    rod = trimesh.creation.cylinder(0.004, 0.3, sections=9)
    crossing = trimesh.util.concatenate([box, rod, trimesh.creation.icosphere(1, 0.018)])
    touching: Any = trimesh.util.concatenate([box, box.copy().apply_translation((0.02, 0, 0))])
    touching.merge_vertices()
    return {"box": box, "ring": ring, "rod": rod, "crossing": crossing, "touching": touching}


BODIES = bodies()

angle = st.floats(-np.pi, np.pi)
poses = st.tuples(angle, angle, angle, st.floats(-0.08, 0.08), st.floats(-0.08, 0.08), st.floats(-0.05, 0.25)).map(
    lambda pose: np.array([*pose, 0.0, 0.0, 0.0])
)


def assert_same(image: np.ndarray, expected: np.ndarray) -> None:
    # An edge cut by the near plane is computed in the link's frame here and in the camera's there, so that a
    # crossing within rounding of a pixel centre may fall on either side; everything else is equal to the bit.
    assert np.count_nonzero(image != expected) <= 1


@settings(max_examples=150, deadline=None)
@given(body=st.sampled_from(sorted(BODIES)), state=poses)
def test_any_body_anywhere_equals_brute_force(small_camera: Camera, body: str, state: FloatArray) -> None:
    instrument = rigid_instrument(BODIES[body])
    evaluator = SilhouetteEvaluator([instrument], small_camera)
    expected = brute_force([instrument], small_camera, state)
    image = evaluator.mask(state)
    assert_same(image, expected)
    checker = (np.indices(image.shape).sum(axis=0) // 3) % 2 == 0
    score = evaluator.score(state[None], Reference(checker))
    assert score.area[0] == np.count_nonzero(image)
    assert score.overlap[0] == np.count_nonzero(image & checker)


joints = st.tuples(st.floats(-1.57, 1.57), st.floats(-1.39, 1.39), st.floats(0.0, 1.57))
needle_driver_states = st.tuples(poses, joints).map(lambda both: np.array([*both[0][:6], *both[1]]))


@settings(max_examples=15, deadline=None)
@given(left=needle_driver_states, right=needle_driver_states)
def test_two_needle_drivers_count_their_union_once(small_camera: Camera, left: FloatArray, right: FloatArray) -> None:
    instrument = load_instrument("large_needle_driver")
    both = np.concatenate([left, right])
    pair = SilhouetteEvaluator([instrument, instrument], small_camera)
    one = SilhouetteEvaluator([instrument], small_camera)
    assert np.array_equal(pair.mask(both), one.mask(left) | one.mask(right))
    assert_same(one.mask(left), brute_force([instrument], small_camera, left))


def test_sphere_covers_its_circle(camera: Camera) -> None:
    """A sphere on the axis projects to a circle of radius f r / sqrt(z^2 - r^2)."""
    radius, depth = 0.01, 0.13
    centred = camera.model_copy(update={"cx": 349.5, "cy": 246.0, "fy": camera.fx})
    sphere = rigid_instrument(trimesh.creation.icosphere(5, radius))
    state = np.array([0, 0, 0, 0, 0, depth, 0, 0, 0.0])
    expected = np.pi * camera.fx**2 * radius**2 / (depth**2 - radius**2)
    area = SilhouetteEvaluator([sphere], centred).mask(state).sum()
    assert area == pytest.approx(expected, rel=2e-3)


def test_vertices_on_pixel_centres_are_counted_half_open() -> None:
    """A face from pixel 2 to pixel 5 covers columns and rows 2, 3 and 4: begin included, end not."""
    camera = Camera(width=16, height=16, fx=1.0, fy=1.0, cx=2.0, cy=2.0)
    box = trimesh.creation.box(bounds=[[0, 0, 0], [3, 3, 1]])
    mask = SilhouetteEvaluator([rigid_instrument(box)], camera).mask(np.array([0, 0, 0, 0, 0, 1.0, 0, 0, 0]))
    expected = np.zeros((16, 16), dtype=bool)
    expected[2:5, 2:5] = True
    assert np.array_equal(mask, expected)


def test_camera_inside_a_solid_sees_nothing_else(small_camera: Camera) -> None:
    box = rigid_instrument(trimesh.creation.box((0.1, 0.1, 0.1)))
    assert SilhouetteEvaluator([box], small_camera).mask(np.zeros(9)).all()


def test_behind_the_camera_and_not_finite_cover_nothing(small_camera: Camera) -> None:
    box = rigid_instrument(trimesh.creation.box((0.02, 0.02, 0.02)))
    evaluator = SilhouetteEvaluator([box], small_camera)
    behind, broken = np.zeros(9), np.zeros(9)
    behind[5], broken[5], broken[1] = -0.1, 0.1, np.nan
    score = evaluator.score(np.stack([behind, broken]), Reference(np.ones((62, 88), bool)))
    assert score.area.tolist() == [0, 0]
    assert score.overlap.tolist() == [0, 0]


def test_many_crossings_in_a_row_are_not_lost(small_camera: Camera) -> None:
    """More prongs than the first scratch has room for."""
    prongs = [trimesh.creation.box((0.0015, 0.04, 0.004)) for _ in range(24)]
    for k, prong in enumerate(prongs):
        prong.apply_translation((0.003 * (k - 12), 0, 0))
    combined: Any = trimesh.util.concatenate(prongs)
    comb = rigid_instrument(combined)
    state = np.array([0, 0, 0, 0, 0, 0.1, 0, 0, 0.0])
    evaluator = SilhouetteEvaluator([comb], small_camera)
    expected = brute_force([comb], small_camera, state)
    score = evaluator.score(state[None], Reference(expected))
    assert score.area[0] == score.overlap[0] == np.count_nonzero(expected) > 0
    assert np.array_equal(evaluator.mask(state), expected)


def test_score_does_not_depend_on_the_batch(small_camera: Camera) -> None:
    instrument = load_instrument("large_needle_driver")
    evaluator = SilhouetteEvaluator([instrument], small_camera)
    states = resting_state() + np.random.default_rng(0).normal(0, 0.02, (20, 9)) * ([1] * 3 + [0.1] * 3 + [1] * 3)
    reference = Reference(evaluator.mask(resting_state()))
    together = evaluator.score(states, reference)
    alone = [evaluator.score(state[None], reference) for state in states]
    assert together.area.tolist() == [int(s.area[0]) for s in alone]
    assert together.overlap.tolist() == [int(s.overlap[0]) for s in alone]
    assert evaluator.score(resting_state()[None], reference).iou(reference)[0] == 1.0


def test_an_open_mesh_is_refused(small_camera: Camera) -> None:
    box = trimesh.creation.box((0.02, 0.02, 0.02))
    box.update_faces(np.arange(len(box.faces)) > 0)
    with pytest.raises(ValueError, match=r"mesh of link .body. is not closed \(3 open edges\); mend it"):
        SilhouetteEvaluator([rigid_instrument(box)], small_camera)


def test_wrong_shapes_are_refused(small_camera: Camera) -> None:
    evaluator = SilhouetteEvaluator([rigid_instrument(BODIES["box"])], small_camera)
    with pytest.raises(ValueError, match="size 9"):
        evaluator.mask(np.zeros(18))
    with pytest.raises(ValueError, match="the camera"):
        evaluator.score(np.zeros((1, 9)), Reference(np.zeros((5, 5), bool)))
