"""The loss of two arms: against one mask of both (Hu et al. 2026, eq. 15), or of what is seen of each and its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surgbench.contract import Observation, Scene
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.objective import LossWeights, Objective
from surgbench.silhouette import Reference, SilhouetteEvaluator, VisibleScore, VisibleScorer

# Masks are taken to be each under the other arm's name only where the search begins that much nearer to them so.
TURNED_SHARE = 0.5


class PairObjective(Objective):
    """Scores candidate states of two arms.

    A call is eq. 15: both arms' silhouette and the one mask, and eq. 8 of each arm. Where all views of a frame have a
    mask for each arm, too, :meth:`arms` has a loss for each: eq. 6 of what is seen of it and its own mask, and eq. 8.

    Masks that are the same for both arms tell nothing apart: each arm's loss is then eq. 15. Segmenters confuse arms:
    where the state that a frame's search begins with is far nearer to the masks if they are exchanged, they are.

    Args:
        scene: Two instruments, and cameras.
        weights: Of the terms.

    Attributes:
        scorers: What is seen of each arm, of each view.
        tools: Silhouettes of each arm's wrist and jaws in the reference view.
        turned: Whether the masks of the frame are taken to be exchanged.

    Example:
        The right arm is where it is, the left one 3 mm aside, which costs the left one alone:

        >>> from dataclasses import replace
        >>> from surgbench.tasks.instrument.conformance.scenes import make_play
        >>> from surgbench.objective import LossWeights
        >>> from surgbench.pair_objective import PairObjective
        >>> play = make_play(arms=2)
        >>> objective = PairObjective(play.scene, LossWeights(keypoints=0))
        >>> frame, view = play.observations[0], play.observations[0].views[0]
        >>> alone = tuple(objective.scorers[0].visibility.visible_masks(play.truth[0]))
        >>> objective.observe(replace(frame, views=(replace(view, instance_masks=alone),)))
        >>> aside = play.truth[:1].copy()
        >>> aside[0, 3] += 0.003
        >>> losses, overlaps = objective.arms(aside)
        >>> bool(losses[0, 0] > 100), float(losses[0, 1]), float(overlaps[0, 1])
        (True, 0.0, 1.0)
    """

    def __init__(self, scene: Scene, weights: LossWeights) -> None:
        super().__init__(scene, weights)
        self.scorers = tuple(VisibleScorer(scene.instruments, view.camera) for view in scene.views)
        tools = [instrument.without_shaft for instrument in scene.instruments]
        self.tools = tuple(
            SilhouetteEvaluator([tool], scene.views[0].camera) if tool.meshes else None for tool in tools
        )
        self._references: list[tuple[Reference, ...]] | None = None
        self._named = False
        self.turned = False

    def observe(self, observation: Observation) -> None:
        """Take the frame that the next calls score against.

        Raises:
            ValueError: It has not the scene's number of views.
        """
        super().observe(observation)
        self.turned, self._references = False, None
        self._named = all(view.instance_masks is not None for view in observation.views)
        given = [view.told_apart for view in observation.views]
        references = [tuple(Reference(mask) for mask in masks) for masks in given if masks is not None]
        if len(references) < len(given):
            return
        self._references = references
        straight = float(self._arms(observation.start[None])[0].sum())
        self._references = [masks[::-1] for masks in references]
        self.turned = float(self._arms(observation.start[None])[0].sum()) < TURNED_SHARE * straight
        if not self.turned:
            self._references = references

    @property
    def tells_apart(self) -> bool:
        """Whether there is a mask for each arm, and not the same."""
        return self._references is not None

    def own_masks(self, view: int) -> tuple[Reference, ...]:
        """Of each arm its mask in a view, put right where they were exchanged.

        Raises:
            SurgbenchError: The frame has no masks of single arms.
        """
        if self._references is None:
            raise SurgbenchError("there is no mask for each arm; use a dataset that has them, with --masks instances")
        return self._references[view]

    def arms(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Losses (eq. 5) and overlaps of each arm of candidates; those of both where the arms' masks are the same.

        Args:
            states: ``(n, 18)``.

        Returns:
            ``(n, 2)`` losses in pixels, and ``(n, 2)`` intersection over union of what is seen of an arm and its mask.

        Raises:
            SurgbenchError: The frame has no masks of single arms.
        """
        if self._references is None and self._named:
            both, overlap = self(states)
            return np.stack([both, both], axis=1), np.stack([overlap, overlap], axis=1)
        loss, common, union = self._arms(states)
        for view in self.views:
            if view.has_keypoints:
                for arm, part in view.keypoints(states).items():
                    loss[:, arm] += part
        return loss, _share(common, union)

    def seen(self, states: FloatArray, view: int) -> VisibleScore:
        """What is seen of each arm of ``(n, 18)`` states in a view, against the arms' own masks.

        Raises:
            SurgbenchError: The frame has no masks of single arms.
        """
        return self.scorers[view].score(self.views[view].change.states(states), self.own_masks(view))

    def _arms(self, states: FloatArray) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64]]:
        """Eq. 6, and pixels that an arm's visible part and its mask have in common and cover, ``(n, 2)`` each."""
        loss = np.zeros((len(states), 2))
        common, union = np.zeros((2, len(states), 2), dtype=np.int64)
        for place, view in enumerate(self.views):
            score = self.seen(states, place)
            observed = np.array([reference.area for reference in self.own_masks(place)])
            loss += score.area + observed - 2 * score.overlap + view.appearance * np.abs(score.area - observed)
            common += score.overlap
            union += score.area + observed - score.overlap
        return loss, common, union


def _share(common: NDArray[np.int64], union: NDArray[np.int64]) -> FloatArray:
    return np.where(union > 0, common / np.maximum(union, 1), 1.0)
