"""The endoscope's autonomous camera of Eslamian, Reisner and Pandya, on an arm that holds an auxiliary camera.

Their rule (careslab/autocamera: scripts/autocamera_algorithm.py): the optical axis goes from the remote centre to the
midpoint of both tools' tips; how deep the endoscope is, follows from how far the tips are from the midpoint in the
picture, in three zones. Here there is one tool and what it holds, so that the midpoint is the feature itself.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from surgbench.config import NotNegative, Positive, Section
from surgbench.geometry import FloatArray
from surgbench.trackers.hierarchical.poses import NEAREST_M, is_usable, shaft_joints
from surgbench.trackers.hierarchical.world import World
from surgbench.viewpoint.camera_arm import INSERTION, ROLL
from surgbench.viewpoint.contract import ViewCommand, ViewpointObservation, ViewpointScene, ViewpointTracker


class MidpointConfig(Section):
    """Options; the zones' defaults are the published ones."""

    insertion: Annotated[
        Literal["distance", "zones"],
        Field(description="distance: stay as far from the feature as wanted; zones: stay as deep, but for the zones"),
    ] = "distance"
    roll: Annotated[
        Literal["level", "keep"], Field(description="level: the camera's x axis is level; keep: it turns with the arm")
    ] = "level"
    pan_zone: Annotated[
        NotNegative,
        Field(description="not turned while the feature is this near to the picture's middle, in picture widths"),
    ] = 0.0
    extent_m: Annotated[
        Positive, Field(description="half of what should be in view, in place of half the distance of two tools' tips")
    ] = 0.02
    inner: Annotated[NotNegative, Field(description="nearer to the midpoint, in picture widths: go in")] = 0.1
    dead: Annotated[NotNegative, Field(description="farther than inner and this: go out")] = 0.2
    focal: Annotated[Positive, Field(description="focal length in picture widths (62.2 degrees)")] = 0.829
    zoom_m: Annotated[Positive, Field(description="one step in or out")] = 1e-3
    dwell_s: Annotated[NotNegative, Field(description="before it, in the zone and with the feature at rest")] = 0.3
    rest_m: Annotated[NotNegative, Field(description="at rest: within this of where it came to rest")] = 1e-3
    rest_zooming_m: Annotated[NotNegative, Field(description="the same while going in or out")] = 5e-3


class Midpoint(ViewpointTracker):
    """Points the shaft from the remote centre at the feature: pan and tilt, with the wrist straight."""

    name: ClassVar[str] = "midpoint"
    summary: ClassVar[str] = "points the shaft from the remote centre at the feature, after Eslamian et al."
    Config = MidpointConfig

    def __init__(self, config: MidpointConfig | None = None) -> None:
        self._config = config or MidpointConfig()

    def reset(self, scene: ViewpointScene, joints: FloatArray, rng: np.random.Generator) -> None:
        """As deep as it is now."""
        self._world, self._wanted_m = World.of(scene), scene.distance_m
        self._roll = float(np.clip(joints[ROLL], self._world.limits[0, ROLL], self._world.limits[1, ROLL]))
        # Where the camera would be on the shaft with the wrist straight.
        self._straight_m = self._world.reach_m + float(self._world.arm.sum())
        self._depth_m = float(joints[INSERTION]) + self._straight_m
        self._aim: FloatArray | None = None
        self._distance_m = scene.distance_m
        self._zone, self._since_s = 0, 0.0
        self._rest: FloatArray | None = None
        self._rest_since_s, self._zooming = 0.0, False

    def step(self, observation: ViewpointObservation) -> ViewCommand:
        """Point there."""
        world, feature = self._world, observation.T_world_feature
        joints = np.empty(6)
        if not is_usable(feature):
            return ViewCommand(observation.setpoint.copy())
        by_distance = self._config.insertion == "distance"
        apart_m = shaft_joints(
            world.arm, world.reach_m, world.limits, world.frames, self._aimed(feature),
            self._wanted_m if by_distance else np.nan, self._depth_m, observation.joints, joints,
        )  # fmt: skip
        if apart_m < NEAREST_M:  # the feature is in the remote centre: every direction is right
            return ViewCommand(observation.setpoint.copy())
        if self._config.roll == "keep":
            joints[ROLL] = self._roll
        if not by_distance:
            self._distance_m = apart_m - self._depth_m
            self._zoom(feature[:3, 3], self._distance_m, observation.timestamp_s)
        return ViewCommand(joints)

    def _aimed(self, feature: FloatArray) -> FloatArray:
        """What the axis points at: the feature, or as near to it as keeps it in the zone in which nothing is turned."""
        if not self._config.pan_zone:
            return feature
        place = feature[:3, 3]
        aim = place if self._aim is None else self._aim
        away = float(np.linalg.norm(place - aim))
        most = self._config.pan_zone / self._config.focal * max(self._distance_m, NEAREST_M)
        if away > most:
            aim = place + (aim - place) * (most / away)
        self._aim = np.array(aim)
        aimed = feature.copy()
        aimed[:3, 3] = aim
        return aimed

    def _zoom(self, feature_m: FloatArray, distance_m: float, now_s: float) -> None:
        """Change the depth by one step where the feature has been at rest in the inner or outer zone long enough."""
        config = self._config
        moved_m = config.rest_zooming_m if self._zooming else config.rest_m
        if self._rest is None or not float(np.linalg.norm(feature_m - self._rest)) < moved_m:
            self._rest_since_s = now_s
            # A copy: where the feature is at this moment.
            self._rest = np.array(feature_m)
        apart = config.focal * config.extent_m / max(distance_m, NEAREST_M)
        zone = 1 if apart < config.inner else (-1 if apart > config.inner + config.dead else 0)
        if zone != self._zone:
            self._zone, self._since_s = zone, now_s
        waited_s = min(now_s - self._since_s, now_s - self._rest_since_s)
        self._zooming = zone != 0 and waited_s > config.dwell_s
        if self._zooming:
            lower, upper = self._world.limits[:, INSERTION] + self._straight_m
            self._depth_m = float(np.clip(self._depth_m + zone * config.zoom_m, lower, upper))
