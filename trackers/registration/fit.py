"""Robust Gauss-Newton of a state against the contour of an observed mask, the tips, and a prior."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from surgbench.contract import Observation, Scene
from surgbench.geometry import FloatArray
from surgbench.silhouette import SilhouetteEvaluator
from surgbench.state import clip_joints
from surgbench.trackers.registration.shape import Shape
from surgbench.trackers.registration.view_fit import Equations, FitConfig, ViewFit

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
        config = self._config
        fit, prior, first = self.begin(state, observation, prior, tips=tips)
        for _ in range(iterations or config.iterations):
            parts = [own.equations(fit.state, fit.shape, spacing_px or config.spacing_px) for own in self._views]
            information = functools.reduce(operator.add, (part.information for part in parts))
            pull = functools.reduce(operator.add, (part.pull for part in parts))
            pull = pull + self.pull_of(prior, fit)
            step = np.linalg.solve(information + prior.information, pull)
            for own in self._views:
                own.follow(step)
            fit, longest = self.moved(fit, step, parts)
            fit = fit._replace(information=information)
            if longest < SETTLED:
                break
        if first and learn:
            for own, part in zip(self._views, parts, strict=True):
                own.learn(information + prior.information - part.information)
        return self.with_lengths(fit)

    def begin(
        self, state: FloatArray, observation: Observation, prior: Prior, *, tips: bool
    ) -> tuple[Fit, Prior, bool]:
        """Begin a fit: where it stands, what is believed of state and shape, and whether it is the frame's first."""
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
        return fit, prior, first

    def equations(self, fit: Fit, spacing_px: int, *, shared: bool) -> list[Equations]:
        """Of every view; with ``shared`` the offset of the first one's edges is not eliminated."""
        return [
            own.equations(fit.state, fit.shape, spacing_px, shared=shared and k == 0)
            for k, own in enumerate(self._views)
        ]

    def follow(self, step: FloatArray, offset_px: float | None) -> None:
        """Adjust the views' own unknowns, after :meth:`equations`."""
        for k, own in enumerate(self._views):
            own.follow(step if k or offset_px is None else np.append(step, offset_px))

    def learn(self, parts: Sequence[Equations], known: FloatArray) -> None:
        """Keep what the fit says of edges and of further views' poses, for the frames to come."""
        for k, (own, part) in enumerate(zip(self._views, parts, strict=True)):
            own.learn(known if k == 0 else known - part.information)

    def pull_of(self, prior: Prior, fit: Fit) -> FloatArray:
        """What a prior adds to the right-hand side."""
        return np.asarray(
            prior.information @ ((prior.mean - np.concatenate([fit.state, fit.shape])) / self._scale), dtype=np.float64
        )

    def moved(self, fit: Fit, step: FloatArray, parts: Sequence[Equations]) -> tuple[Fit, float]:
        """A step further, cut to LONGEST_STEP; and how long it was, natural steps."""
        n, scale = len(fit.state), self._scale
        longest = float(np.abs(step[:n]).max())
        step = step * min(1.0, LONGEST_STEP / max(longest, LONGEST_STEP))
        moved = clip_joints(fit.state + step[:n] * scale[:n], self._limits)
        total = sum(part.length_px for part in parts)
        explained = sum(part.explained_px for part in parts) / total if total > 0 else 0.0
        return fit._replace(state=moved, shape=fit.shape + step[n:] * scale[n:], explained=explained), longest

    def with_lengths(self, fit: Fit) -> Fit:
        """A fit that has ended, with what of its contour is missed."""
        missed_px, length_px = self._views[0].missed()
        return fit._replace(offset_px=self._views[0].offset_px, missed_px=missed_px, length_px=length_px)


