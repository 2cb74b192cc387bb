"""The gradient of the areas, contour points and row crossings against geometry and against counted pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from bodies import (
    BODIES,
    DEGENERATE,
    assert_counts_belong_to_mask,
    cameras,
    needle_driver_states,
    poses,
    two_arm_states,
    zigzag,
)
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import KDTree
from support import resting_state, rigid_instrument

from surgbench.camera import NEAR_M, Camera
from surgbench.geometry import FloatArray, look_at_angles, look_at_rotation
from surgbench.instrument import load_instrument
from surgbench.silhouette import ContourPoints, Reference, RowSums, SilhouetteEvaluator
from surgbench.state import ANGLES, POSITION, STATE_SCALE

LND = load_instrument("large_needle_driver")
HALF = Camera(width=350, height=246, fx=452.98, fy=452.41, cx=146.89, cy=119.1)
# For geometry: square pixels, the optical axis through the middle of the image.
SQUARE = Camera(width=401, height=401, fx=500.0, fy=500.0, cx=200.0, cy=200.0)
EVERYWHERE = Reference(np.ones((401, 401), bool))


def state_at(x: float, y: float, z: float, alpha: float = 0.0, beta: float = 0.0, gamma: float = 0.0) -> FloatArray:
    return np.array([alpha, beta, gamma, x, y, z, 0.0, 0.0, 0.0])


def evaluator_of(mesh: Any, camera: Camera = SQUARE) -> SilhouetteEvaluator:
    return SilhouetteEvaluator([rigid_instrument(mesh)], camera)


# --- geometry that one can work out -------------------------------------------------------------------------------


def test_a_sphere_shrinks_as_it_goes_away() -> None:
    """Its circle has the radius f r / sqrt(z^2 - r^2); turning it about its centre changes nothing."""
    radius, depth = 0.02, 0.15
    gradient = evaluator_of(trimesh.creation.icosphere(5, radius)).gradient(state_at(0, 0, depth)[None], EVERYWHERE)
    expected = -2 * np.pi * SQUARE.fx**2 * radius**2 * depth / (depth**2 - radius**2) ** 2
    assert gradient.area[0, 5] == pytest.approx(expected, rel=2e-3)
    assert gradient.overlap[0] == pytest.approx(gradient.area[0])
    others = np.delete(gradient.area[0] * STATE_SCALE, 5)
    assert np.abs(others).max() < 2e-3 * abs(expected) * STATE_SCALE[5]


def test_edges_shorter_than_a_pixel_count_too() -> None:
    """A small sphere of many triangles: most of its outline's edges cross neither a row nor a column."""
    radius, depth = 0.004, 0.2
    evaluator = evaluator_of(trimesh.creation.icosphere(5, radius))
    states = np.array([state_at(x, y, depth) for x in (0, 0.0001, 0.0003) for y in (0, 0.0002, 0.00023)])
    gradient = evaluator.gradient(states, EVERYWHERE).area
    expected = -2 * np.pi * SQUARE.fx**2 * radius**2 * depth / (depth**2 - radius**2) ** 2
    assert gradient[:, 5] == pytest.approx(expected, rel=0.01)


