"""The areas and tips as PyTorch functions: the same numbers, and a gradient that descends."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support import resting_state

from surgbench.camera import Camera
from surgbench.instrument import load_instrument
from surgbench.silhouette import KeypointProjector, Reference, SilhouetteEvaluator, autograd
from surgbench.state import STATE_SCALE


@pytest.fixture(scope="module")
def evaluator(small_camera: Camera) -> SilhouetteEvaluator:
    return SilhouetteEvaluator([load_instrument("large_needle_driver")], small_camera)


def test_areas_are_the_counts_and_their_gradient_is_the_engines(evaluator: SilhouetteEvaluator) -> None:
    truth = resting_state()
    reference = Reference(evaluator.mask(truth))
    states = truth + np.random.default_rng(0).standard_normal((4, 9)) * STATE_SCALE
    tensor = torch.tensor(states, requires_grad=True)
    area, overlap = autograd.areas(tensor, evaluator, reference)
    score, gradient = evaluator.score(states, reference), evaluator.gradient(states, reference)
    assert area.detach().numpy() == pytest.approx(score.area)
    assert overlap.detach().numpy() == pytest.approx(score.overlap)
    weights = torch.tensor([1.0, -2.0, 0.5, 3.0], dtype=torch.float64)
    (weights * (area**2 - 2 * overlap)).sum().backward()
    expected = weights.numpy()[:, None] * (2 * score.area[:, None] * gradient.area - 2 * gradient.overlap)
    assert tensor.grad is not None
    assert tensor.grad.numpy() == pytest.approx(expected)


def test_single_precision_tensors_stay_single(evaluator: SilhouetteEvaluator) -> None:
    reference = Reference(evaluator.mask(resting_state()))
    tensor = torch.tensor(resting_state()[None], dtype=torch.float32, requires_grad=True)
    area, _ = autograd.areas(tensor, evaluator, reference)
    area.sum().backward()
    assert tensor.grad is not None
    assert area.dtype == tensor.grad.dtype == torch.float32


def test_tips_pass_gradcheck(small_camera: Camera) -> None:
    """PyTorch's own finite differences; two arms, and a tip behind the camera that must not spoil the rest."""
    instrument = load_instrument("large_needle_driver")
    projector = KeypointProjector([instrument, instrument], small_camera)
    other = resting_state() + np.array([0.1, 0.5, -0.3, 0.01, 0.005, 0.02, -0.5, 0.2, 0.4])
    states = torch.tensor(np.concatenate([resting_state(), other])[None], requires_grad=True)
    assert torch.autograd.gradcheck(lambda s: autograd.tips(s, projector) / 100, (states,), eps=1e-6, atol=1e-4)
    behind = states.detach().clone()
    behind[0, 5] = -0.5
    behind.requires_grad_()
    places = autograd.tips(behind, projector)
    assert bool(torch.isnan(places[0, 0]).all())
    places[0, 1].sum().backward()
    assert behind.grad is not None
    assert np.isfinite(behind.grad.numpy()).all()
    assert not behind.grad[0, :9].any()


@pytest.mark.slow
def test_descent_on_the_mismatch_finds_the_position_again(camera: Camera) -> None:
    evaluator = SilhouetteEvaluator([load_instrument("large_needle_driver")], camera)
    truth = resting_state()
    reference = Reference(evaluator.mask(truth))
    start = truth.copy()
    start[3:6] += [0.001, -0.001, 0.006]
    step = torch.zeros(9, dtype=torch.float64, requires_grad=True)
    scale = torch.tensor(STATE_SCALE * np.array([0, 0, 0, 1, 1, 1, 0, 0, 0]))
    optimiser = torch.optim.Adam([step], lr=0.3)
    for _ in range(80):
        optimiser.zero_grad()
        area, overlap = autograd.areas((torch.tensor(start) + scale * step)[None], evaluator, reference)
        (area - 2 * overlap).sum().backward()
        optimiser.step()
    found = start + (scale * step).detach().numpy()
    assert np.abs(found - truth)[3:5].max() < 2e-4
    assert abs(found[5] - truth[5]) < 1e-3
