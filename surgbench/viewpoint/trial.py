"""One trial of the viewpoint task: what is known of it beforehand, and what only the simulator knows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.viewpoint.registration import Touches


@dataclass(frozen=True, eq=False)
class TrialTruth:
    """How things really were.

    Attributes:
        T_world_feature: ``(T, 4, 4)``.
        T_world_base: ``(4, 4)`` where the camera arm's base really is.
        contact: ``(T,)`` whether ring and wire touched.
    """

    T_world_feature: FloatArray
    T_world_base: FloatArray
    contact: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Trial:
    """A feature that moved, as it was measured, in the workspace of a camera arm.

    Attributes:
        id: Names it.
        dt_s: Seconds between samples.
        timestamps_s: ``(T,)`` seconds since the first sample.
        T_world_feature: ``(T, 4, 4)`` as measured; NaN where the feature was not measured.
        T_world_base: ``(4, 4)`` the camera arm's base as the set-up joints report it, before any registration.
        touches: The points that both arms touched before the trial.
        zone_m: ``(5, 3)`` the points touched around the no-go zone, world frame.
        start: ``(6,)`` joints of the camera arm at rest before the first sample.
        truth: ``None`` for recordings.
    """

    id: str
    dt_s: float
    timestamps_s: FloatArray
    T_world_feature: FloatArray
    T_world_base: FloatArray
    touches: Touches
    zone_m: FloatArray
    start: FloatArray
    truth: TrialTruth | None = None

    @property
    def measured(self) -> NDArray[np.bool_]:
        """``(T,)`` whether the feature was measured."""
        return np.asarray(np.isfinite(self.T_world_feature).all(axis=(1, 2)))