def test_a_box_shrinks_as_it_goes_away() -> None:
    """Straight before the camera its front face is all that is seen."""
    evaluator = evaluator_of(trimesh.creation.box((0.04, 0.03, 0.02)))
    gradient = evaluator.gradient(state_at(0.001, -0.002, 0.16)[None], EVERYWHERE).area[0]
    front = 0.15
    assert gradient[5] == pytest.approx(-2 * SQUARE.fx**2 * 0.04 * 0.03 / front**3, rel=1e-6)
    assert gradient[3:5] == pytest.approx([0, 0], abs=1e-6 * abs(gradient[5]))


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_box_slides_out_of_the_image(axis: int, side: int) -> None:
    """Half of it lies beyond the border: what enters on the far edge of it leaves at the border."""
    size = np.array([0.2, 0.2, 0.01])
    size[1 - axis] = 0.03
    offset = np.zeros(3)
    offset[axis] = side * 0.09  # from 1 cm on one side of the optical axis to far beyond the border on the other
    evaluator = evaluator_of(trimesh.creation.box(size))
    gradient = evaluator.gradient(state_at(offset[0], offset[1], 0.105)[None], EVERYWHERE).area[0]
    front = 0.1
    edge_px = SQUARE.fx * 0.03 / front
    assert gradient[3 + axis] == pytest.approx(-side * edge_px * SQUARE.fx / front, rel=1e-6)
    assert gradient[4 - axis] == pytest.approx(0, abs=1e-6 * abs(gradient[3 + axis]))


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("side", [-1, 1])
def test_an_edge_moves_over_half_a_mask(axis: int, side: int) -> None:
    """Only the edge that lies in the mask changes the overlap: by its length, times how fast it moves."""
    mask = np.indices((401, 401))[1 - axis] * side > 200 * side
    size = np.array([0.04, 0.04, 0.01])
    size[1 - axis] = 0.03
    evaluator = evaluator_of(trimesh.creation.box(size))
    gradient = evaluator.gradient(state_at(0.001, 0.0015, 0.105)[None], Reference(mask))
    front = 0.1
    edge_px = SQUARE.fx * 0.03 / front
    assert gradient.overlap[0, 3 + axis] == pytest.approx(side * edge_px * SQUARE.fx / front, rel=1e-6)
    assert gradient.overlap[0, 4 - axis] == pytest.approx(0, abs=1e-6 * edge_px * SQUARE.fx / front)
    assert gradient.area[0, 3:5] == pytest.approx([0, 0], abs=1e-6 * edge_px * SQUARE.fx / front)


def diamond() -> Any:
    """A prism whose base has corners at 1/8 m on the axes: its edges run at exactly 45 degrees."""
    box = trimesh.creation.box(bounds=[[-1, -1, 0], [1, 1, 1]])
    x, y, z = box.vertices.T
    mesh = trimesh.Trimesh(np.column_stack([(x - y) / 16, (x + y) / 16, z]), box.faces, process=False)
    assert mesh.volume > 0
    return mesh


def test_edges_at_45_degrees_count_once() -> None:
    camera = Camera(width=64, height=64, fx=128.0, fy=128.0, cx=32.0, cy=32.0)
    evaluator = evaluator_of(diamond(), camera)
    state = state_at(0, 0, 1.0)
    gradient = evaluator.gradient(state[None], Reference(np.ones((64, 64), bool))).area[0]
    side_px = 16 * np.sqrt(2)
    assert gradient[5] == pytest.approx(-2 * side_px**2, rel=1e-9)
    assert evaluator.contour_points(state, spacing_px=1).lengths_px.sum() == pytest.approx(4 * side_px, rel=0.03)


# --- pixels counted on a finer grid -------------------------------------------------------------------------------


def finer(camera: Camera, factor: int) -> Camera:
    cx, cy = (camera.cx + 0.5) * factor - 0.5, (camera.cy + 0.5) * factor - 0.5
    return Camera.model_construct(
        width=camera.width * factor, height=camera.height * factor,
        fx=camera.fx * factor, fy=camera.fy * factor, cx=cx, cy=cy,
    )  # fmt: skip


class FinerCounts:
    """Area and overlap in pixels, counted on a grid ``factor`` times finer."""

    def __init__(self, evaluator: SilhouetteEvaluator, mask: NDArray[np.bool_], factor: int) -> None:
        self._evaluator = SilhouetteEvaluator(evaluator.instruments, finer(evaluator.camera, factor))
        self._sums = RowSums(np.repeat(np.repeat(mask, factor, axis=0), factor, axis=1))
        self._factor = factor

    def __call__(self, states: FloatArray) -> FloatArray:
        counts = self._evaluator.sum_over(states.reshape(-1, states.shape[-1]), self._sums)
        return np.reshape(counts, (2, *states.shape[:-1])) / self._factor**2

    def differences(self, state: FloatArray, steps: FloatArray) -> FloatArray:
        """``(2, D)`` central differences of area and overlap."""
        ahead, behind = (self(state + sign * np.diag(steps)) for sign in (1, -1))
        return np.asarray((ahead - behind) / (2 * steps))


STEPS = 16


