"""Exact silhouettes of articulated instruments: areas and overlaps in microseconds, and masks."""

from surgbench.silhouette.evaluator import Reference, RowSums, Score, SilhouetteEvaluator

__all__ = ["Reference", "RowSums", "Score", "SilhouetteEvaluator"]
