"""Exact silhouettes of articulated instruments: counts in microseconds, masks, gradients and contour points."""

from surgbench.silhouette.evaluator import (
    ContourPoints,
    Gradient,
    Reference,
    RowCrossings,
    RowSums,
    Score,
    SilhouetteEvaluator,
)
from surgbench.silhouette.visibility import VisibilityEvaluator

__all__ = [
    "ContourPoints",
    "Gradient",
    "Reference",
    "RowCrossings",
    "RowSums",
    "Score",
    "SilhouetteEvaluator",
    "VisibilityEvaluator",
]
