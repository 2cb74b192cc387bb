"""The loss of a candidate state against a frame (Hu et al. 2026, eq. 5, 6, 8 and 15)."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from surgbench.contract import Observation, Scene
from surgbench.geometry import FloatArray
from surgbench.silhouette import KeypointProjector, Reference, SilhouetteEvaluator, iou

if TYPE_CHECKING:
    from surgbench.silhouette.torch_evaluator import TorchSilhouetteEvaluator

Weight = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class LossWeights(BaseModel):
    """Weights of the loss, relative to the number N of the image's pixels.

    So they mean the same at any resolution; the defaults are those of the paper's released code, whose loss
    is the mean, not the sum, over pixels.

    Attributes:
        appearance: lambda_app / N.
        keypoints: lambda_kpts / N, per pixel of distance.
        keypoint_tolerance_px: tau, distance that costs nothing.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    appearance: Annotated[Weight, Field(description="lambda_app of eq. 6, per pixel of the image")] = 1e-6
    keypoints: Annotated[Weight, Field(description="lambda_kpts of eq. 5, per pixel of the image")] = 5e-4
    keypoint_tolerance_px: Annotated[Weight, Field(description="tau of eq. 8")] = 10.0


def keypoint_loss(observed_px: FloatArray, projected_px: FloatArray, tolerance_px: float) -> FloatArray:
    """Distance of projected tips from observed ones, eq. 8.

    Args:
        observed_px: ``(2, 2)`` in no particular order.
        projected_px: ``(..., 2, 2)``; NaN for tips behind the camera.
        tolerance_px: tau; each distance counts only by what it exceeds tau.

    Returns:
        ``(...)`` pixels; infinite where a tip lies behind the camera.
    """

    def excess(difference: FloatArray) -> FloatArray:
        distance = np.linalg.norm(difference, axis=-1)
        return np.asarray(np.maximum(distance - tolerance_px, 0.0))

    straight = excess(projected_px - observed_px).sum(axis=-1)
    swapped = excess(projected_px - observed_px[::-1]).sum(axis=-1)
    centre = excess(projected_px.mean(axis=-2) - observed_px.mean(axis=-2))
    loss = np.minimum(straight, swapped) + centre
    return np.where(np.isnan(loss), np.inf, loss)


def keypoint_slope(observed_px: FloatArray, projected_px: FloatArray, tolerance_px: float) -> FloatArray:
    """Derivative of :func:`keypoint_loss` with respect to the projected tips.

    Args:
        observed_px: ``(2, 2)`` in no particular order.
        projected_px: ``(..., 2, 2)``; NaN for tips behind the camera.
        tolerance_px: tau.

    Returns:
        ``(..., 2, 2)``; zero for tips within the tolerance or behind the camera.
    """

    def direction(difference: FloatArray) -> FloatArray:
        distance = np.linalg.norm(difference, axis=-1, keepdims=True)
        beyond = distance > tolerance_px  # false for NaN
        return np.where(beyond, difference / np.where(beyond, distance, 1.0), 0.0)

    straight, swapped = projected_px - observed_px, projected_px - observed_px[::-1]

    def total(difference: FloatArray) -> FloatArray:
        excess = np.linalg.norm(difference, axis=-1) - tolerance_px
        return np.asarray(np.maximum(excess, 0.0).sum(axis=-1))

    nearer = (total(straight) <= total(swapped))[..., None, None]
    centre = projected_px.mean(axis=-2, keepdims=True) - observed_px.mean(axis=-2)
    return np.asarray(direction(np.where(nearer, straight, swapped)) + direction(centre) / 2)


def _evaluator(scene: Scene) -> SilhouetteEvaluator | TorchSilhouetteEvaluator:
    camera = scene.views[0].camera
    if scene.device == "cpu":
        return SilhouetteEvaluator(scene.instruments, camera)
    from surgbench.silhouette.torch_evaluator import TorchSilhouetteEvaluator

    return TorchSilhouetteEvaluator(scene.instruments, camera, device=scene.device)


