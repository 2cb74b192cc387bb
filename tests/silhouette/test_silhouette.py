"""The silhouette evaluator against geometry one can work out and a rasteriser that tests every triangle."""

from __future__ import annotations

import copy
import multiprocessing
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import trimesh
from bodies import (
    BODIES,
    DEGENERATE,
    assert_counts_belong_to_mask,
    bounding_box,
    cameras,
    needle_driver_states,
    poses,
    two_arm_states,
    zigzag,
)
from commandline import AMPLE_S
from hypothesis import given, settings
from hypothesis import strategies as st
from support import resting_state, rigid_instrument

from surgbench.camera import NEAR_M, Camera
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument, load_instrument
from surgbench.silhouette import Reference, RowSums, SilhouetteEvaluator


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


def projected_triangles(
    instruments: list[Instrument], camera: Camera, state: FloatArray
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Pixels of the corners of every triangle, cut off at the near plane."""
    for instrument, arm_state in zip(instruments, state.reshape(-1, 9), strict=True):
        transforms = instrument.link_transforms(arm_state)
        for name, mesh in instrument.meshes.items():
            T = transforms[instrument.link_index[name]]
            for triangle in (mesh.vertices_m @ T[:3, :3].T + T[:3, 3])[mesh.faces]:
                polygon = clip_to_near(triangle)
                if len(polygon) >= 3:
                    z = np.maximum(polygon[:, 2], NEAR_M)
                    yield camera.fx * polygon[:, 0] / z + camera.cx, camera.fy * polygon[:, 1] / z + camera.cy


def brute_force(instruments: list[Instrument], camera: Camera, state: FloatArray) -> np.ndarray:
    """Every triangle of either facing, filled row by row at pixel centres; no contour, no facing, no winding."""
    image = np.zeros((camera.height, camera.width), dtype=bool)
    for u, v in projected_triangles(instruments, camera, state):
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


def assert_same(image: np.ndarray, expected: np.ndarray) -> None:
    # An edge cut by the near plane is computed in the link's frame here and in the camera's there, so that a
    # crossing within rounding of a pixel centre may fall on either side; everything else is equal to the bit.
    assert np.count_nonzero(image != expected) <= 1


@pytest.mark.slow
@settings(max_examples=150)
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


@pytest.mark.slow
@settings(max_examples=15)
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


def undecided(instruments: list[Instrument], camera: Camera, state: FloatArray) -> np.ndarray:
    """Pixels whose centre lies on the outline of some triangle to rounding, so that it may fall to either side."""
    rows, columns = np.indices((camera.height, camera.width))
    image = np.zeros(rows.shape, dtype=bool)
    for u, v in projected_triangles(instruments, camera, state):
        for k in range(len(u)):
            du, dv = u[k] - u[k - 1], v[k] - v[k - 1]
            au, av = columns - u[k - 1], rows - v[k - 1]
            share = np.clip((au * du + av * dv) / max(du**2 + dv**2, np.finfo(float).tiny), 0.0, 1.0)
            # Lengths of the edge, for rounding, and of what lies between it and the pixel.
            reach = 1e-9 * (1.0 + np.hypot(du, dv))
            image |= np.hypot(au - share * du, av - share * dv) < reach
    return image


def assert_covers_what_brute_force_does(instruments: list[Instrument], camera: Camera, state: FloatArray) -> None:
    evaluator = SilhouetteEvaluator(instruments, camera)
    image, expected = evaluator.mask(state), brute_force(instruments, camera, state)
    differs = image != expected
    if differs.any():
        differs &= ~undecided(instruments, camera, state)
    assert not differs.any(), np.argwhere(differs).tolist()
    assert_counts_belong_to_mask(evaluator, state, image)


@pytest.mark.slow
@settings(max_examples=100)
@given(body=st.sampled_from(sorted(DEGENERATE)), state=poses)
def test_faces_without_area_and_coincident_faces(small_camera: Camera, body: str, state: FloatArray) -> None:
    assert_covers_what_brute_force_does([rigid_instrument(DEGENERATE[body])], small_camera, state)


@pytest.mark.slow
@settings(max_examples=100)
@given(camera=cameras, body=st.sampled_from(sorted(BODIES)), state=poses)
def test_any_camera(camera: Camera, body: str, state: FloatArray) -> None:
    assert_covers_what_brute_force_does([rigid_instrument(BODIES[body])], camera, state)


@pytest.mark.slow
@settings(max_examples=60)
@given(camera=cameras, bodies=st.tuples(*[st.sampled_from(sorted(BODIES))] * 2), left=poses, right=poses)
def test_two_bodies_anywhere(camera: Camera, bodies: tuple[str, str], left: FloatArray, right: FloatArray) -> None:
    """Each moves on its own; what both cover counts once."""
    instruments = [rigid_instrument(BODIES[body]) for body in bodies]
    assert_covers_what_brute_force_does(instruments, camera, np.concatenate([left, right]))


# Boxes whose corners project to pixel centres, before the camera or about it; every face is seen edge-on by some.
lattice_boxes = st.lists(st.tuples(*[st.integers(-4, 3)] * 3, *[st.integers(1, 4)] * 3), min_size=1, max_size=3).map(
    lambda rows: [np.array([row[:3], np.add(row[:3], row[3:])], dtype=np.float64) for row in rows]
)
lattice_cameras = st.builds(
    Camera,
    width=st.integers(1, 16),
    height=st.integers(1, 16),
    fx=st.sampled_from([1.0, 2.0, 4.0, 8.0]),
    fy=st.sampled_from([1.0, 2.0, 4.0, 8.0]),
    cx=st.integers(-3, 12).map(float),
    cy=st.integers(-3, 12).map(float),
)


@pytest.mark.slow
@settings(max_examples=150)
@given(
    camera=lattice_cameras,
    boxes=lattice_boxes,
    place=st.tuples(st.integers(-3, 3), st.integers(-3, 3), st.integers(-2, 8)),
    turns=st.tuples(*[st.integers(-2, 2)] * 3),
)
def test_corners_on_pixel_centres_and_faces_edge_on(
    camera: Camera, boxes: list[FloatArray], place: tuple[int, int, int], turns: tuple[int, int, int]
) -> None:
    combined: Any = trimesh.util.concatenate([trimesh.creation.box(bounds=box) for box in boxes])
    state = np.array([*np.array(turns) * np.pi / 2, *place, 0.0, 0.0, 0.0])
    assert_covers_what_brute_force_does([rigid_instrument(combined)], camera, state)


def test_a_corner_just_below_a_row_is_not_counted_negative() -> None:
    """Two edges that meet 2e-16 below a row, in a column's centre, cross the row in the wrong order by rounding."""
    vertices = [[2, -8, 0], [2, -8, 6], [2, 0, 0], [4, -8, 0], [4, 0, 0]]
    faces = [[0, 1, 2], [3, 1, 0], [2, 1, 4], [4, 1, 3], [2, 3, 0], [4, 3, 2]]
    corner = rigid_instrument(trimesh.Trimesh(vertices, faces, process=False))
    camera = Camera(width=17, height=5, fx=1.0, fy=2.0, cx=9.0, cy=3.0)
    state = np.array([-np.pi, np.pi / 2, np.pi / 2, 6.0, 0.0, 2.0, 0.0, 0.0, 0.0])
    evaluator = SilhouetteEvaluator([corner], camera)
    assert_counts_belong_to_mask(evaluator, state, evaluator.mask(state))


@pytest.mark.parametrize("side", [(-1, 0), (1, 0), (0, -1), (0, 1), (1, 1), (-1, 1)])
def test_beside_the_image_nothing_is_covered(small_camera: Camera, side: tuple[int, int]) -> None:
    evaluator = SilhouetteEvaluator([rigid_instrument(BODIES["crossing"])], small_camera)
    state = np.zeros(9)
    state[3:6] = 0.3 * side[0], 0.3 * side[1], 0.2
    assert not evaluator.mask(state).any()
    assert_counts_belong_to_mask(evaluator, state, np.zeros((62, 88), bool))


@pytest.mark.slow
@settings(max_examples=40)
@given(state=needle_driver_states)
def test_the_box_is_that_of_the_mask(small_camera: Camera, state: FloatArray) -> None:
    evaluator = SilhouetteEvaluator([load_instrument("large_needle_driver")], small_camera)
    assert_counts_belong_to_mask(evaluator, state, evaluator.mask(state))


@pytest.mark.parametrize("threads", [1, 2])
def test_one_body_with_many_spans_in_a_row(small_camera: Camera, threads: int) -> None:
    """More than the first scratch has room for, and then fewer again."""
    body = rigid_instrument(zigzag(20, 0.001, 0.0025, 0.03))
    evaluator = SilhouetteEvaluator([body], small_camera, threads=threads)
    state = np.array([0.02, 0.03, 0.1, 0.0, 0.0, 0.08, 0.0, 0.0, 0.0])
    behind = state * [1, 1, 1, 1, 1, -1, 1, 1, 1]
    expected = brute_force([body], small_camera, state)
    runs = np.count_nonzero(np.diff(expected.astype(int), prepend=0, axis=1) == 1, axis=1)
    assert runs.max() > 12
    reference = Reference(expected)
    score = evaluator.score(np.stack([behind, state, behind, state]), reference)
    assert score.area.tolist() == score.overlap.tolist() == [0, reference.area, 0, reference.area]
    assert score.box[1].tolist() == bounding_box(expected)
    assert np.array_equal(evaluator.mask(state), expected)


@pytest.mark.parametrize("threads", [2, 3])
@pytest.mark.parametrize("count", [1, 2, 7])
def test_counts_do_not_depend_on_threads(small_camera: Camera, threads: int, count: int) -> None:
    instruments = [load_instrument("large_needle_driver")] * 2
    states = two_arm_states(count)
    one = SilhouetteEvaluator(instruments, small_camera)
    several = SilhouetteEvaluator(instruments, small_camera, threads=threads)
    reference = Reference(one.mask(states[0]))
    for _ in range(3):
        for alone, shared in zip(one.score(states, reference), several.score(states, reference), strict=True):
            assert np.array_equal(alone, shared)


@pytest.mark.parametrize("clone", [lambda e: pickle.loads(pickle.dumps(e)), copy.deepcopy], ids=["pickle", "copy"])
def test_a_copied_evaluator_counts_on_its_own(
    small_camera: Camera, clone: Callable[[SilhouetteEvaluator], SilhouetteEvaluator]
) -> None:
    evaluator = SilhouetteEvaluator([load_instrument("large_needle_driver")] * 2, small_camera)
    states = two_arm_states(4)
    reference = Reference(evaluator.mask(states[0]))
    expected = evaluator.score(states, reference)
    copied = clone(evaluator)
    # Of other states than the original saw last.
    order = [2, 0, 3, 1]
    score = copied.score(states[order], reference)
    assert score.area.tolist() == expected.area[order].tolist()
    assert score.overlap.tolist() == expected.overlap[order].tolist()
    assert np.array_equal(copied.mask(states[1]), evaluator.mask(states[1]))


def test_evaluators_in_a_thread_pool_do_not_disturb_each_other(small_camera: Camera) -> None:
    instruments = [load_instrument("large_needle_driver")] * 2
    evaluators = [SilhouetteEvaluator(instruments, small_camera, threads=threads) for threads in (1, 2, 2, 3)]
    states = two_arm_states(40)
    reference = Reference(evaluators[0].mask(states[0]))
    expected = evaluators[0].score(states, reference)
    with ThreadPoolExecutor(4) as pool:
        scores = pool.map(lambda evaluator: [evaluator.score(states, reference) for _ in range(5)], evaluators)
        assert all(np.array_equal(score.overlap, expected.overlap) for five in scores for score in five)


SHARED = """
from concurrent.futures import ThreadPoolExecutor
import numpy as np
from surgbench.camera import Camera
from surgbench.instrument import load_instrument
from surgbench.silhouette import Reference, SilhouetteEvaluator

camera = Camera(width=88, height=62, fx=113.2, fy=113.1, cx=36.3, cy=29.4)
evaluator = SilhouetteEvaluator([load_instrument("large_needle_driver")], camera)
first = np.array([0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.3, -0.2, 0.3])
states = first + np.random.default_rng(0).normal(0, 0.02, (100, 9))
reference = Reference(evaluator.mask(first))

def everything(_):
    points = evaluator.contour_points(states[1])
    gradient = evaluator.gradient(states, reference)
    return [*evaluator.score(states, reference), *gradient, *points, evaluator.mask(states[2])]

alone = everything(0)
with ThreadPoolExecutor(2) as pool:
    for shared in pool.map(everything, range(100)):
        assert all(np.array_equal(a, b) for a, b in zip(alone, shared))
"""


@pytest.mark.slow
def test_threads_may_share_an_evaluator() -> None:
    """In a process of its own: two threads in the same scratch would write beyond its end."""
    done = subprocess.run([sys.executable, "-c", SHARED], capture_output=True, text=True, timeout=AMPLE_S, check=False)
    assert done.returncode == 0, done.stderr[-500:]


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own(small_camera: Camera) -> None:
    """The parent's threads are not there in the child: it must not wait for them."""
    instrument = load_instrument("large_needle_driver")
    states = np.tile(resting_state(), (4, 1))
    evaluator = SilhouetteEvaluator([instrument], small_camera, threads=2)
    reference = Reference(evaluator.mask(states[0]))
    expected = evaluator.score(states, reference).area.tolist()

    def count() -> None:
        found = SilhouetteEvaluator([instrument], small_camera, threads=2).score(states, reference).area.tolist()
        os._exit(0 if found == expected else 3)

    child = multiprocessing.get_context("fork").Process(target=count)
    child.start()
    child.join(AMPLE_S)
    code = child.exitcode
    child.kill()
    assert code == 0


# --- what strangers hand in ---------------------------------------------------------------------------------------


def test_huge_states_cover_nothing_and_harm_nothing(small_camera: Camera) -> None:
    """Finite, but their pixels are not."""
    evaluator = SilhouetteEvaluator([load_instrument("large_needle_driver")], small_camera)
    states = np.tile(resting_state(), (300, 1))
    rng = np.random.default_rng(0)
    states[:, 3:6] = rng.uniform(-1, 1, (300, 3)) * 10.0 ** rng.uniform(90, 308, (300, 1))
    reference = Reference(np.ones((62, 88), bool))
    huge = np.abs(states).max(axis=1) > 1e101
    assert not evaluator.score(states, reference).area[huge].any()
    assert not evaluator.gradient(states, reference).area[huge].any()
    assert len(evaluator.contour_points(states[-1]).arm) == 0


def test_threads_that_share_an_evaluator_wait_for_one_another(small_camera: Camera) -> None:
    evaluator = SilhouetteEvaluator([load_instrument("large_needle_driver")], small_camera)
    states = resting_state() + np.random.default_rng(0).normal(0, 0.01, (40, 9))
    reference = Reference(evaluator.mask(resting_state()))
    area, slope = evaluator.score(states, reference).area, evaluator.gradient(states, reference).area

    def repeat(_: int) -> bool:
        same = [np.array_equal(evaluator.score(states, reference).area, area) for _ in range(20)]
        return all(same) and np.array_equal(evaluator.gradient(states, reference).area, slope)

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(repeat, range(8)))


