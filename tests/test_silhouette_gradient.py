"""The gradient of the areas, contour points and row crossings against geometry and against counted pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from support import resting_state, rigid_instrument
from test_silhouette import (
    BODIES,
    DEGENERATE,
    assert_counts_belong_to_mask,
    cameras,
    needle_driver_states,
    poses,
    two_arm_states,
    zigzag,
)

from surgbench.camera import Camera
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
    gradient = evaluator.gradient(state_at(*(offset + [0, 0, 0.105]))[None], EVERYWHERE).area[0]
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
    "near": resting_state(0.09) + [0.1, 1.5, 0.2, 0.004, -0.003, 0, -0.6, 0.7, 0.2],
    "horizontal": aligned(vertical=False),
    "vertical": aligned(vertical=True),
    "near plane": near_plane(),
    "partly outside": resting_state() + [0, 0, 0, 0.018, 0.03, 0, 0, 0, 0],
    "two arms": two_arm_states(1)[0],
    "two arms crossing": np.concatenate([resting_state(), resting_state(0.15) * [1, 1, -1, 1, 1, 1, 1, 1, 1]]),
}


@pytest.mark.parametrize("name", STATES)
def test_the_gradient_averaged_over_a_step_is_the_difference(name: str) -> None:
    """By the fundamental theorem of calculus, kinks or not."""
    state = STATES[name]
    arms = len(state) // 9
    scale = np.tile(STATE_SCALE, arms)
    evaluator = SilhouetteEvaluator([LND] * arms, HALF)
    rng = np.random.default_rng(5)
    for _ in range(3):
        centre = state + rng.standard_normal(len(state)) * scale
        reference = Reference(evaluator.mask(centre + rng.standard_normal(len(state)) * scale))
        found = means_over_steps(evaluator, centre, 0.5 * scale, reference) * scale
        expected = FinerCounts(evaluator, reference.mask, 8).differences(centre, 0.5 * scale) * scale
        for overlap_weight, bound in ((0.0, 0.03), (-2.0, 0.02)):
            ours, truth = found[0] + overlap_weight * found[1], expected[0] + overlap_weight * expected[1]
            assert np.linalg.norm(ours - truth) < bound * np.linalg.norm(truth)