class Objective:
    """Scores candidate states against one frame at a time.

    Args:
        scene: Instruments, reference camera, and the device to score on.
        weights: Of the terms.

    Raises:
        ConfigError: The scene's device is not there.
    """

    def __init__(self, scene: Scene, weights: LossWeights) -> None:
        self.scene = scene
        self.camera = scene.views[0].camera
        self.evaluator = _evaluator(scene)
        self._projector = KeypointProjector(scene.instruments, self.camera)
        pixels = self.camera.width * self.camera.height
        self._appearance = weights.appearance * pixels
        self._keypoints = weights.keypoints * pixels
        self._tolerance_px = weights.keypoint_tolerance_px
        self._reference: Reference | None = None
        self._observed: tuple[FloatArray | None, ...] = ()

    def observe(self, observation: Observation) -> None:
        """Take the frame that the next calls score against."""
        view = observation.views[0]
        self._reference = Reference(view.mask)
        self._observed = view.keypoints

    def mismatch(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The rendering loss (eq. 6) of ``(n, 9 * arms)`` states, pixels, and their overlap with the mask.

        Raises:
            RuntimeError: No frame has been observed.
        """
        reference = self._seen()
        area, overlap = self.evaluator.sum_over(states, reference)
        observed = reference.area
        loss = area + observed - 2 * overlap + self._appearance * np.abs(area - observed)
        return np.asarray(loss, dtype=np.float64), iou(area, overlap, observed)

    def __call__(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Losses and overlaps of candidates (eq. 5 and 15).

        Args:
            states: ``(n, 9 * arms)``.

        Returns:
            ``(n,)`` losses in pixels and ``(n,)`` intersection over union with the observed mask.

        Raises:
            RuntimeError: No frame has been observed.
        """
        loss, overlap = self.mismatch(states)
        if self._keypoints > 0 and any(observed is not None for observed in self._observed):
            tips = self._projector.project(states)
            for arm, observed in enumerate(self._observed):
                if observed is not None:
                    loss = loss + self._keypoints * keypoint_loss(observed, tips[:, arm], self._tolerance_px)
        return loss, overlap

    def gradient(self, states: FloatArray) -> FloatArray:
        """Derivative of the losses (eq. 5) with respect to the candidates.

        Of the pixel counts it is that of the area integrals behind them, on the CPU whatever the scene's device.

        Args:
            states: ``(n, 9 * arms)``.

        Returns:
            ``(n, 9 * arms)`` pixels per radian or metre.

        Raises:
            RuntimeError: No frame has been observed.
        """
        gradient = self.mismatch_gradient(states)
        if self._keypoints > 0 and any(observed is not None for observed in self._observed):
            tips = self._projector.project(states)
            forces = np.zeros_like(tips)
            for arm, observed in enumerate(self._observed):
                if observed is not None:
                    forces[:, arm] = keypoint_slope(observed, tips[:, arm], self._tolerance_px)
            gradient = gradient + self._keypoints * self._projector.pull_back(states, forces)
        return gradient

    def mismatch_gradient(self, states: FloatArray) -> FloatArray:
        """Derivative of the rendering loss (eq. 6), ``(n, 9 * arms)`` pixels per radian or metre.

        Raises:
            RuntimeError: No frame has been observed.
        """
        reference = self._seen()
        area, _ = self.evaluator.sum_over(states, reference)
        slope = self._differentiable.gradient(states, reference)
        excess = np.sign(area - reference.area)[:, None]
        gradient: FloatArray = slope.area - 2 * slope.overlap + self._appearance * excess * slope.area
        return gradient

    def _seen(self) -> Reference:
        if self._reference is None:
            raise RuntimeError("observe a frame before scoring candidates")
        return self._reference

    @cached_property
    def _differentiable(self) -> SilhouetteEvaluator:
        if isinstance(self.evaluator, SilhouetteEvaluator):
            return self.evaluator
        return SilhouetteEvaluator(self.scene.instruments, self.camera)
