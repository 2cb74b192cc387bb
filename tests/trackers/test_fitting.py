"""Dimensions of a body and poses of masks, fitted together."""

from __future__ import annotations

import numpy as np
import pytest

from surgbench.camera import Camera
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.instrument import load_instrument
from surgbench.search.hypotheses import hypothesis_states
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.state import JOINTS, STATE_SCALE
from surgbench.trackers.fitting.adjust import adjust, errors_of
from surgbench.trackers.fitting.dimensions import Dimensions

CAMERA = Camera(width=480, height=340, fx=620.0, fy=620.0, cx=240.0, cy=170.0)
TOOLS = ("large_needle_driver", "cadiere_forceps", "permanent_cautery_hook", "suction_irrigator")


def states_of(dimensions: Dimensions, count: int, seed: int) -> FloatArray:
    """Poses with the wrist amid the picture, joints well within their limits."""
    rng = np.random.default_rng(seed)
    limits = dimensions.instrument.generate_limits
    joints = rng.uniform(0.7 * limits.lower_rad, 0.7 * limits.upper_rad, (count, 3))
    turns = rng.uniform(0.0, 2 * np.pi, (2, count))
    wrist = rng.uniform(180, 300, count), rng.uniform(130, 210, count)
    tilt, depth = np.deg2rad(rng.uniform(35, 60, count)), rng.uniform(0.10, 0.13, count)
    return hypothesis_states(CAMERA, turns[0], tilt, turns[1], depth, wrist, joints)


def masks_of(dimensions: Dimensions, factors: FloatArray, states: FloatArray) -> list[Mask]:
    evaluator = SilhouetteEvaluator([dimensions.build(factors)], CAMERA)
    return [evaluator.mask(state) for state in states]


@pytest.mark.parametrize("tool", TOOLS)
def test_factors_of_one_are_the_instrument(tool: str) -> None:
    instrument = load_instrument(tool)
    dimensions = Dimensions(instrument)
    same = dimensions.build(np.ones(len(dimensions)))
    assert same.spec.tips == instrument.spec.tips
    for name, mesh in instrument.meshes.items():
        np.testing.assert_array_equal(same.meshes[name].vertices_m, mesh.vertices_m)
    assert dimensions.names[0] == "shaft diameter"
    assert 1e-4 < dimensions.values_m.min() <= dimensions.values_m.max() < 0.05


def test_a_longer_wrist_takes_the_jaws_along() -> None:
    dimensions = Dimensions(load_instrument("large_needle_driver"))
    factors = np.ones(len(dimensions))
    factors[dimensions.names.index("wrist length")] = 1.1
    state = np.array([0, 0, 0, 0, 0, 0.13, 0, 0, 0])
    moved = dimensions.build(factors).tips_cam(state) - dimensions.instrument.tips_cam(state)
    np.testing.assert_allclose(moved, [[0, 0, 0.00091]] * 2, atol=1e-9)


@pytest.mark.parametrize("tool", TOOLS)
def test_derivatives_of_contours(tool: str) -> None:
    """Where a contour point lies is where the stretched body's contour is, to first order: by far most of them."""
    from surgbench.trackers.registration.edges import find_edges

    dimensions = Dimensions(load_instrument(tool))
    [state] = states_of(dimensions, 1, seed=3)
    state[JOINTS] = [0.4, -0.3, 0.3]
    factors = 1.0 + np.random.default_rng(1).uniform(-0.05, 0.05, len(dimensions))
    built = dimensions.build(factors)
    contour = SilhouetteEvaluator([built], CAMERA).contour_points(state, 1)
    columns = dimensions.jacobian(contour, state, factors, CAMERA, built)
    for place, name in enumerate(dimensions.names):
        more = factors.copy()
        more[place] += 0.06
        [mask] = masks_of(dimensions, more, state[None])
        seen = find_edges(contour, mask, 20)
        expected = 0.06 * columns[:, place]
        moving = np.abs(expected) > 0.3
        if not moving.any():
            continue
        off = np.abs(seen - expected)[moving]
        assert np.nanmedian(off) < 0.5, name


def test_dimensions_and_poses_come_out_together() -> None:
    """Every dimension is off by 5 to 10 %, the shaft's diameter is told: all others within 2 %."""
    dimensions = Dimensions(load_instrument("cadiere_forceps"))
    rng = np.random.default_rng(0)
    m = len(dimensions)
    true = 1.0 + rng.choice([-1, 1], m) * rng.uniform(0.05, 0.1, m)
    states = states_of(dimensions, 30, seed=5)
    masks = masks_of(dimensions, true, states)
    start = states + rng.normal(size=states.shape) * STATE_SCALE
    begin, prior = np.ones(m), np.full(m, 0.1)
    begin[0], prior[0] = true[0], 0.0
    found = adjust(dimensions, CAMERA, masks, start, prior, begin, iterations=20)
    np.testing.assert_allclose(found.factors / true, 1.0, atol=0.02)
    assert found.factors[0] == true[0]
    assert np.median(found.errors) < 0.002 < 0.1 < errors_of(dimensions, np.ones(m), CAMERA, masks, start).mean()
    # What it says of its own doubt is what it is off by.
    assert (np.abs(found.factors - true)[1:] < 4 * found.deviations[1:]).all()
