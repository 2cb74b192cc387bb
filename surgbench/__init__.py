"""surgbench: make surgical instrument tracking data, run trackers on it, and compare them.

The public names (``docs/api.md``) are loaded when they are first used, each with what it needs and no more.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from surgbench.version import __version__

if TYPE_CHECKING:
    from surgbench import metrics
    from surgbench.camera import Camera
    from surgbench.contract import Estimate, InstrumentTracker, Observation, Scene, View
    from surgbench.dataset.open import open_dataset
    from surgbench.instrument import Instrument, load_instrument
    from surgbench.metrics import (
        choose_twin,
        frames_to_recover,
        interval_coverages,
        jitter,
        keypoint_error,
        lag,
        lost_precision,
        lost_recall,
        mask_error,
        masks_apart,
        pose_errors,
        rotation_error,
        translation_error_scaled,
    )
    from surgbench.objective import LossWeights, Objective
    from surgbench.report.comparison import compare
    from surgbench.report.notebook import leaderboard, load_records
    from surgbench.silhouette import SilhouetteEvaluator
    from surgbench.state import StateSpace
    from surgbench.viewpoint.contract import ViewCommand, ViewpointObservation, ViewpointScene, ViewpointTracker

__all__ = [
    "Camera",
    "Estimate",
    "Instrument",
    "InstrumentTracker",
    "LossWeights",
    "Objective",
    "Observation",
    "Scene",
    "SilhouetteEvaluator",
    "StateSpace",
    "View",
    "ViewCommand",
    "ViewpointObservation",
    "ViewpointScene",
    "ViewpointTracker",
    "__version__",
    "choose_twin",
    "compare",
    "frames_to_recover",
    "interval_coverages",
    "jitter",
    "keypoint_error",
    "lag",
    "leaderboard",
    "load_instrument",
    "load_records",
    "lost_precision",
    "lost_recall",
    "mask_error",
    "masks_apart",
    "metrics",
    "open_dataset",
    "pose_errors",
    "rotation_error",
    "translation_error_scaled",
]

_NAMES_IN = {
    "surgbench.camera": ("Camera",),
    "surgbench.contract": ("Estimate", "InstrumentTracker", "Observation", "Scene", "View"),
    "surgbench.dataset.open": ("open_dataset",),
    "surgbench.instrument": ("Instrument", "load_instrument"),
    "surgbench.metrics": (
        "choose_twin",
        "frames_to_recover",
        "interval_coverages",
        "jitter",
        "keypoint_error",
        "lag",
        "lost_precision",
        "lost_recall",
        "mask_error",
        "masks_apart",
        "pose_errors",
        "rotation_error",
        "translation_error_scaled",
    ),
    "surgbench.objective": ("LossWeights", "Objective"),
    "surgbench.report.comparison": ("compare",),
    "surgbench.report.notebook": ("leaderboard", "load_records"),
    "surgbench.silhouette": ("SilhouetteEvaluator",),
    "surgbench.state": ("StateSpace",),
    "surgbench.viewpoint.contract": ("ViewCommand", "ViewpointObservation", "ViewpointScene", "ViewpointTracker"),
}
_MODULE_OF = {name: module for module, names in _NAMES_IN.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "metrics":
        return importlib.import_module("surgbench.metrics")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'surgbench' has no attribute '{name}'")
    found = getattr(importlib.import_module(_MODULE_OF[name]), name)
    globals()[name] = found  # the next time without this function
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
