"""Tips of two arms: where they are looked for, and whose they are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import linear_sum_assignment

from surgbench.camera.change_of_view import ChangeOfView
from surgbench.contract import Mask, Observation, Scene, View
from surgbench.geometry import FloatArray
from surgbench.keypoints.found import Tips
from surgbench.search.nearer import COARSE, ways
from surgbench.silhouette import VisibilityEvaluator
from surgbench.state import split_arms
from surgbench.trackers.arm_masks import mask_per_arm

# Masks that somebody has named are believed unless the other way round their tips are so much nearer to the prediction.
TURNED_SHARE = 0.5
# In a mask of arms that touch: a tip that is farther from all that are predicted is none of them, as a share of the
# image's width; and two that are nearer to each other are one.
REACH_SHARE = 0.1
SAME_PX = 4.0


class ArmTips:
    """Looks for each arm's tips with what finds them in one arm's mask.

    Each arm is looked at in its own mask, or in its own part of the mask. Where both are in one part, that is parted by
    where a frame's search begins. Then all tips together are given to the arms as they are nearest to where that has
    them: segmenters confuse arms, and arms that have crossed are no longer the left one on the left.

    Args:
        scene: Instruments and cameras.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._evaluators = (
            [VisibilityEvaluator(scene.instruments, view.camera) for view in scene.views] if scene.arms > 1 else []
        )

    def find(self, observation: Observation, view: View, detect: Callable[[Mask], FloatArray | None]) -> Tips:
        """Per arm ``(2, 2)`` or ``(1, 2)`` pixels, or ``None``.

        Args:
            observation: The frame.
            view: Which of its views.
            detect: Finds the tips in a mask of one arm.
        """
        arms = self._scene.arms
        masks = mask_per_arm(view, arms)
        if arms == 1:
            return (detect(view.mask),)
        predicted = self._predicted(observation, view)
        if masks is not None:
            found = tuple(detect(mask) for mask in masks)
            named = view.told_apart is not None
            return found if predicted is None else turned(found, predicted, TURNED_SHARE if named else 1.0)
        if predicted is None:
            return (None,) * arms
        found = tuple(detect(mask) for mask in self._parted(observation, view))
        return assigned(found, predicted, REACH_SHARE * view.camera.width)

    def _own(self, observation: Observation, view: View) -> FloatArray:
        own: FloatArray = ChangeOfView(view.T_view_cam).states(observation.start[None])[0]
        return own

    def _predicted(self, observation: Observation, view: View) -> FloatArray | None:
        """Tips of where the search begins, ``(arms, 2, 2)`` pixels; ``None`` where nothing is known yet."""
        if not observation.start.any():
            return None
        states = split_arms(self._own(observation, view))
        tips = [one.tips_cam(state) for one, state in zip(self._scene.instruments, states, strict=True)]
        pixels = view.camera.project(np.stack(tips))
        return pixels if np.isfinite(pixels).all() else None

    def _parted(self, observation: Observation, view: View) -> list[Mask]:
        """The mask's pixels of each arm: those of its silhouette, and of those that no arm covers the nearer ones."""
        place = next(k for k, one in enumerate(self._scene.views) if one.camera == view.camera)
        covered = self._evaluators[place].silhouettes(self._own(observation, view))
        nearest = ways(covered).argmin(axis=0).repeat(COARSE, axis=0).repeat(COARSE, axis=1)
        nearest = nearest[: view.mask.shape[0], : view.mask.shape[1]]
        nobody = ~covered.any(axis=0)
        return [view.mask & (own | (nobody & (nearest == arm))) for arm, own in enumerate(covered)]


def turned(found: Tips, predicted: FloatArray, share: float) -> Tips:
    """Two arms' tips as they were found, or each arm's for the other's.

    Args:
        found: Per arm ``(2, 2)`` or ``(1, 2)`` pixels, or ``None``.
        predicted: ``(2, 2, 2)`` pixels.
        share: The other way round they must be nearer than so many times as they are.
    """
    straight, other = _distance(found, predicted), _distance(found[::-1], predicted)
    return found[::-1] if other < share * straight else found


def _distance(found: Tips, predicted: FloatArray) -> float:
    """Sum over the tips that were found of the way to where they are predicted, under the better pairing."""
    total = 0.0
    for tips, own in zip(found, predicted, strict=True):
        if tips is not None:
            ways = np.linalg.norm(tips[:, None] - own, axis=-1)
            total += float(ways[linear_sum_assignment(ways)].sum())
    return total


def assigned(found: Tips, predicted: FloatArray, reach_px: float) -> Tips:
    """All tips together, whoever's mask they were found in, given to the arms so that the ways are shortest in sum.

    Args:
        found: Per arm ``(2, 2)`` or ``(1, 2)`` pixels, or ``None``.
        predicted: ``(arms, 2, 2)`` pixels.
        reach_px: Tips that are farther from theirs are left out.

    Returns:
        Per arm ``(2, 2)`` or ``(1, 2)`` pixels, or ``None``.
    """
    every = [tip for tips in found if tips is not None for tip in tips]
    kept: list[FloatArray] = []
    for tip in every:
        if all(np.linalg.norm(tip - other) > SAME_PX for other in kept):
            kept.append(tip)
    if not kept:
        return (None,) * len(predicted)
    tips = np.array(kept)
    ways = np.linalg.norm(tips[:, None] - predicted.reshape(-1, 2), axis=-1)
    # Beyond its reach a tip costs the same everywhere, so that it does not push others off their places.
    rows, places = linear_sum_assignment(np.minimum(ways, reach_px))
    near = ways[rows, places] < reach_px
    owners = [rows[near & (places // 2 == arm)] for arm in range(len(predicted))]
    return tuple(tips[own] if len(own) else None for own in owners)