def means_over_steps(
    evaluator: SilhouetteEvaluator, state: FloatArray, steps: FloatArray, reference: Reference
) -> FloatArray:
    """``(2, D)``: each derivative, averaged from one step behind to one step ahead along its own axis."""
    shares = (np.arange(STEPS) + 0.5) * 2 / STEPS - 1.0
    moved = state + shares[:, None, None] * np.diag(steps)
    gradient = np.array(evaluator.gradient(moved.reshape(-1, len(state)), reference))
    return np.asarray(np.einsum("psdd->pd", gradient.reshape(2, len(shares), len(state), len(state))) / len(shares))


def aligned(vertical: bool) -> FloatArray:
    """Needle drivers whose shaft's image is nearly horizontal, or vertical."""
    axis = np.array([0.02, 0.75, 0.66]) if vertical else np.array([0.75, 0.02, 0.66])
    state = resting_state()
    state[[0, 2]] = -np.arcsin(axis[1] / np.linalg.norm(axis)), np.arctan2(axis[0], axis[2])
    return state


def near_plane() -> FloatArray:
    """The shaft starts behind the camera."""
    return np.array([0.65, 1.7, -0.5, 0.006, 0.002, 0.12, 0.32, 0.1, 0.5])


STATES = {
    "usual": resting_state(),
    "near": resting_state(0.09) + np.array([0.1, 1.5, 0.2, 0.004, -0.003, 0, -0.6, 0.7, 0.2]),
    "horizontal": aligned(vertical=False),
    "vertical": aligned(vertical=True),
    "near plane": near_plane(),
    "partly outside": resting_state() + np.array([0, 0, 0, 0.018, 0.03, 0, 0, 0, 0]),
    "two arms": two_arm_states(1)[0],
    "two arms crossing": np.concatenate([resting_state(), resting_state(0.15) * [1, 1, -1, 1, 1, 1, 1, 1, 1]]),
}


def assert_averages_are_differences(evaluator: SilhouetteEvaluator, state: FloatArray, scale: FloatArray) -> None:
    """By the fundamental theorem of calculus, kinks or not; over many states, so that their sampling averages out."""
    rng = np.random.default_rng(5)
    reference = Reference(evaluator.mask(state + 3 * rng.choice([-1, 1], len(state)) * scale))
    counts = FinerCounts(evaluator, reference.mask, 8)
    found, expected = np.zeros((2, 2, len(state)))
    for _ in range(24):
        centre = state + rng.uniform(-1, 1, len(state)) * scale
        found += means_over_steps(evaluator, centre, 0.5 * scale, reference) * scale
        expected += counts.differences(centre, 0.5 * scale) * scale
    assert np.linalg.norm(found[0] - expected[0]) < 0.025 * np.linalg.norm(expected[0])
    ours, truth = found[0] - 2 * found[1], expected[0] - 2 * expected[1]  # eq. (6)
    assert np.linalg.norm(ours - truth) < 0.01 * np.linalg.norm(truth)


@pytest.mark.slow
@pytest.mark.parametrize("name", STATES)
def test_the_gradient_averaged_over_steps_is_the_difference(name: str) -> None:
    arms = len(STATES[name]) // 9
    assert_averages_are_differences(SilhouetteEvaluator([LND] * arms, HALF), STATES[name], np.tile(STATE_SCALE, arms))


@pytest.mark.parametrize("near_end", [-0.02, 0.0, 0.0005])
def test_visible_edges_that_the_near_plane_cuts(near_end: float) -> None:
    """A rod beside the camera, in one piece: its outline runs out of the image and through the camera plane."""
    evaluator = evaluator_of(trimesh.creation.cylinder(0.005, 0.2, sections=7), HALF)
    # Along (0.6, -0.3, 0.74); its near end at that depth, its far end in the image.
    axis = np.array([0.6, -0.3, 0.74]) / np.linalg.norm([0.6, -0.3, 0.74])
    end = np.array([-0.06, 0.03, near_end])
    alpha, gamma = -np.arcsin(axis[1]), np.arctan2(axis[0], axis[2])
    state = np.array([alpha, 0.3, gamma, *(end + 0.1 * axis), 0, 0, 0])
    mesh = evaluator.instruments[0].meshes["body"].vertices_m @ look_at_rotation(state[ANGLES]).T + state[POSITION]
    assert mesh[:, 2].min() < NEAR_M < mesh[:, 2].max()
    scale = np.where(np.arange(9) < 6, STATE_SCALE, 1.0)
    assert_averages_are_differences(evaluator, state, scale)
    points = evaluator.contour_points(state, spacing_px=1)
    summed = points.lengths_px @ points.jacobian * scale
    gradient = evaluator.gradient(state[None], Reference(np.ones((246, 350), bool))).area[0] * scale
    assert np.linalg.norm(summed - gradient) < 0.05 * np.linalg.norm(gradient)


