"""The areas and tips as differentiable functions of PyTorch tensors.

The numbers come from the CPU engine in float64; tensors on another device are copied there and back.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from surgbench.silhouette.evaluator import Reference, SilhouetteEvaluator
from surgbench.silhouette.keypoints import KeypointProjector


class _Areas(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, states: Tensor, evaluator: SilhouetteEvaluator, reference: Reference
    ) -> tuple[Tensor, Tensor]:
        ctx.evaluator, ctx.reference = evaluator, reference
        ctx.save_for_backward(states)
        score = evaluator.score(states.detach().cpu().numpy(), reference)
        return torch.from_numpy(score.area).to(states), torch.from_numpy(score.overlap).to(states)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor, None, None]:
        (states,) = ctx.saved_tensors
        gradient = ctx.evaluator.gradient(states.detach().cpu().numpy(), ctx.reference)
        area, overlap = (torch.from_numpy(part).to(states) for part in gradient)
        return slopes[0][:, None] * area + slopes[1][:, None] * overlap, None, None


class _Tips(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, states: Tensor, projector: KeypointProjector) -> Tensor:
        ctx.projector = projector
        ctx.save_for_backward(states)
        return torch.from_numpy(projector.project(states.detach().cpu().numpy())).to(states)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor, None]:
        (states,) = ctx.saved_tensors
        pulled = ctx.projector.pull_back(states.detach().cpu().numpy(), slopes[0].detach().cpu().numpy())
        return torch.from_numpy(pulled).to(states), None


def _check(states: Tensor) -> None:
    if not isinstance(states, Tensor) or states.dtype not in (torch.float32, torch.float64):
        kind = states.dtype if isinstance(states, Tensor) else type(states).__name__
        raise TypeError(f"states must be a tensor of float32 or float64, got {kind}")


def areas(states: Tensor, evaluator: SilhouetteEvaluator, reference: Reference) -> tuple[Tensor, Tensor]:
    """Pixels covered, and covered inside the reference mask, with the gradient of the area integrals behind them.

    Args:
        states: ``(N, 9 * arms)`` float32 or float64.
        evaluator: Of the instruments and the camera.
        reference: Mask of the camera's size.

    Returns:
        ``(N,)`` area and ``(N,)`` overlap in pixels, of the states' type and device: the exact counts of
        :meth:`SilhouetteEvaluator.score`, whose gradient is that of :meth:`SilhouetteEvaluator.gradient`.

    Example:
        The shaft of :class:`SilhouetteEvaluator`, which loses 16 pixels a millimetre that it goes away:

        >>> import numpy as np
        >>> import torch
        >>> from surgbench.camera import Camera
        >>> from surgbench.instrument import load_instrument
        >>> from surgbench.silhouette import Reference, SilhouetteEvaluator
        >>> from surgbench.silhouette.autograd import areas
        >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
        >>> evaluator = SilhouetteEvaluator([load_instrument("large_needle_driver")], camera)
        >>> states = torch.tensor([[0, 0, np.pi / 2, 0.08, 0, 0.13, 0, 0, 0]], requires_grad=True)
        >>> area, _ = areas(states, evaluator, Reference(np.ones((120, 160), dtype=bool)))
        >>> area.sum().backward()
        >>> area.item(), round(states.grad[0, 5].item() / 1000)
        (2080.0, -16)
    """
    _check(states)
    area, overlap = _Areas.apply(states, evaluator, reference)
    return area, overlap


def tips(states: Tensor, projector: KeypointProjector) -> Tensor:
    """Projected tips, ``(N, arms, 2, 2)`` pixels, of ``(N, 9 * arms)`` states; NaN behind the camera."""
    _check(states)
    places: Tensor = _Tips.apply(states, projector)
    return places
