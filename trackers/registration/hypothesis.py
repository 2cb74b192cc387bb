"""One story of how an arm has moved, and what it is judged by."""

from __future__ import annotations

from dataclasses import dataclass

from surgbench.geometry import FloatArray
from surgbench.trackers.registration.belief import MotionBelief

SAME = 1.0  # jump cost within which two hypotheses are one


@dataclass
class Hypothesis:
    """One story of how the instrument has moved.

    Attributes:
        belief: What it says of the frame to come.
        state: Its last estimate.
        cost: How badly it explained the last frames, the latest most.
        jump: How unlikely the jump was that it began with, beside the story that goes on. Unlike the cost it isn't
            forgotten while both are followed, so that of two which the masks do not tell apart the one without stays.
        iou: Overlap of its silhouette with the mask.
        explained: Share of its contour that has an edge in the mask.
        explained_mask: Share of the mask's edge that has a contour.
        missed_jaws: Share of the jaws that is unexplained, of their own contour.
        hidden: Of an arm beside another: so much of it is hidden that masks tell next to nothing.
        tool_px: Likewise, how much contour of wrist and jaws shows.
        off_m: Likewise, how far off its tips are believed to be.
    """

    belief: MotionBelief
    state: FloatArray
    cost: float
    iou: float = 0.0
    explained: float = 1.0
    explained_mask: float = 1.0
    missed_jaws: float = 0.0
    jump: float = 0.0
    hidden: bool = False
    tool_px: float = 0.0
    off_m: float = 0.0

    @property
    def total(self) -> float:
        """What stories are compared by."""
        return self.cost + self.jump