@pytest.mark.parametrize("name", STATES)
def test_the_gradient_of_a_single_state(name: str) -> None:
    """Of eq. (6), where the derivatives to the left and to the right agree; at kinks there is none."""
    state = STATES[name]
    arms = len(state) // 9
    scale = np.tile(STATE_SCALE, arms)
    evaluator = SilhouetteEvaluator([LND] * arms, HALF)
    rng = np.random.default_rng(7)
    reference = Reference(evaluator.mask(state + 3 * rng.choice([-1, 1], len(state)) * scale))
    counts = FinerCounts(evaluator, reference.mask, 16)
    steps = 0.04 * scale
    smooth = 0
    for _ in range(6):
        centre = state + rng.standard_normal(len(state)) * scale
        here = counts(centre[None])
        sides = [(counts(centre + sign * np.diag(steps)) - here) * sign / steps * scale for sign in (-1, 1)]
        left, right = (area - 2 * overlap for area, overlap in sides)
        truth = (left + right) / 2
        if np.linalg.norm(left - right) > 0.03 * np.linalg.norm(truth):
            continue
        smooth += 1
        gradient = evaluator.gradient(centre[None], reference)
        ours = (gradient.area[0] - 2 * gradient.overlap[0]) * scale
        assert np.linalg.norm(ours - truth) < 0.05 * np.linalg.norm(truth)
    assert smooth >= 2


# --- states with little or nothing to see -------------------------------------------------------------------------


@pytest.mark.parametrize("arms", [1, 2])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_state_that_is_not_finite_has_no_gradient(arms: int, value: float) -> None:
    evaluator = SilhouetteEvaluator([LND] * arms, HALF)
    states = np.tile(resting_state(), (9 * arms + 1, arms))
    for component in range(9 * arms):
        states[component, component] = value
    gradient = evaluator.gradient(states, Reference(np.ones((246, 350), bool)))
    assert not gradient.area[:-1].any()
    assert not gradient.overlap[:-1].any()
    assert np.isfinite(gradient.area[-1]).all()
    assert gradient.area[-1].any()
    assert len(evaluator.contour_points(states[0]).arm) == 0
    assert len(evaluator.row_crossings(states[0]).row) == 0


@pytest.mark.parametrize("place", [(0, 0, -0.1), (2, 0, 0.5), (0, -2, 0.5)], ids=["behind", "right", "above"])
def test_what_is_not_seen_has_no_gradient(place: tuple[float, float, float]) -> None:
    evaluator = evaluator_of(BODIES["crossing"])
    state = state_at(*place)
    gradient = evaluator.gradient(state[None], EVERYWHERE)
    assert not gradient.area.any()
    assert not gradient.overlap.any()
    assert len(evaluator.contour_points(state).arm) == 0
    assert len(evaluator.row_crossings(state).row) == 0


def test_a_camera_inside_a_solid_sees_no_contour() -> None:
    evaluator = evaluator_of(trimesh.creation.box((1, 1, 1)))
    assert not evaluator.gradient(np.zeros((1, 9)), EVERYWHERE).area.any()
    assert len(evaluator.contour_points(np.zeros(9)).arm) == 0


