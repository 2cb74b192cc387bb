"""TuRBO: its trust region, its Gaussian process, and the initialiser. Most of it needs the extra ``turbo``."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support import observe, resting_state, scene_of

from surgbench.camera import Camera
from surgbench.errors import ConfigError, SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.registry import find
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.trackers.initialisers.turbo import TurboInitialiser
from surgbench.trackers.optimisers.trust_region import FIRST_LENGTH, LARGEST_LENGTH, LEAST_LENGTH, TrustRegion

PERIODIC = np.array([False, True, False])
LEAST = np.array([0.3, 0.99, 0.6])  # the periodic coordinate's best is at the seam


@pytest.fixture
def turbo() -> Any:
    """The module of the optimiser."""
    pytest.importorskip("botorch", reason="BoTorch is not installed (pip install 'surgbench[turbo]')")
    from surgbench.trackers.optimisers import turbo

    return turbo


def bowl(points: FloatArray) -> FloatArray:
    """Zero at ``LEAST``, periodic in the second coordinate."""
    off = points - LEAST
    off[:, 1] = np.sin(np.pi * off[:, 1]) / np.pi
    result: FloatArray = (off**2).sum(axis=1)
    return result


# --- the trust region


def values(*least: float) -> list[FloatArray]:
    return [np.array([value, value + 1.0]) for value in least]


def test_the_region_doubles_after_three_successes_up_to_its_limit() -> None:
    region = TrustRegion(7, 50)
    lengths = []
    for batch in values(*np.arange(10.0, 0.0, -1.0)):
        region.update(batch)
        lengths.append(region.length)
    doubled = min(2 * FIRST_LENGTH, LARGEST_LENGTH)
    assert lengths == [FIRST_LENGTH] * 3 + [doubled] * 7
    assert region.best == 1.0


@pytest.mark.parametrize(("batch", "patience"), [(50, 1), (4, 2), (1, 7)])
def test_the_region_halves_when_patience_ends(batch: int, patience: int) -> None:
    region = TrustRegion(7, batch)
    region.update(np.array([5.0]))
    for _ in range(patience - 1):
        region.update(np.array([5.0]))
        assert region.length == FIRST_LENGTH
    region.update(np.array([6.0]))
    assert region.length == FIRST_LENGTH / 2
    assert region.best == 5.0


def test_an_improvement_of_less_than_a_thousandth_is_none() -> None:
    for least, length in ((-10.005, FIRST_LENGTH / 2), (-10.02, FIRST_LENGTH)):
        region = TrustRegion(7, 50)
        region.update(np.array([-10.0]))
        region.update(np.array([least]))
        assert region.length == length


def test_the_region_collapses() -> None:
    region = TrustRegion(7, 50)
    batches = 0
    while not region.collapsed:
        region.update(np.ones(1))
        batches += 1
    assert batches == 1 + np.ceil(np.log2(FIRST_LENGTH / LEAST_LENGTH))


# --- the optimiser


def search(turbo: Any, function: Any, batches: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """All points and their values."""
    optimiser = turbo.Turbo(PERIODIC, 10, np.random.default_rng(seed))
    points, found = [], []
    for _ in range(batches):
        asked = optimiser.ask()
        assert asked.shape == (10, 3)
        assert ((asked >= 0) & (asked <= 1)).all()
        assert len(np.unique(asked, axis=0)) == 10
        points.append(asked)
        found.append(function(asked))
        optimiser.tell(asked, found[-1])
    return np.concatenate(points), np.concatenate(found)


@pytest.mark.slow
@pytest.mark.extras
def test_turbo_finds_a_minimum_at_the_seam_of_a_periodic_coordinate(turbo: Any) -> None:
    points, found = search(turbo, lambda x: np.log(bowl(x) + 1e-6), 8)
    chance = np.log(bowl(np.random.default_rng(1).random((80, 3))) + 1e-6)
    assert found.min() < np.log(2e-3)
    assert found.min() < chance.min()
    late = points[40:, 1]
    assert (late < 0.2).any()  # both sides of the seam are searched
    assert (late > 0.8).any()


@pytest.mark.slow
@pytest.mark.extras
def test_turbo_is_deterministic_and_leaves_global_state_alone(turbo: Any) -> None:
    import torch

    # On purpose the global generators: nothing may draw from them.
    before_torch, before_numpy = torch.random.get_rng_state(), np.random.get_state()  # noqa: NPY002
    threads, dtype = torch.get_num_threads(), torch.get_default_dtype()
    one, again, other = (search(turbo, bowl, 4, seed)[0] for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)
    assert torch.equal(torch.random.get_rng_state(), before_torch)
    np.testing.assert_equal(np.random.get_state(), before_numpy)  # noqa: NPY002
    assert (torch.get_num_threads(), torch.get_default_dtype()) == (threads, dtype)


@pytest.mark.extras
def test_a_collapsed_region_is_left(turbo: Any) -> None:
    """On a flat function nothing improves; then a new Latin hypercube begins, one point in each tenth."""
    optimiser = turbo.Turbo(PERIODIC, 10, np.random.default_rng(0))
    asked = optimiser.ask()
    first = optimiser.region
    while optimiser.region is first:
        optimiser.tell(asked, np.zeros(10))
    assert optimiser.region.length == FIRST_LENGTH
    tenths = np.sort(np.floor(10 * optimiser.ask()), axis=0)
    np.testing.assert_array_equal(tenths, np.arange(10.0)[:, None].repeat(3, axis=1))


@pytest.mark.slow
@pytest.mark.extras
def test_values_that_are_not_finite_are_the_worst(turbo: Any) -> None:
    def broken(points: FloatArray) -> FloatArray:
        return np.where(points[:, 0] > 0.7, np.inf, np.log(bowl(points) + 1e-6))

    points, found = search(turbo, broken, 6)
    assert found.min() < np.log(1e-2)
    assert (points[30:, 0] < 0.7).mean() > 0.7


@pytest.mark.slow
@pytest.mark.extras
def test_the_gaussian_process_knows_circles_and_which_coordinate_matters(turbo: Any) -> None:
    rng = np.random.default_rng(0)
    points = rng.random((60, 3))
    model = turbo.GaussianProcess(points, np.cos(2 * np.pi * points[:, 1]), PERIODIC)
    assert model.lengths[1] < model.lengths[[0, 2]].min()
    across = np.array([[0.5, 0.001, 0.5], [0.5, 0.999, 0.5]])
    draws = model.sample(across, np.zeros((1, 2)))
    assert draws[0] == pytest.approx([1.0, 1.0], abs=0.1)
    assert abs(draws[0, 0] - draws[0, 1]) < 1e-2


# --- the initialiser

LOW_BUDGET: dict[str, Any] = {
    "evaluations": 60,
    "batch": 20,
    "local_generations": 4,
    "refined": 4,
    "redrawn": 1024,
    "finalists": 2,
    "generations": (10, 30),
}


@pytest.mark.slow
@pytest.mark.extras
def test_turbo_initialiser_finds_the_instrument(turbo: Any, small_camera: Camera) -> None:
    scene = scene_of(small_camera)
    truth = resting_state(0.14)
    initialiser = TurboInitialiser(TurboInitialiser.Config(**LOW_BUDGET))
    fractions: list[float] = []
    state, again = (
        initialiser.initialise(scene, observe(scene, truth), np.random.default_rng(0), None, fractions.append)
        for _ in range(2)
    )
    evaluator = SilhouetteEvaluator(scene.instruments, small_camera)
    reference = Reference(evaluator.mask(truth))
    assert evaluator.score(state[None], reference).iou(reference)[0] > 0.9
    np.testing.assert_array_equal(state, again)
    once = fractions[: len(fractions) // 2]
    assert once == sorted(once)
    assert once[-1] == 1.0


@pytest.mark.slow
@pytest.mark.extras
def test_turbo_initialiser_uses_tips_and_readings(turbo: Any, small_camera: Camera) -> None:
    scene = scene_of(small_camera)
    truth = resting_state(0.14)
    frame = observe(scene, truth, joints=truth[6:])
    tips = small_camera.project(scene.instruments[0].tips_cam(truth))
    view = replace(frame.views[0], keypoints=(tips,))
    frame = replace(frame, views=(view,))
    config = TurboInitialiser.Config(**{**LOW_BUDGET, "evaluations": 40, "redrawn": 256})
    state = TurboInitialiser(config).initialise(scene, frame, np.random.default_rng(0), None, lambda _: None)
    assert np.abs(state[6:] - truth[6:]).max() < 0.3
    assert np.linalg.norm(small_camera.project(scene.instruments[0].tips_cam(state)) - tips, axis=1).max() < 12


@pytest.mark.slow
@pytest.mark.extras
def test_turbo_initialiser_tells_two_arms_apart(turbo: Any, small_camera: Camera) -> None:
    scene = scene_of(small_camera, arms=2)
    left, right = resting_state(), resting_state()
    left[[2, 3]], right[[2, 3]] = [0.8, -0.025], [-0.8, 0.03]
    frame = observe(scene, np.concatenate([left, right]))
    config = TurboInitialiser.Config(**{**LOW_BUDGET, "evaluations": 20, "redrawn": 256})
    state = TurboInitialiser(config).initialise(scene, frame, np.random.default_rng(0), None, lambda _: None)
    assert state[3] < 0 < state[12]


@pytest.mark.extras
def test_turbo_initialiser_refuses_an_empty_mask(turbo: Any, small_camera: Camera) -> None:
    scene = scene_of(small_camera)
    frame = observe(scene, resting_state(-1.0))
    with pytest.raises(SurgbenchError, match="empty"):
        TurboInitialiser().initialise(scene, frame, np.random.default_rng(0), None, lambda _: None)


def test_a_missing_extra_is_named_in_one_line(small_camera: Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib.util

    there = importlib.util.find_spec
    monkeypatch.setattr("surgbench.extras.find_spec", lambda name: None if name == "botorch" else there("numpy"))
    scene = scene_of(small_camera)
    with pytest.raises(ConfigError) as refused:
        TurboInitialiser().initialise(
            scene, observe(scene, resting_state()), np.random.default_rng(0), None, lambda _: None
        )
    assert "botorch is not installed: pip install 'surgbench[turbo]'" in str(refused.value)
    assert "\n" not in str(refused.value)
    unavailable = find("initialiser", "turbo").unavailable
    assert unavailable is not None
    assert "surgbench[turbo]" in unavailable


@pytest.mark.slow
def test_listing_initialisers_loads_no_pytorch() -> None:
    """It would take seconds, and is not there without the extra."""
    code = "import sys; from surgbench.registry import discover; assert discover('initialiser')['turbo'].cls; "
    subprocess.run([sys.executable, "-c", code + "assert 'torch' not in sys.modules"], check=True)
