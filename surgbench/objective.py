"""The loss of a candidate state against a frame (Hu et al. 2026, eq. 5, 6, 8 and 15)."""

from __future__ import annotations

import functools
import operator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from surgbench.camera import Camera
from surgbench.camera.change_of_view import ChangeOfView
from surgbench.config import Section
from surgbench.contract import Observation, Scene, View
from surgbench.geometry import FloatArray
from surgbench.keypoints.found import Tips
from surgbench.silhouette import KeypointProjector, Reference, SilhouetteEvaluator, iou

if TYPE_CHECKING:
    from surgbench.silhouette.torch_evaluator import TorchSilhouetteEvaluator

Weight = Annotated[float, Field(ge=0, allow_inf_nan=False)]


# Pixels of the pictures that the released code of Hu et al. 2026 renders and measures in.
RELEASED_PIXELS = 350 * 246


class LossWeights(Section):
    """Weights of the loss, which mean the same at any resolution.

    The defaults are those of the paper's released code. That takes means over pixels, ``6 MSE + 6e-6 |difference of
    areas| + 3e-3 L_kpts`` at 350 x 246; here these are sums.

    Attributes:
        appearance: lambda_app, pixels of mismatch that a pixel of difference in area is worth.
        keypoints: lambda_kpts / N of N pixels, per pixel of distance.
        keypoint_tolerance_px: tau, distance that costs nothing.
        keypoint_form: See :class:`KeypointTerm`.
        single_tips: Whether a tip counts where the other was not found; not as published.

    Example:
        >>> from surgbench.objective import LossWeights
        >>> masks_alone = LossWeights(keypoints=0.0)
        >>> masks_alone.appearance, masks_alone.keypoint_tolerance_px
        (0.0861, 10.0)
    """

    appearance: Annotated[Weight, Field(description="lambda_app of eq. 6")] = 0.0861
    keypoints: Annotated[Weight, Field(description="lambda_kpts of eq. 5, per pixel of the image")] = 5e-4
    keypoint_tolerance_px: Annotated[Weight, Field(description="tau of eq. 8")] = 10.0
    keypoint_form: Annotated[
        Literal["printed", "released"],
        Field(description="eq. 8, or what the paper's code has: L1, tau once for both tips, pixels of 350 x 246"),
    ] = "printed"
    single_tips: Annotated[bool, Field(description="a tip counts where the other was not found, too")] = False


@dataclass(frozen=True)
class KeypointTerm:
    """Distance of projected tips from observed ones: eq. 8, or what the paper's released code computes in its place.

    ``printed`` is eq. 8: Euclidean distances, each of which counts by what it exceeds tau. ``released`` takes sums of
    the absolute differences in u and v instead, and tau off the sum over both tips; the centre has a tau of its own in
    both.

    Attributes:
        tolerance_px: tau.
        form: ``printed`` or ``released``.

    Example:
        In place, in place but the other way round, and 15 px too low, which is 5 px too much for both tips and for
        their centre; in the released form 20 for both together, and 5:

        >>> import numpy as np
        >>> from surgbench.objective import KeypointTerm
        >>> observed = np.array([[80.0, 60.0], [100.0, 60.0]])
        >>> KeypointTerm(10.0).loss(observed, np.stack([observed, observed[::-1], observed + [0, 15]]))
        array([ 0.,  0., 15.])
        >>> KeypointTerm(10.0, "released").loss(observed, np.stack([observed, observed[::-1], observed + [0, 15]]))
        array([ 0.,  0., 25.])
    """

    tolerance_px: float
    form: Literal["printed", "released"] = "printed"

    def loss(self, observed_px: FloatArray, projected_px: FloatArray) -> FloatArray:
        """The distance.

        Args:
            observed_px: ``(2, 2)`` in no particular order; or ``(1, 2)``, which may be either tip: then what the nearer
                one exceeds tau by counts alone.
            projected_px: ``(..., 2, 2)``; NaN for tips behind the camera.

        Returns:
            ``(...)`` pixels; infinite where a tip lies behind the camera.
        """
        if len(observed_px) == 1:
            single = self._excess(self._length(projected_px - observed_px)).min(axis=-1)  # NaN if one is
            return np.where(np.isnan(single), np.inf, single)
        straight = self._both(projected_px - observed_px)
        swapped = self._both(projected_px - observed_px[::-1])
        centre = self._excess(self._length(projected_px.mean(axis=-2) - observed_px.mean(axis=-2)))
        loss = np.minimum(straight, swapped) + centre
        return np.where(np.isnan(loss), np.inf, loss)

    def slope(self, observed_px: FloatArray, projected_px: FloatArray) -> FloatArray:
        """Derivative of :meth:`loss` with respect to the projected tips.

        Args:
            observed_px: ``(2, 2)`` in no particular order, or ``(1, 2)``.
            projected_px: ``(..., 2, 2)``; NaN for tips behind the camera.

        Returns:
            ``(..., 2, 2)``; zero for tips within the tolerance or behind the camera.
        """
        if len(observed_px) == 1:
            single = projected_px - observed_px
            length = self._length(single)
            # With a tip behind the camera, that one (NaN), whose slope is zero.
            counts = (length.argmin(axis=-1)[..., None] == np.arange(2)) & (length > self.tolerance_px)
            return np.where(counts[..., None], self._direction(single), 0.0)
        straight, swapped = projected_px - observed_px, projected_px - observed_px[::-1]
        nearer = (self._both(straight) <= self._both(swapped))[..., None, None]
        tips = np.where(nearer, straight, swapped)
        length = self._length(tips)[..., None]
        if self.form == "released":
            length = length.sum(axis=-2, keepdims=True)
        centre = projected_px.mean(axis=-2, keepdims=True) - observed_px.mean(axis=-2)
        # Half, for each of the two tips moves their centre by half as much. Comparisons are false for NaN.
        return np.asarray(
            np.where(length > self.tolerance_px, self._direction(tips), 0.0)
            + np.where(self._length(centre)[..., None] > self.tolerance_px, self._direction(centre), 0.0) / 2
        )

    def _length(self, difference: FloatArray) -> FloatArray:
        order = 2 if self.form == "printed" else 1
        length: FloatArray = np.linalg.norm(difference, ord=order, axis=-1)
        return length

    def _direction(self, difference: FloatArray) -> FloatArray:
        """Derivative of the length."""
        if self.form == "released":
            return np.sign(difference)
        length = np.linalg.norm(difference, axis=-1, keepdims=True)
        return np.asarray(difference / np.where(length > 0, length, 1.0))

    def _excess(self, length: FloatArray) -> FloatArray:
        return np.asarray(np.maximum(length - self.tolerance_px, 0.0))

    def _both(self, difference: FloatArray) -> FloatArray:
        """Of both tips ``(..., 2, 2)`` together."""
        length = self._length(difference)
        if self.form == "released":
            return self._excess(length.sum(axis=-1))
        return np.asarray(self._excess(length).sum(axis=-1))