@pytest.mark.parametrize("hidden", [0, 1])
def test_an_arm_hidden_behind_the_other_changes_nothing(hidden: int) -> None:
    bodies = [rigid_instrument(trimesh.creation.box((0.06, 0.05, 0.01)))] * 2
    pair = SilhouetteEvaluator(bodies, SQUARE)
    alone = SilhouetteEvaluator(bodies[:1], SQUARE)
    front, back = state_at(0.002, 0.001, 0.12, 0.2, 0.3, 0.1), state_at(0.01, 0.0, 0.4, 0.1, 0.5, -0.3)
    state = np.concatenate([back, front] if hidden == 0 else [front, back])
    mask = Reference(np.indices((401, 401)).sum(axis=0) < 400)
    both, one = pair.gradient(state[None], mask), alone.gradient(front[None], mask)
    for found, expected in zip(both, one, strict=True):
        assert not found.reshape(2, 9)[hidden].any()
        assert found.reshape(2, 9)[1 - hidden] == pytest.approx(expected[0], rel=1e-12)
    points = pair.contour_points(state)
    assert set(points.arm) == {1 - hidden}
    assert not points.jacobian.reshape(-1, 2, 9)[:, hidden].any()


def test_arms_apart_have_their_own_gradients() -> None:
    left, right = resting_state(), resting_state()
    left[3], right[3], right[2] = -0.02, 0.05, -0.8
    pair, one = SilhouetteEvaluator([LND, LND], HALF), SilhouetteEvaluator([LND], HALF)
    assert not (one.mask(left) & one.mask(right)).any()
    reference = Reference(np.indices((246, 350)).sum(axis=0) % 50 < 25)
    both = pair.gradient(np.concatenate([left, right])[None], reference)
    single = one.gradient(np.stack([left, right]), reference)
    for found, expected in zip(both, single, strict=True):
        assert found.reshape(2, 9) == pytest.approx(expected, rel=1e-12)


def test_contour_points_know_their_link() -> None:
    """With two arms a link counts within its arm; a joint moves points of its own link and of those beyond it."""
    left, right = resting_state(), resting_state()
    left[3], right[3], right[2] = -0.02, 0.05, -0.8
    points = SilhouetteEvaluator([LND, LND], HALF).contour_points(np.concatenate([left, right]))
    for arm in (0, 1):
        own = points.arm == arm
        assert {"shaft", "wrist", "jaw_right", "jaw_left"} <= {LND.spec.links[k].name for k in set(points.link[own])}
        pitched = points.jacobian.reshape(-1, 2, 9)[own, arm, 6] != 0
        assert not pitched[points.link[own] == LND.link_index["shaft"]].any()
        assert pitched[points.link[own] == LND.link_index["wrist"]].any()
        jaw = points.jacobian.reshape(-1, 2, 9)[own, arm, 8] != 0
        assert set(points.link[own][jaw]) == {LND.link_index["jaw_right"], LND.link_index["jaw_left"]}


def test_a_gradient_depends_on_its_state_alone() -> None:
    """Not on the batch, the threads of the scores, nor on what the scratch was used for before."""
    instruments = [LND, LND]
    states = two_arm_states(6)
    evaluator = SilhouetteEvaluator(instruments, HALF)
    reference = Reference(evaluator.mask(states[0]))
    together = evaluator.gradient(states, reference)
    other = SilhouetteEvaluator(instruments, HALF, threads=3)
    for k in reversed(range(len(states))):
        other.contour_points(states[k - 1])
        other.row_crossings(states[k - 2])
        alone = other.gradient(states[k][None], reference)
        other.score(states, reference)
        assert np.array_equal(alone.area[0], together.area[k])
        assert np.array_equal(alone.overlap[0], together.overlap[k])


# --- contour points -----------------------------------------------------------------------------------------------


def assert_on_the_edge(
    evaluator: SilhouetteEvaluator, state: FloatArray, points: ContourPoints, factor: int = 8, share: float = 1.0
) -> None:
    """Points lie on the outline of a finer mask, which is crossed along the normal from inside to outside.

    ``share`` of them have to: slits narrower than its pixels are outlines too.
    """
    mask = SilhouetteEvaluator(evaluator.instruments, finer(evaluator.camera, factor)).mask(state)

    def pixels(places: FloatArray) -> NDArray[np.int_]:
        row_column = np.rint((places[:, ::-1] + 0.5) * factor - 0.5).astype(int)
        return np.asarray(np.clip(row_column, 0, np.subtract(mask.shape, 1)))

    def look(places: FloatArray) -> NDArray[np.bool_]:
        return np.asarray(mask[tuple(pixels(places).T)])

    assert np.quantile(distances_to_the_other_side(mask, pixels(points.points_px)), share) <= 2.5
    assert np.linalg.norm(points.normals, axis=1) == pytest.approx(1.0)
    inside = look(points.points_px - 0.4 * points.normals)
    outside = ~look(points.points_px + 0.4 * points.normals)
    # Beside sharp corners and where parts meet, a way of 0.4 pixels leads elsewhere.
    assert (inside & outside).mean() > 0.95
    assert (~inside & ~outside).mean() <= 1 - share


