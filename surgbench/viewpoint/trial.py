"""One trial of the viewpoint task: what is known of it beforehand, and what only the simulator knows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.viewpoint.camera_arm import PSM_CLASSIC, CameraArm
from surgbench.viewpoint.placement import DISTANCE_M
from surgbench.viewpoint.registration import Touches
from surgbench.viewpoint.workspace import FLOOR_M, PREFERRED_SIDE, PROXIMITY_M


@dataclass(frozen=True, eq=False)
class Wire:
    """The wire that a ring goes along.

    Attributes:
        points_m: ``(n, 3)`` its centre line, a polyline in the world frame.
        radius_m: Of the wire.
        ring_radius_m: Of the circle in the middle of the ring's tube.
        tube_radius_m: Of that tube.
    """

    points_m: FloatArray
    radius_m: float
    ring_radius_m: float
    tube_radius_m: float


@dataclass(frozen=True, eq=False)
class TrialTruth:
    """How things really were.

    Attributes:
        T_world_feature: ``(T, 4, 4)``.
        T_world_base: ``(4, 4)`` where the camera arm's base really is.
        contact: ``(T,)`` whether ring and wire touched.
        wire: Where there is one.
    """

    T_world_feature: FloatArray
    T_world_base: FloatArray
    contact: NDArray[np.bool_]
    wire: Wire | None = None


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
        distance_m: d_t, wanted from camera to feature.
        floor_m: The camera stays this high above the base of the zone.
        proximity_m: And this far from the feature.
        preferred_side: ``(3,)`` unit vector: the camera's y axis must not point along it.
        arm: The arm that holds the camera.
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
    distance_m: float = DISTANCE_M
    floor_m: float = FLOOR_M
    proximity_m: float = PROXIMITY_M
    preferred_side: tuple[float, float, float] = PREFERRED_SIDE
    arm: CameraArm = PSM_CLASSIC

    @property
    def measured(self) -> NDArray[np.bool_]:
        """``(T,)`` whether the feature was measured."""
        return np.asarray(np.isfinite(self.T_world_feature).all(axis=(1, 2)))
