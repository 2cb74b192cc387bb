"""The geometrically best place, whatever the rules say: AutoCam (arXiv 2505.10398) without all that follows II-A1."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.trackers.hierarchical.poses import is_usable, naive_joints
from surgbench.trackers.hierarchical.world import World
from surgbench.viewpoint.contract import ViewCommand, ViewpointObservation, ViewpointScene, ViewpointTracker


class NaivePlacement(ViewpointTracker):
    """At a distance along the feature's normal, looking back along it, level; joints clipped to their limits."""

    name: ClassVar[str] = "naive"
    summary: ClassVar[str] = "geometric placement and closed-form inverse kinematics, clipped, no rules"

    def reset(self, scene: ViewpointScene, joints: FloatArray, rng: np.random.Generator) -> None:
        """Take the scene in."""
        self._world, self._distance_m = World.of(scene), scene.distance_m

    def step(self, observation: ViewpointObservation) -> ViewCommand:
        """Go to the naive pose, or as near as each joint can."""
        world, feature = self._world, observation.T_world_feature
        if not is_usable(feature):
            return ViewCommand(observation.setpoint.copy())
        joints = np.empty(6)
        inside = naive_joints(
            world.arm, world.reach_m, world.limits, world.frames, self._distance_m, feature, observation.joints, joints
        )
        return ViewCommand(joints, active=() if inside else ("joint_limit",))