def distances_to_the_other_side(mask: NDArray[np.bool_], pixels: NDArray[np.int_]) -> FloatArray:
    """How far each of some pixels is from the nearest that is covered where it is not, or the reverse."""
    boundary = np.zeros_like(mask)  # of both sides: pixels that have one of the other beside, above or below them
    for axis in (0, 1):
        here, there = ((slice(None),) * axis + (part,) for part in (slice(None, -1), slice(1, None)))
        changes = np.diff(mask, axis=axis)
        boundary[here] |= changes
        boundary[there] |= changes
    covered = mask[tuple(pixels.T)]
    distances = np.empty(len(pixels))
    for side in (True, False):
        distances[covered == side] = KDTree(np.argwhere(boundary & (mask != side))).query(pixels[covered == side])[0]
    return distances


def outline(mask: NDArray[np.bool_]) -> FloatArray:
    """``(K, 2)`` places between pixels of which one is covered."""
    between = []
    for axis in (0, 1):
        places = np.argwhere(np.diff(mask, axis=axis)).astype(np.float64)
        places[:, axis] += 0.5
        between.append(places[:, ::-1])
    return np.concatenate(between)


def distances_to(places: FloatArray, points: FloatArray) -> FloatArray:
    return np.asarray(KDTree(points).query(places)[0])


