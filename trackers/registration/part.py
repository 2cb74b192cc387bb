"""What a picture of two arms says of one: where it is seen, where it is not, and where the other may hide it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.compiled import compiled
from surgbench.contract import Mask, Scene, View
from surgbench.geometry import FloatArray
from surgbench.keypoints.found import FoundTips
from surgbench.objective import LossWeights, Objective, ViewLoss
from surgbench.silhouette import ContourPoints
from surgbench.silhouette.evaluator import RowSums
from surgbench.trackers.registration.edges import HIDDEN


class PartView(View):
    """One arm's part of a view.

    Args:
        view: Of both arms.
        mask: ``(H, W)`` where the arm is seen.
        hidden: ``(H, W)`` where the view says nothing of it.
        found: The arm's tips.

    Attributes:
        hidden: As given.
        codes: ``(H, W)`` NOTHING, SEEN, or HIDDEN.
    """

    hidden: Mask
    codes: NDArray[np.uint8]

    def __init__(self, view: View, mask: Mask, hidden: Mask, found: FoundTips) -> None:
        seen = mask & ~hidden
        super().__init__(view.camera, view.T_view_cam, seen, image=view.image, found=found)
        codes = seen.view(np.uint8) + np.uint8(HIDDEN) * hidden.view(np.uint8)
        self.__dict__.update({"hidden": hidden, "codes": codes})


def shown_points(contour: ContourPoints, codes: NDArray[np.uint8]) -> ContourPoints:
    """The points of a contour that lie where nothing hides them."""
    shown = np.empty(len(contour.arm), dtype=bool)
    _mark_shown(contour.points_px, codes, shown)
    if shown.all():
        return contour
    return ContourPoints._make(values[shown] for values in contour)


@compiled
def _mark_shown(points: Any, codes: Any, shown: Any) -> None:
    for k in range(points.shape[0]):
        column = min(max(int(np.floor(points[k, 0] + 0.5)), 0), codes.shape[1] - 1)
        row = min(max(int(np.floor(points[k, 1] + 0.5)), 0), codes.shape[0] - 1)
        shown[k] = codes[row, column] != HIDDEN


class PartLoss(ViewLoss):
    """The terms of one arm's part of a view. What may be hidden counts neither way."""

    def observe(self, view: View) -> None:
        """Take the frame that the next calls score against."""
        super().observe(view)
        self._hidden = view.hidden if isinstance(view, PartView) and view.hidden.any() else None
        self._rows: RowSums | None = None

    @property
    def _known(self) -> RowSums | None:
        """Where nothing is hidden, summed when first asked for; ``None`` where that is everywhere."""
        if self._rows is None and self._hidden is not None:
            self._rows = RowSums(~self._hidden)
        return self._rows

    def mismatch(self, states: FloatArray) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64]]:
        """Eq. 6 of ``(n, 9)`` states where nothing is hidden, pixels; what they cover there, and of the mask."""
        observed = self.reference.area
        known = self._known
        if known is None:
            return super().mismatch(states)
        own = self.change.states(states)
        _, area = self.evaluator.sum_over(own, known)
        _, overlap = self.evaluator.sum_over(own, self.reference)
        loss = area + observed - 2 * overlap + self.appearance * np.abs(area - observed)
        return np.asarray(loss, dtype=np.float64), area, overlap


class PartObjective(Objective):
    """Scores states of one arm against its part of what was seen; it has no gradient.

    Args:
        scene: Of that arm.
        weights: Of the terms.
    """

    def __init__(self, scene: Scene, weights: LossWeights) -> None:
        super().__init__(scene, weights)
        self.views = tuple(PartLoss(scene, view.camera, weights) for view in scene.views)
        self.evaluator = self.views[0].evaluator
