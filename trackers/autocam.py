"""AutoCam (Banks et al., arXiv 2505.10398) as the article has it."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from surgbench.config import NotNegative, Section
from surgbench.geometry import FloatArray
from surgbench.trackers.hierarchical.constrained_ik import ConstrainedIK, SolverConfig, WeightsConfig
from surgbench.trackers.hierarchical.poses import clip, is_usable
from surgbench.trackers.hierarchical.steps import JOINT_LIMIT, NAMES, PROXIMITY, UNSEEN, article_step
from surgbench.trackers.hierarchical.world import World
from surgbench.viewpoint.contract import ViewCommand, ViewpointObservation, ViewpointScene, ViewpointTracker

Share = Annotated[float, Field(gt=0, le=1)]


class AutocamConfig(Section):
    """Options; the defaults are the published settings."""

    interpolate_beyond_m: Annotated[
        NotNegative, Field(description="a place farther than this from the present one is gone to in part")
    ] = 0.015
    interpolate_share: Annotated[
        Share, Field(description="of the way, then; the article is silent, the published code goes half")
    ] = 0.5
    weights: WeightsConfig = WeightsConfig()
    solver: SolverConfig = SolverConfig()


class Autocam(ViewpointTracker):
    """The naive place, brought out of the no-go zone and above the floor; joints by Newton, or by the optimiser.

    The rules in their order: on the wrong side the camera stays in its place and looks at the feature; in the zone or
    below the floor it goes to the nearest place that is neither; where it would be too near to the feature there, or
    Newton's inverse kinematics fails or breaks a joint limit, the constrained optimisation finds the joints.
    """

    name: ClassVar[str] = "autocam"
    summary: ClassVar[str] = "AutoCam as the article has it: hierarchy of rules, constrained inverse kinematics"
    Config = AutocamConfig

    def __init__(self, config: AutocamConfig | None = None) -> None:
        self._config = config or AutocamConfig()

    def reset(self, scene: ViewpointScene, joints: FloatArray, rng: np.random.Generator) -> None:
        """Take the scene in."""
        config = self._config
        self._world = world = World.of(scene)
        self._options = np.array([scene.distance_m, config.interpolate_beyond_m, config.interpolate_share])
        self._solver = ConstrainedIK(scene.arm, world.limits, scene.distance_m, config.solver, config.weights)
        self._points = np.array([np.zeros(3), np.zeros(3), world.up])

    def step(self, observation: ViewpointObservation) -> ViewCommand:
        """Where to go."""
        world, feature = self._world, observation.T_world_feature
        joints = np.empty(6)
        if not is_usable(feature):
            return ViewCommand(observation.setpoint.copy())
        flags = article_step(
            world.arm, world.reach_m, world.limits, world.frames, world.faces, world.rules, self._options, feature,
            observation.joints, self._points, joints,
        )  # fmt: skip
        if flags & UNSEEN:
            return ViewCommand(observation.setpoint.copy(), active=NAMES[flags])
        solver = flags & (PROXIMITY | JOINT_LIMIT) != 0
        if solver:
            joints = self._solver.solve(self._points, observation.joints).joints
        clip(world.limits, joints)
        return ViewCommand(joints, active=NAMES[flags], solver=solver)