@pytest.mark.parametrize("name", STATES)
@pytest.mark.parametrize("spacing_px", [1, 2])
def test_contour_points_lie_along_the_whole_outline(name: str, spacing_px: int) -> None:
    state = STATES[name]
    evaluator = SilhouetteEvaluator([LND] * (len(state) // 9), HALF)
    points = evaluator.contour_points(state, spacing_px=spacing_px)
    assert_on_the_edge(evaluator, state, points)
    gaps = distances_to(outline(evaluator.mask(state)), points.points_px)
    assert np.quantile(gaps, 0.98) < spacing_px
    assert gaps.max() < 2.5 * spacing_px


def test_wider_spacing_takes_some_of_the_points() -> None:
    evaluator = SilhouetteEvaluator([LND], HALF)
    every, some = (evaluator.contour_points(resting_state(), spacing_px=k) for k in (1, 3))
    chosen = (every.points_px % 3 == 0).any(axis=1)
    assert np.isin(some.points_px.view(complex), every.points_px[chosen].view(complex)).all()
    assert some.lengths_px.sum() == pytest.approx(every.lengths_px.sum(), rel=0.03)
    with pytest.raises(ValueError, match="spacing_px"):
        evaluator.contour_points(resting_state(), spacing_px=0)


def test_lengths_add_up_to_the_perimeter() -> None:
    radius, depth = 0.02, 0.12
    ball = evaluator_of(trimesh.creation.icosphere(4, radius)).contour_points(state_at(0, 0, depth), spacing_px=1)
    assert ball.lengths_px.sum() == pytest.approx(2 * np.pi * 500 * radius / np.sqrt(depth**2 - radius**2), rel=5e-3)
    board = evaluator_of(trimesh.creation.box((0.05, 0.03, 0.001)))
    for beta in (0.0, 0.3, 1.1, np.pi / 2):
        points = board.contour_points(state_at(0, 0, 0.1005, beta=beta), spacing_px=1)
        assert points.lengths_px.sum() == pytest.approx(2 * 500 * (0.05 + 0.03) / 0.1, rel=0.01)
        middle = points.points_px - 200.0
        assert ((middle * points.normals).sum(axis=1) > 0).all()


@pytest.mark.parametrize("name", STATES)
def test_jacobian_rows_are_how_far_the_contour_moves(name: str) -> None:
    """Row crossings moved by a small step, seen along the normal."""
    state = STATES[name]
    scale = np.tile(STATE_SCALE, len(state) // 9)
    evaluator = SilhouetteEvaluator([LND] * (len(state) // 9), HALF)
    points = evaluator.contour_points(state, spacing_px=1)
    by_place = {tuple(place): k for k, place in enumerate(points.points_px)}
    step = 1e-5
    worst, compared = 0.0, 0
    for component in range(len(state)):
        moved = [
            evaluator.row_crossings(state + sign * step * scale * np.eye(len(state))[component]) for sign in (1, -1)
        ]
        here = evaluator.row_crossings(state)
        if any(not np.array_equal(side.row, here.row) for side in moved):
            continue  # a crossing has come or gone at an end of the contour
        speed = (moved[0].u_px - moved[1].u_px) / (2 * step)
        bend = np.abs(moved[0].u_px + moved[1].u_px - 2 * here.u_px) / step
        for k in np.flatnonzero(bend < 1e-3):
            sample = by_place.get((here.u_px[k], float(here.row[k])))
            if sample is None:
                continue
            rate = points.jacobian[sample, component] * scale[component]
            worst = max(worst, abs(rate - speed[k] * points.normals[sample, 0]) / (1e-3 + 1e-3 * abs(rate)))
            compared += 1
    assert worst < 1.0
    assert compared > 100


@pytest.mark.parametrize("name", ["usual", "near", "horizontal", "vertical"])
def test_flat_contours_are_treated_as_steep_ones(name: str) -> None:
    """A quarter turn of the camera makes columns of rows: points, normals and Jacobians turn along."""
    state = STATES[name]
    turned = state.copy()
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned[ANGLES] = look_at_angles(quarter @ look_at_rotation(state[ANGLES]))
    turned[POSITION] = quarter @ state[POSITION]
    evaluator = SilhouetteEvaluator([LND], SQUARE)
    points, others = evaluator.contour_points(state, spacing_px=1), evaluator.contour_points(turned, spacing_px=1)
    expected = np.column_stack([400 - points.points_px[:, 1], points.points_px[:, 0]])
    a, b = (np.lexsort(np.round(places, 6).T) for places in (expected, others.points_px))
    assert others.points_px[b] == pytest.approx(expected[a], abs=1e-8)
    assert others.normals[b] == pytest.approx(np.column_stack([-points.normals[:, 1], points.normals[:, 0]])[a])
    assert others.lengths_px[b] == pytest.approx(points.lengths_px[a])
    # A move to the right is now one down.
    for one, other, sign in ((3, 4, 1), (4, 3, -1), (5, 5, 1), (6, 6, 1), (7, 7, 1), (8, 8, 1)):
        assert others.jacobian[b, other] == pytest.approx(sign * points.jacobian[a, one], rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("name", STATES)
def test_points_add_up_to_the_gradient(name: str) -> None:
    state = STATES[name]
    arms = len(state) // 9
    scale = np.tile(STATE_SCALE, arms)
    evaluator = SilhouetteEvaluator([LND] * arms, HALF)
    rng = np.random.default_rng(3)
    states = state + rng.uniform(-1, 1, (16, len(state))) * scale
    summed = np.zeros(len(state))
    for one in states:
        points = evaluator.contour_points(one, spacing_px=1)
        summed += points.lengths_px @ points.jacobian * scale
    gradient = (evaluator.gradient(states, Reference(np.ones((246, 350), bool))).area * scale).sum(axis=0)
    assert np.linalg.norm(summed - gradient) < 0.05 * np.linalg.norm(gradient)


@pytest.mark.parametrize("body", ["touching", "split box", "split sphere"])
def test_no_contour_within_a_body(body: str) -> None:
    """Where parts touch, or a face has no area, edges coincide and cancel."""
    evaluator = evaluator_of(DEGENERATE[body])
    rng = np.random.default_rng(2)
    for _ in range(5):
        state = np.array([*rng.uniform(-1, 1, 3), *rng.uniform(-0.01, 0.01, 2), 0.15, 0, 0, 0])
        assert_on_the_edge(evaluator, state, evaluator.contour_points(state, spacing_px=1), factor=4)


# --- row crossings ------------------------------------------------------------------------------------------------


def assert_crossings_bound_the_mask(evaluator: SilhouetteEvaluator, state: FloatArray) -> None:
    width = evaluator.camera.width
    mask, crossings = evaluator.mask(state), evaluator.row_crossings(state)
    order = np.lexsort((crossings.u_px, crossings.row))
    assert np.array_equal(order, np.arange(len(order)))
    assert set(crossings.sign) <= {-1, 1}
    assert ((crossings.u_px >= -0.5) & (crossings.u_px < width - 0.5)).all()
    for row in range(evaluator.camera.height):
        here = crossings.row == row
        columns = np.clip(np.ceil(crossings.u_px[here]), 0, width).astype(int)
        signs = crossings.sign[here]
        assert (np.diff(signs) != 0).all()
        if len(columns) == 0:
            assert mask[row].all() or not mask[row].any()
            continue
        # What reaches over the border has no crossing there.
        bounds = [*([0] if signs[0] > 0 else []), *columns, *([width] if signs[-1] < 0 else [])]
        filled = np.zeros(width, bool)
        for begin, end in zip(bounds[::2], bounds[1::2], strict=True):
            filled[begin:end] = True
        assert np.array_equal(filled, mask[row])


@pytest.mark.slow
@settings(max_examples=60)
@given(camera=cameras, body=st.sampled_from(sorted(BODIES)), state=poses)
def test_crossings_of_bodies_bound_the_mask(camera: Camera, body: str, state: FloatArray) -> None:
    # Where the near plane cuts a body there are no crossings.
    assume((BODIES[body].vertices @ look_at_rotation(state[ANGLES])[2] + state[5]).min() > NEAR_M)
    assert_crossings_bound_the_mask(evaluator_of(BODIES[body], camera), state)


@pytest.mark.slow
@settings(max_examples=30)
@given(state=needle_driver_states)
def test_crossings_of_a_needle_driver_bound_the_mask(small_camera: Camera, state: FloatArray) -> None:
    # Far enough for the near plane to cut the shaft outside the image, if at all.
    assume(state[5] > 0.06)
    assert_crossings_bound_the_mask(SilhouetteEvaluator([LND], small_camera), state)


def test_crossings_of_two_arms_bound_the_mask() -> None:
    evaluator = SilhouetteEvaluator([LND, LND], HALF)
    for state in two_arm_states(5):
        assert_crossings_bound_the_mask(evaluator, state)


# --- room ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_many_spans_in_a_row_and_many_points() -> None:
    """More than the first scratch has room for, of both; each fold is like the next."""
    mesh = zigzag(60, 0.0004, 0.0011, 0.07)
    state = state_at(0.0, 0.0, 0.1, 0.02, 0.03, 0.01)
    fresh = evaluator_of(mesh)
    crossings = fresh.row_crossings(state)
    assert np.bincount(crossings.row).max() > 100
    assert_crossings_bound_the_mask(fresh, state)
    points = evaluator_of(mesh).contour_points(state, spacing_px=1)
    assert len(points.arm) > 4 * (SQUARE.width + SQUARE.height)
    assert_on_the_edge(fresh, state, points, factor=4, share=0.98)
    half_plane = Reference(np.indices((401, 401))[0] < 150)
    first = evaluator_of(mesh).gradient(np.stack([state, state * 0.99, state]), half_plane)
    assert np.array_equal(first.area[0], first.area[2])
    for warm in (fresh.gradient(state[None], half_plane), fresh.gradient(state[None], half_plane)):
        assert np.array_equal(warm.area[0], first.area[0])
        assert np.array_equal(warm.overlap[0], first.overlap[0])
    counts = FinerCounts(fresh, half_plane.mask, 8)
    steps = 0.25 * STATE_SCALE
    means = means_over_steps(fresh, state, steps, half_plane) * STATE_SCALE
    expected = counts.differences(state, steps) * STATE_SCALE
    assert np.linalg.norm(means - expected) < 0.02 * np.linalg.norm(expected)
    # And the scratch still serves what needs little room.
    assert_counts_belong_to_mask(fresh, state, fresh.mask(state))