class JointFit:
    """Fits two arms to what one frame shows of each, by one normal system for both.

    Unknown are both states, both shapes, and by how much masks are too large, which may be the same for both: then,
    where one arm is mostly hidden, the other tells.

    Args:
        fits: Of each arm.
        config: Options.
    """

    def __init__(self, fits: Sequence[ContourFit], config: FitConfig) -> None:
        self._fits = tuple(fits)
        self._config = config

    def __call__(
        self,
        states: Sequence[FloatArray],
        observations: Sequence[Observation],
        priors: Sequence[Prior],
        *,
        tips: Sequence[bool],
        learn: Sequence[bool],
        shared: bool,
    ) -> list[Fit]:
        """As :class:`ContourFit`, of each arm what that takes: ``(9,)`` states, its part of the frame, its prior.

        With ``shared`` edges of both are off by one and the same offset, as in one mask of both; else by one each.
        What a fit says of a frame's information of an arm allows for how well the other is known.
        """
        config = self._config
        begun = [
            fit.begin(state, observation, prior, tips=with_tips)
            for fit, state, observation, prior, with_tips in zip(
                self._fits, states, observations, priors, tips, strict=True
            )
        ]
        ends, known, first = (list(one) for one in zip(*begun, strict=True))
        sizes = [len(prior.mean) for prior in known]
        places = [slice(sum(sizes[:k]), sum(sizes[: k + 1])) for k in range(len(sizes))]
        believed = block_diag(*(prior.information for prior in known))
        parts: list[Sequence[Equations]] = [()] * len(ends)
        moving = list(range(len(ends)))
        for _ in range(config.iterations):
            for k in moving:
                parts[k] = self._fits[k].equations(ends[k], config.spacing_px, shared=shared)
            information, pull, with_offset, offset_pull, pivot = _together(parts, places, 1.0 / config.offset_px**2)
            pull = pull + np.concatenate(
                [fit.pull_of(prior, end) for fit, prior, end in zip(self._fits, known, ends, strict=True)]
            )
            step = np.linalg.solve(information + believed, pull)
            offset_px = float((offset_pull - with_offset @ step) / pivot) if shared else None
            still = list(moving)
            for k in moving:
                self._fits[k].follow(step[places[k]], offset_px)
                ends[k], longest = self._fits[k].moved(ends[k], step[places[k]], parts[k])
                if longest < SETTLED:  # what the other's steps do to it is less
                    still.remove(k)
            moving = still
            if not moving:
                break
        for k, (fit, place) in enumerate(zip(self._fits, places, strict=True)):
            rest = np.delete(np.arange(sum(sizes)), place)
            others = information[np.ix_(rest, rest)] + believed[np.ix_(rest, rest)]
            across = information[place][:, rest]
            told = information[place, place] - across @ np.linalg.solve(others, across.T)
            ends[k] = ends[k]._replace(information=(told + told.T) / 2)
            if first[k] and learn[k]:
                fit.learn(parts[k], ends[k].information + known[k].information)
        return [fit.with_lengths(end) for fit, end in zip(self._fits, ends, strict=True)]


def _together(
    parts: Sequence[Sequence[Equations]], places: Sequence[slice], certainty: float
) -> tuple[FloatArray, FloatArray, FloatArray, float, float]:
    """One system of all arms' equations, the offset that they may share eliminated.

    Args:
        parts: Of each arm, those of each view; the first has the offset last where that is shared.
        places: Of each arm's unknowns.
        certainty: What is known of the offset before, 1/px².

    Returns:
        Matrix and right-hand side; and the offset's row, right-hand side and pivot.
    """
    size = places[-1].stop
    A, b = np.zeros((size + 1, size + 1)), np.zeros(size + 1)
    for arm, place in zip(parts, places, strict=True):
        columns = np.append(np.arange(place.start, place.stop), size)[: len(arm[0].pull)]
        A[np.ix_(columns, columns)] += arm[0].information
        b[columns] += arm[0].pull
        for part in arm[1:]:
            A[place, place] += part.information
            b[place] += part.pull
    A[-1, -1] += certainty
    row, pivot = A[-1, :-1], float(A[-1, -1])
    return A[:-1, :-1] - np.outer(row, row) / pivot, b[:-1] - row * (b[-1] / pivot), row, float(b[-1]), pivot
