"""AutoCam (Banks et al., arXiv 2505.10398) as its published code does it (AlexandreBanks6/RCL_Autocam_Public).

Written from what that code does; none of it is copied. Where it differs from the article is told in
``docs/viewpoint-controllers.md``.
"""

from __future__ import annotations

import time
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from surgbench.config import NotNegative, Section
from surgbench.geometry import FloatArray
from surgbench.trackers.hierarchical.constrained_ik import ConstrainedIK, SolverConfig, WeightsConfig
from surgbench.trackers.hierarchical.means import PoseMean
from surgbench.trackers.hierarchical.poses import is_usable, shift, tool_pose
from surgbench.trackers.hierarchical.steps import JOINT_LIMIT, NAMES, PROXIMITY, UNSEEN, published_step, reach
from surgbench.trackers.hierarchical.world import World
from surgbench.viewpoint.camera_arm import YAW
from surgbench.viewpoint.contract import ViewCommand, ViewpointObservation, ViewpointScene, ViewpointTracker

Share = Annotated[float, Field(gt=0, le=1)]
Count = Annotated[int, Field(ge=1, le=100_000)]
# The yaw joint of the code's own robot file, beyond what the robot's can do (1.588).
PLACEHOLDER_YAW_RAD = 4.7124


class PublishedConfig(Section):
    """Options; the defaults are what the published code has."""

    feature_window: Annotated[Count, Field(description="measured poses of the feature averaged")] = 5
    position_window: Annotated[Count, Field(description="commanded positions averaged (at 79 Hz: 1.8 s)")] = 140
    rotation_window: Annotated[Count, Field(description="commanded rotations averaged")] = 20
    interpolate_beyond_m: Annotated[
        NotNegative, Field(description="a place farther than this from the present one is gone to in part")
    ] = 0.015
    interpolate_share: Annotated[Share, Field(description="of the way, then")] = 0.5
    proximity_weights: Annotated[WeightsConfig, Field(description="where the camera would be too near")] = (
        WeightsConfig(position=15.0, orientation=30.0, distance=25.0)
    )
    joint_limit_weights: Annotated[WeightsConfig, Field(description="where Newton's inverse kinematics fails")] = (
        WeightsConfig(position=25.0, orientation=30.0, distance=10.0)
    )
    placeholder_yaw_limit: Annotated[
        bool, Field(description="yaw may go to ±4.7124 in check and optimiser; the robot's own limit clips it later")
    ] = True
    sleep_s: Annotated[
        NotNegative, Field(description="slept in flagged steps; the code sleeps 0.005, and its loop time counts it")
    ] = 0.0
    solver: SolverConfig = SolverConfig()


class AutocamPublished(ViewpointTracker):
    """AutoCam with its moving means, its look-at override, and its weights for each branch."""

    name: ClassVar[str] = "autocam-published"
    summary: ClassVar[str] = "AutoCam as its published code does it: moving means, half-way steps, weights by branch"
    Config = PublishedConfig

    def __init__(self, config: PublishedConfig | None = None) -> None:
        self._config = config or PublishedConfig()

    def reset(self, scene: ViewpointScene, joints: FloatArray, rng: np.random.Generator) -> None:
        """Empty the means."""
        config = self._config
        self._world = world = World.of(scene)
        self._options = np.array([scene.distance_m, config.interpolate_beyond_m, config.interpolate_share])
        self._bounds = world.limits.copy()
        if config.placeholder_yaw_limit:
            self._bounds[:, YAW] = -PLACEHOLDER_YAW_RAD, PLACEHOLDER_YAW_RAD
        self._near, self._far = (
            ConstrainedIK(scene.arm, self._bounds, scene.distance_m, config.solver, weights, of_tool=True)
            for weights in (config.proximity_weights, config.joint_limit_weights)
        )
        self._points = np.array([np.zeros(3), np.zeros(3), world.up])
        self._feature = PoseMean(config.feature_window, config.feature_window)
        self._command = PoseMean(config.position_window, config.rotation_window)
        self._initialised = False

    def step(self, observation: ViewpointObservation) -> ViewCommand:
        """Where to go: a pose, as ``move_cp`` takes it."""
        world = self._world
        if not is_usable(observation.T_world_feature):
            return ViewCommand(observation.setpoint.copy())
        feature = self._feature(observation.T_world_feature)
        tool, look, joints = np.empty((4, 4)), np.empty((4, 4)), np.empty(6)
        flags = published_step(
            world.arm, world.reach_m, world.frames, world.faces, world.rules, self._options, feature,
            observation.joints, self._points, tool, look,
        )  # fmt: skip
        if flags & UNSEEN:
            return ViewCommand(observation.setpoint.copy())
        flagged, solver = flags != 0, False
        if flagged and self._config.sleep_s:
            time.sleep(self._config.sleep_s)
        if flags & PROXIMITY:
            self._solve(self._near, observation.joints, tool)
            solver = True
        if not reach(world.arm, world.frames[1], self._bounds, tool, observation.joints, joints):
            flags |= JOINT_LIMIT
            if self._initialised:
                self._solve(self._far, observation.joints, tool)
                solver = True
        self._initialised = True
        if not flagged:
            tool[:3, :3] = look[:3, :3]
        pose = self._command(tool)
        shift(pose, world.reach_m)
        return ViewCommand(pose, active=NAMES[flags], solver=solver)

    def _solve(self, solver: ConstrainedIK, start: FloatArray, tool: FloatArray) -> None:
        """Replace the tool's pose by what the optimiser finds, from the present joints, successful or not."""
        world = self._world
        self._points[1] = world.frames[1, :3, :3] @ tool[:3, 3] + world.frames[1, :3, 3]
        tool_pose(world.arm, world.frames[0], solver.solve(self._points, start).joints, tool)