def test_a_reference_is_a_copy(small_camera: Camera) -> None:
    evaluator = SilhouetteEvaluator([rigid_instrument(BODIES["box"])], small_camera)
    state = np.array([0.1, 0.2, 0.3, 0, 0, 0.1, 0, 0, 0])
    buffer = evaluator.mask(state)
    reference = Reference(buffer)
    before = evaluator.gradient(state[None], reference).overlap
    buffer[:] = False
    assert np.array_equal(evaluator.gradient(state[None], reference).overlap, before)
    assert before.any()


@pytest.mark.parametrize(
    "image",
    [np.full((62, 88), 0.7), np.arange(62 * 88).reshape(62, 88), np.zeros((62, 88, 3), bool), np.zeros(5, bool)],
)
def test_what_is_no_mask_is_refused(image: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"a mask must be bool|\(H, W\)"):
        Reference(image)


def test_masks_of_integers_count(small_camera: Camera) -> None:
    mask = np.indices((62, 88)).sum(axis=0) % 3 == 0
    assert Reference(mask.astype(np.uint8) * 255).area == Reference(mask).area == np.count_nonzero(mask)


def test_likely_mistakes_are_answered(small_camera: Camera) -> None:
    box = rigid_instrument(BODIES["box"])
    evaluator = SilhouetteEvaluator([box], small_camera)
    with pytest.raises(TypeError, match=r"make Reference\(mask\) of it"):
        evaluator.gradient(np.zeros((1, 9)), np.zeros((62, 88), bool))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at least one instrument"):
        SilhouetteEvaluator([], small_camera)
    with pytest.raises(ValueError, match="near_m must be positive"):
        SilhouetteEvaluator([box], small_camera, near_m=-1.0)
    with pytest.raises(TypeError):
        evaluator.contour_points(np.zeros(9), spacing_px=1.5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="31 bits"):
        RowSums(np.full((62, 88), 2**40))
    assert len(evaluator.score([], Reference(np.zeros((62, 88), bool))).area) == 0
