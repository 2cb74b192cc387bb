"""Robust Gauss-Newton of a state against the contour of an observed mask, the tips, and a prior."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from surgbench.contract import Observation, Scene
from surgbench.geometry import FloatArray
from surgbench.silhouette import ContourPoints, KeypointProjector, SilhouetteEvaluator
from surgbench.state import clip_joints
from surgbench.trackers.registration.edges import explained_contour, find_edges, normal_equations

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
FEWEST_POINTS = 8
LONGEST_STEP = 4.0  # natural steps
SETTLED = 0.02  # natural steps
NARROWING = 0.6  # of the robust width, from one iteration to the next
EXPLAINED_PX = 2.0


class FitConfig(BaseModel):
    """Options of the contour fit."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    iterations: Annotated[int, Field(ge=1, description="Gauss-Newton steps at most")] = 6
    spacing_px: Annotated[int, Field(ge=1, description="rows and columns from one contour point to the next")] = 1
    reach_px: Annotated[int, Field(ge=1, description="how far edges are looked for")] = 14
    edge_px: Annotated[Positive, Field(description="standard deviation of an edge, for one pixel of contour")] = 1.5
    width_px: Annotated[Positive, Field(description="offsets beyond it count ever less (Geman-McClure)")] = 2.0
    offset_px: Annotated[Positive, Field(description="standard deviation of the offset common to all edges")] = 0.5
    tip_px: Annotated[Positive, Field(description="standard deviation of a tip keypoint")] = 3.0


class Fit(NamedTuple):
    """Where a fit ended.

    Attributes:
        state: ``(n,)``.
        information: ``(n, n)`` what the frame says of the state, natural steps, without the prior.
        offset_px: Of all edges together: above 0 where the mask is dilated.
        explained: Share of the predicted contour that has an observed edge.
    """

    state: FloatArray
    information: FloatArray
    offset_px: float
    explained: float


@dataclass(frozen=True)
class Prior:
    """A Gaussian prior: ``(n,)`` mean, and ``(n, n)`` information in natural steps."""

    mean: FloatArray
    information: FloatArray


class ContourFit:
    """Fits states of a scene to masks, one frame at a time.

    Args:
        scene: Instruments, camera, limits.
        evaluator: Of the scene.
        scale: ``(n,)`` natural step of each component.
        config: Options.
    """

    def __init__(self, scene: Scene, evaluator: SilhouetteEvaluator, scale: FloatArray, config: FitConfig) -> None:
        self._limits = scene.joint_limits
        self._evaluator = evaluator
        self._projector = KeypointProjector(scene.instruments, scene.views[0].camera)
        self._scale = scale
        self._config = config

    def __call__(
        self,
        state: FloatArray,
        observation: Observation,
        prior: Prior,
        *,
        iterations: int | None = None,
        spacing_px: int | None = None,
    ) -> Fit:
        """Minimise robust edge offsets, tip distances and the prior's Mahalanobis distance, from ``state`` on.

        Args:
            state: ``(n,)`` where to begin.
            observation: Mask and keypoints of the reference view.
            prior: What is believed before.
            iterations: Instead of the configured number.
            spacing_px: Instead of the configured one.
        """
        config, scale = self._config, self._scale
        n = len(state)
        fit = Fit(state, np.zeros((n, n)), 0.0, 1.0)
        width: float | None = None
        for _ in range(iterations or config.iterations):
            contour = self._evaluator.contour_points(fit.state, spacing_px or config.spacing_px)
            A, b, width, explained = self._edges(contour, observation, fit.offset_px, width)
            self._add_tips(A, b, fit.state, observation)
            A[n, n] += 1.0 / config.offset_px**2
            # The common offset is eliminated: it is of no interest.
            information = A[:n, :n] - np.outer(A[:n, n], A[n, :n]) / A[n, n]
            pull = b[:n] - A[:n, n] * (b[n] / A[n, n]) + prior.information @ ((prior.mean - fit.state) / scale)
            step = np.linalg.solve(information + prior.information, pull)
            offset = float((b[n] - A[n, :n] @ step) / A[n, n])
            longest = float(np.abs(step).max())
            step *= min(1.0, LONGEST_STEP / max(longest, LONGEST_STEP))
            moved = clip_joints(fit.state + step * scale, self._limits)
            fit = Fit(moved, information, offset, explained)
            width = max(config.width_px, NARROWING * width)
            if longest < SETTLED:
                break
        return fit

    def _edges(
        self, contour: ContourPoints, observation: Observation, offset_px: float, width: float | None
    ) -> tuple[FloatArray, FloatArray, float, float]:
        """Normal equations of the edges, the robust width they were weighted with, and the share that is explained."""
        config = self._config
        offsets = find_edges(contour, observation.mask, config.reach_px)
        found = offsets[~np.isnan(offsets)]
        if len(found) < FEWEST_POINTS:
            size = len(self._scale) + 1
            return np.zeros((size, size)), np.zeros(size), config.width_px, 0.0
        if width is None:
            # Twice what the median of absolute deviations makes of the standard deviation.
            width = max(config.width_px, 2.0 * 1.4826 * float(np.median(np.abs(found))))
        A, b = normal_equations(offsets, contour, self._scale, width)
        variance = config.edge_px**2
        return A / variance, b / variance, width, explained_contour(contour, offsets, offset_px, EXPLAINED_PX)

    def _add_tips(self, A: FloatArray, b: FloatArray, state: FloatArray, observation: Observation) -> None:
        """Add the tips' part to the normal equations, in place; each tip goes with the nearer way round."""
        n, sd = len(state), self._config.tip_px
        seen = [(arm, tips) for arm, tips in enumerate(observation.views[0].keypoints) if tips is not None]
        if not seen:
            return
        projected = self._projector.project(state[None])[0]
        for arm, tips in seen:
            off = min((tips - projected[arm], tips[::-1] - projected[arm]), key=lambda way: float((way**2).sum()))
            if not np.isfinite(off).all():  # behind the camera
                continue
            forces = np.zeros((4, len(projected), 2, 2))
            forces[:, arm] = np.eye(4).reshape(4, 2, 2)
            J = self._projector.pull_back(np.tile(state, (4, 1)), forces) * self._scale
            distance = np.linalg.norm(off, axis=1).repeat(2)
            weight = 1.0 / (sd * (1.0 + (distance / (3.0 * sd)) ** 2)) ** 2
            A[:n, :n] += (J * weight[:, None]).T @ J
            b[:n] += (J * weight[:, None]).T @ off.reshape(4)
