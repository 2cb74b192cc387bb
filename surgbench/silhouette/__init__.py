"""Exact silhouettes of articulated instruments: counts in microseconds, masks, gradients and contour points."""

from surgbench.silhouette.evaluator import (
    ContourPoints,
    Gradient,
    Reference,
    RowCrossings,
    RowSums,
    Score,
    SilhouetteEvaluator,
    iou,
)
from surgbench.silhouette.keypoints import KeypointProjector
from surgbench.silhouette.visibility import VisibilityEvaluator
from surgbench.silhouette.visible_scores import VisibleScore, VisibleScorer

__all__ = [
    "ContourPoints",
    "Gradient",
    "KeypointProjector",
    "Reference",
    "RowCrossings",
    "RowSums",
    "Score",
    "SilhouetteEvaluator",
    "VisibilityEvaluator",
    "VisibleScore",
    "VisibleScorer",
    "iou",
]
