"""Robust Gauss-Newton of a state against the contour of an observed mask, the tips, and a prior."""

from __future__ import annotations

import functools
import operator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from surgbench.contract import Observation, Scene
from surgbench.geometry import FloatArray
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.state import clip_joints
from surgbench.trackers.registration.shape import Shape
from surgbench.trackers.registration.view_fit import FitConfig, ViewFit

LONGEST_STEP = 4.0  # natural steps
SETTLED = 0.02  # natural steps
CERTAIN = 1e9  # information, natural steps


class Fit(NamedTuple):
    """Where a fit ended.

    Attributes:
        state: ``(n,)``.
        shape: ``(m,)`` what instruments and camera are other in than declared (:class:`Shape`).
        information: ``(n + m, n + m)`` what the frame says of both, natural steps, without the prior.
        offset_px: Of all edges of the reference view together: above 0 where its mask is dilated.
        explained: Share of the predicted contours that have an observed edge.
        missed_px: ``(arms, links)`` length of each link's contour in the reference view that has no observed edge.
        length_px: ``(arms, links)`` all of it.
    """

    state: FloatArray
    shape: FloatArray
    information: FloatArray
    offset_px: float
    explained: float
    missed_px: FloatArray
    length_px: FloatArray


@dataclass(frozen=True)
class Prior:
    """A Gaussian prior of state and shape: ``(n + m,)`` mean, and ``(n + m, n + m)`` information in natural steps."""

    mean: FloatArray
    information: FloatArray


class ContourFit:
    """Fits states of a scene to masks, one frame at a time, in all of the scene's views together.

    Args:
        scene: Instruments, cameras, limits.
        evaluator: Of the scene's reference view.
        scale: ``(n,)`` natural step of each component.
        config: Options.

    Attributes:
        shape: What instruments and camera may be other in than declared.
    """

    def __init__(self, scene: Scene, evaluator: SilhouetteEvaluator, scale: FloatArray, config: FitConfig) -> None:
        self._limits = scene.joint_limits
        self.shape = Shape(scene.instruments)
        self._scale = np.concatenate([scale, self.shape.scale])
        self._config = config
        self._frame = -1
        self._views = [ViewFit(scene.instruments, evaluator, scale, self.shape, config, calibrated=True)]
        for view in scene.views[1:]:
            other = SilhouetteEvaluator(scene.instruments, view.camera)
            self._views.append(ViewFit(scene.instruments, other, scale, self.shape, config, calibrated=False))

    @property
    def misfit_px(self) -> float:
        """What the reference view's edges were wrong by in the frames so far, beyond the pixel grid."""
        misfit_px: float = self._views[0].misfit_px
        return misfit_px

    def __call__(
        self,
        state: FloatArray,
        observation: Observation,
        prior: Prior,
        *,
        iterations: int | None = None,
        spacing_px: int | None = None,
        tips: bool = True,
        learn: bool = True,
    ) -> Fit:
        """Minimise robust edge offsets, tip distances and the prior's Mahalanobis distance, from ``state`` on.

        Args:
            state: ``(n,)`` where to begin.
            observation: Masks and keypoints of the scene's views.
            prior: What is believed before. One of the state alone takes instruments and camera to be as declared.
            iterations: Instead of the configured number.
            spacing_px: Instead of the configured one.
            tips: Fit to the tips too. Without, no view's tips are looked at, and no detector is waited for.
            learn: Keep, of a frame's first fit, how wrong edges and further views' poses are, for the frames to come.
        """
        config, scale = self._config, self._scale
        n = len(state)
        if len(prior.mean) == n:
            known = np.diag(np.full(len(self.shape.scale), CERTAIN))
            prior = Prior(np.append(prior.mean, np.zeros(len(known))), block_diag(prior.information, known))
        fit = Fit(state, prior.mean[n:], np.zeros_like(prior.information), 0.0, 1.0, np.zeros((0, 0)), np.zeros((0, 0)))
        # Of a frame's fits the first is that of the story that was the best so far.
        first, self._frame = observation.index != self._frame, observation.index
        for own, view in zip(self._views, observation.views, strict=True):
            if first:
                own.next_frame()
            own.begin(view, tips=tips)
        for _ in range(iterations or config.iterations):
            parts = [own.equations(fit.state, fit.shape, spacing_px or config.spacing_px) for own in self._views]
            information = functools.reduce(operator.add, (part.information for part in parts))
            pull = functools.reduce(operator.add, (part.pull for part in parts))
            pull = pull + prior.information @ ((prior.mean - np.concatenate([fit.state, fit.shape])) / scale)
            step = np.linalg.solve(information + prior.information, pull)
            for own in self._views:
                own.follow(step)
            longest = float(np.abs(step[:n]).max())
            step *= min(1.0, LONGEST_STEP / max(longest, LONGEST_STEP))
            moved = clip_joints(fit.state + step[:n] * scale[:n], self._limits)
            total = sum(part.length_px for part in parts)
            explained = sum(part.explained_px for part in parts) / total if total > 0 else 0.0
            shape = fit.shape + step[n:] * scale[n:]
            fit = fit._replace(state=moved, shape=shape, information=information, explained=explained)
            if longest < SETTLED:
                break
        if first and learn:
            for own, part in zip(self._views, parts, strict=True):
                own.learn(information + prior.information - part.information)
        missed_px, length_px = self._views[0].missed()
        return fit._replace(offset_px=self._views[0].offset_px, missed_px=missed_px, length_px=length_px)