def _evaluator(scene: Scene, camera: Camera) -> SilhouetteEvaluator | TorchSilhouetteEvaluator:
    if scene.device == "cpu":
        return SilhouetteEvaluator(scene.instruments, camera)
    from surgbench.silhouette.torch_evaluator import TorchSilhouetteEvaluator

    return TorchSilhouetteEvaluator(scene.instruments, camera, device=scene.device)


class ViewLoss:
    """The terms of one view. States are given, and derivatives returned, in the reference camera's frame.

    Args:
        scene: Instruments, and the device to score on.
        camera: The view's.
        weights: Of the terms.

    Attributes:
        evaluator: Counts silhouettes of states of the view's own frame.
        appearance: lambda_app of eq. 6.
    """

    def __init__(self, scene: Scene, camera: Camera, weights: LossWeights) -> None:
        self.camera = camera
        self.evaluator = _evaluator(scene, camera)
        self._instruments = scene.instruments
        self._projector = KeypointProjector(scene.instruments, camera)
        pixels = camera.width * camera.height
        self.appearance = weights.appearance
        released = weights.keypoint_form == "released"
        # Pixels of the image that a pixel of distance is: the released code measures in its own, smaller pictures.
        pixel = float(np.sqrt(pixels / RELEASED_PIXELS)) if released else 1.0
        self._keypoints = weights.keypoints * pixels / pixel
        self._single_tips = weights.single_tips
        self._term = KeypointTerm(weights.keypoint_tolerance_px * pixel, weights.keypoint_form)
        self._reference: Reference | None = None
        self._view: View | None = None
        self.change = ChangeOfView(np.eye(4))

    def observe(self, view: View) -> None:
        """Take the frame that the next calls score against."""
        self._reference = None
        self._view = view
        self.change = ChangeOfView(view.T_view_cam)

    @property
    def reference(self) -> Reference:
        """The observed mask.

        Raises:
            RuntimeError: No frame has been observed.
        """
        if self._view is None:
            raise RuntimeError("observe a frame before scoring candidates")
        if self._reference is None:  # arms that have masks of their own do without
            self._reference = Reference(self._view.mask)
        return self._reference

    @property
    def _observed(self) -> Tips:
        """The tips that count. Looking at them may ask a detector, which terms without tips need not wait for."""
        if self._view is None or self._keypoints == 0:
            return ()
        return self._view.tips if self._single_tips else self._view.keypoints

    @property
    def has_keypoints(self) -> bool:
        """Whether keypoints were seen, and weigh anything."""
        return any(observed is not None for observed in self._observed)

    def mismatch(self, states: FloatArray) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64]]:
        """Eq. 6 of ``(n, 9 * arms)`` states, pixels; and how many pixels they cover, and cover of the mask."""
        observed = self.reference.area
        area, overlap = self.evaluator.sum_over(self.change.states(states), self.reference)
        # Squared differences of binary images: one for each pixel that is in one of the masks only.
        loss = area + observed - 2 * overlap + self.appearance * np.abs(area - observed)
        return np.asarray(loss, dtype=np.float64), area, overlap

    def keypoints(self, states: FloatArray) -> dict[int, FloatArray]:
        """Eq. 8 with its weight, ``(n,)`` pixels for each arm whose tips were seen."""
        tips = self._projector.project(self.change.states(states))
        return {
            arm: self._keypoints * self._term.loss(observed, tips[:, arm])
            for arm, observed in enumerate(self._observed)
            if observed is not None
        }

    def keypoints_gradient(self, states: FloatArray) -> FloatArray:
        """Derivative of the sum of :meth:`keypoints`, ``(n, 9 * arms)``."""
        own = self.change.states(states)
        tips = self._projector.project(own)
        forces = np.zeros_like(tips)
        for arm, observed in enumerate(self._observed):
            if observed is not None:
                forces[:, arm] = self._term.slope(observed, tips[:, arm])
        return self.change.pull_back(states, self._keypoints * self._projector.pull_back(own, forces))

    @cached_property
    def differentiable(self) -> SilhouetteEvaluator:
        """An evaluator on the CPU."""
        if isinstance(self.evaluator, SilhouetteEvaluator):
            return self.evaluator
        return SilhouetteEvaluator(self._instruments, self.camera)


