"""Which part of a picture of two arms is which arm's, and where each may be hidden by the other.

With a mask of both arms together, what lies on or beside the other's silhouette says nothing of an arm. With a mask of
each, the one in front is seen whole, and only its mask hides the other; masks may be exchanged for a while, which shows
where they fit what is expected far better the other way round.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surgbench.camera.change_of_view import ChangeOfView
from surgbench.contract import Mask, Observation, Scene, View
from surgbench.geometry import FloatArray
from surgbench.keypoints.found import FoundTips, Tips
from surgbench.silhouette import KeypointProjector, SilhouetteEvaluator
from surgbench.trackers.arm_masks import mask_per_arm
from surgbench.trackers.registration.morphology import grown, opened
from surgbench.trackers.registration.order import Order
from surgbench.trackers.registration.part import PartView
from surgbench.trackers.registration.screen import Screen

MARGIN_PX = 2  # around what hides: expected silhouettes are off by as much, and masks are
REACH_PX = 16  # from an arm's silhouette, beyond which a mask may be a lost other's
CLEAR = 2.0  # times as many pixels for one arm being in front, or for masks being exchanged, as for the contrary
FEW_PIXELS = 30  # tell neither
SPECK_PX = 5  # opening that a lost arm's mask is cleaned by: what the other's silhouette leaves at its edges
MEMORY = 0.95  # of whether masks are exchanged, from frame to frame


class Cutter:
    """Cuts one view into the parts of two arms.

    Args:
        scene: Of both.
        index: Of the view.

    Attributes:
        told_apart: Whether the last frame had a mask of each arm.
        exchanged: Whether those were taken the other way round.
    """

    def __init__(self, scene: Scene, index: int) -> None:
        camera = scene.views[index].camera
        self._evaluators = [SilhouetteEvaluator([one], camera) for one in scene.instruments]
        self._projector = KeypointProjector(scene.instruments, camera)
        self._order = Order(camera)
        self._screens = [Screen() for _ in scene.instruments]
        self._mostly = 0.0  # below 0 where masks are the right way round, as a rule
        self.exchanged = self.told_apart = False

    def __call__(
        self, view: View, states: FloatArray, lost: Sequence[bool], unfit: Sequence[bool] = (False, False)
    ) -> tuple[PartView, PartView]:
        """Each arm's part.

        Args:
            view: Of both arms.
            states: ``(2, 9)`` where they are expected, in the reference camera's frame.
            lost: Of which arms that means nothing.
            unfit: Which of them did not fit in the last frame.
        """
        own = ChangeOfView(view.T_view_cam).states(states.reshape(-1)).reshape(2, -1)
        silhouettes = [one.mask(state) for one, state in zip(self._evaluators, own, strict=True)]
        apart = _told_apart(view)
        self.told_apart = apart is not None
        if apart is None:
            self.exchanged = False
            parts = _of_union(view, silhouettes, lost)
        else:
            parts = self._of_each(apart, silhouettes, own, lost)
        seen = view.mask if apart is None else apart[0] | apart[1]
        parts = [
            (mask, hidden if gone else screen(silhouette, mask, hidden, seen, unfit=slipped))
            for (mask, hidden), silhouette, screen, gone, slipped in zip(
                parts, silhouettes, self._screens, lost, unfit, strict=True
            )
        ]
        found = view.found

        def tips(arm: int) -> FoundTips:
            return FoundTips(lambda: (self._assigned(found.every, own)[arm],))

        one, other = (PartView(view, mask, hidden, tips(arm)) for arm, (mask, hidden) in enumerate(parts))
        return one, other

    def _of_each(
        self, masks: tuple[Mask, Mask], silhouettes: Sequence[Mask], own: FloatArray, lost: Sequence[bool]
    ) -> list[tuple[Mask, Mask]]:
        """Masks and what is hidden, from a mask of each arm."""
        # Pixels in each mask of what each silhouette does not share with the other.
        alone = silhouettes[0] & ~silhouettes[1], silhouettes[1] & ~silhouettes[0]
        shared = np.array([[np.count_nonzero(one & mask) for mask in masks] for one in alone])
        sure = ~np.array(lost)
        straight, crossed = shared[sure, np.flatnonzero(sure)].sum(), shared[sure, 1 - np.flatnonzero(sure)].sum()
        if max(straight, crossed) >= FEW_PIXELS and max(straight, crossed) > CLEAR * min(straight, crossed):
            self.exchanged = bool(crossed > straight)
            self._mostly = MEMORY * self._mostly + (1.0 - MEMORY) * (1.0 if self.exchanged else -1.0)
        else:
            self.exchanged = self._mostly > 0
        if self.exchanged:
            masks = masks[::-1]
        hides = [grown(mask, MARGIN_PX) for mask in masks]
        self._order.clear(hides, masks, silhouettes, own, lost)
        return [(masks[arm], hides[1 - arm]) for arm in range(2)]

    def _assigned(self, tips: Tips, own: FloatArray) -> Tips:
        """Tips of the arm that each is expected at: who found them may have taken one arm for the other."""
        if len(tips) < 2:
            return (None, None)
        expected = self._projector.project(own.reshape(1, -1))[0].mean(axis=1)
        off = [
            [0.0 if some is None else float(np.linalg.norm(some.mean(axis=0) - centre)) for centre in expected]
            for some in tips
        ]
        straight, crossed = off[0][0] + off[1][1], off[0][1] + off[1][0]
        return (tips[1], tips[0]) if CLEAR * crossed < straight else (tips[0], tips[1])


def _told_apart(view: View) -> tuple[Mask, Mask] | None:
    """A mask of each arm, where there is one that tells the arms apart."""
    given = view.told_apart
    if given is None or len(given) < 2:
        return None
    masks = list(given)
    for arm in range(2):
        if not masks[arm].any():  # what is left may be it
            masks[arm] = opened(view.mask & ~grown(masks[1 - arm], MARGIN_PX), SPECK_PX)
    return masks[0], masks[1]


def _of_union(view: View, silhouettes: Sequence[Mask], lost: Sequence[bool]) -> list[tuple[Mask, Mask]]:
    """Masks and what is hidden, from one mask of both arms."""
    if all(lost):
        alone = mask_per_arm(view, 2)
        if alone is not None:
            return [(alone[arm], alone[1 - arm]) for arm in range(2)]
    parts = []
    for arm in range(2):
        if lost[1 - arm]:  # nobody knows where it is
            hidden = view.mask & ~grown(silhouettes[arm], REACH_PX)
            parts.append((view.mask, np.zeros_like(view.mask) if lost[arm] else hidden))
        else:
            hidden = grown(silhouettes[1 - arm], MARGIN_PX)
            mask = view.mask & ~hidden
            parts.append((opened(mask, SPECK_PX) if lost[arm] else mask, hidden))
    return parts


def part_of(observation: Observation, arm: int, views: Sequence[PartView]) -> Observation:
    """One arm's part of a frame."""
    own = slice(arm, arm + 1)
    return Observation(
        observation.index,
        observation.timestamp_s,
        tuple(views),
        start=observation.start.reshape(2, -1)[arm],
        joints=None if observation.joints is None else observation.joints[own],
        kinematics=None if observation.kinematics is None else observation.kinematics[own],
    )