class Objective:
    """Scores candidate states against one frame at a time, in all of its views together.

    The loss is the sum of every view's eq. 5, in pixels of that view. The overlap is the intersection in all views over
    the union in all views.

    Args:
        scene: Instruments, cameras, and the device to score on.
        weights: Of the terms.

    Attributes:
        views: The terms of each view, in the scene's order.

    Raises:
        ConfigError: The scene's device is not there.

    Example:
        Two candidates against the second frame of a sequence: where the instrument is, and where it was before.

        >>> from surgbench.tasks.instrument.conformance.scenes import make_play
        >>> from surgbench.objective import LossWeights, Objective
        >>> play = make_play()  # a needle driver in slow motion: scene, observations, true states
        >>> objective = Objective(play.scene, LossWeights())
        >>> objective.observe(play.observations[1])
        >>> losses, overlaps = objective(play.truth[[1, 0]])
        >>> float(losses[0]), float(overlaps[0])
        (0.0, 1.0)
        >>> bool(losses[1] > 100)  # pixels
        True
        >>> objective.gradient(play.truth[[1, 0]]).shape  # pixels per radian or metre
        (2, 9)
    """

    def __init__(self, scene: Scene, weights: LossWeights) -> None:
        self.scene = scene
        self.views = tuple(ViewLoss(scene, view.camera, weights) for view in scene.views)
        self.camera = self.views[0].camera
        self.evaluator = self.views[0].evaluator

    def observe(self, observation: Observation) -> None:
        """Take the frame that the next calls score against.

        Raises:
            ValueError: It has not the scene's number of views.
        """
        for own, view in zip(self.views, observation.views, strict=True):
            own.observe(view)

    def mismatch(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The rendering loss (eq. 6) of ``(n, 9 * arms)`` states, pixels, and their overlap with the masks.

        Raises:
            RuntimeError: No frame has been observed.
        """
        parts = [view.mismatch(states) for view in self.views]
        loss, area, overlap = (functools.reduce(operator.add, one) for one in zip(*parts, strict=True))
        return loss, iou(area, overlap, sum(view.reference.area for view in self.views))

    def __call__(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Losses and overlaps of candidates (eq. 5 and 15).

        Args:
            states: ``(n, 9 * arms)``.

        Returns:
            ``(n,)`` losses in pixels and ``(n,)`` intersection over union with the observed masks.

        Raises:
            RuntimeError: No frame has been observed.
        """
        loss, overlap = self.mismatch(states)
        for view in self.views:
            if view.has_keypoints:
                for part in view.keypoints(states).values():
                    loss = loss + part
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
        for view in self.views:
            if view.has_keypoints:
                gradient = gradient + view.keypoints_gradient(states)
        return gradient

    def mismatch_gradient(self, states: FloatArray) -> FloatArray:
        """Derivative of the rendering loss (eq. 6), ``(n, 9 * arms)`` pixels per radian or metre.

        Raises:
            RuntimeError: No frame has been observed.
        """
        parts = [
            view.change.pull_back(states, self._view_gradient(place, view.change.states(states)))
            for place, view in enumerate(self.views)
        ]
        return functools.reduce(operator.add, parts)

    def _view_gradient(self, place: int, states: FloatArray) -> FloatArray:
        """Derivative of one view's eq. 6 with respect to states of that view's own frame."""
        view = self.views[place]
        reference = view.reference
        area, _ = view.evaluator.sum_over(states, reference)
        slope = view.differentiable.gradient(states, reference)
        excess = np.sign(area - reference.area)[:, None]
        gradient: FloatArray = slope.area - 2 * slope.overlap + view.appearance * excess * slope.area
        return gradient
