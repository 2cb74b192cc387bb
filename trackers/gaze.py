"""Our controller: the whole pose at once, by bounded least squares, and no step behind the feature."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from surgbench.config import NotNegative, Positive, Section
from surgbench.geometry import FloatArray, inverse_transform
from surgbench.trackers.viewing.advance import FITTED, MEMORY, advance
from surgbench.trackers.viewing.world import make_world
from surgbench.viewpoint.contract import ViewCommand, ViewpointObservation, ViewpointScene, ViewpointTracker

Angle = Annotated[float, Field(ge=0, lt=90)]


class GazeConfig(Section):
    """Options."""

    filter_gain: Annotated[float, Field(gt=0, le=1, description="alpha of the filter of the feature's motion")] = 0.5
    normal_gain: Annotated[float, Field(gt=0, le=1, description="the same for the feature's normal")] = 0.5
    patience_rad: Annotated[
        Positive, Field(description="so far may roll and wrist be behind while the other joints go at half their pace")
    ] = 0.03
    goal_iterations: Annotated[int, Field(ge=1, description="of the fit of where the camera should be in the end")] = 6
    step_iterations: Annotated[int, Field(ge=1, description="of the fit of where it can be next")] = 12
    margin_m: Annotated[NotNegative, Field(description="kept from floor, no-go zone and the smallest distance")] = 0.002
    registration_margin: Annotated[
        NotNegative, Field(description="and so many times what the registration says of its error")
    ] = 3.0
    pole_deg: Annotated[NotNegative, Field(description="kept from straight above, where no direction is level")] = 10.0
    side_deg: Annotated[NotNegative, Field(description="kept from the plane of the preferred side")] = 3.0
    above_deg: Annotated[
        NotNegative, Field(description="by which the camera stays above the feature: looking up is the wrong side")
    ] = 1.0
    behind_deg: Annotated[
        tuple[Angle, Angle],
        Field(description="kept from the tool's axis, either way, in the ring's plane and towards its normal"),
    ] = (60.0, 45.0)
    wrist_deg: Annotated[NotNegative, Field(description="kept from the wrist's limits where the pose is fitted")] = 5.0
    way_share: Annotated[float, Field(gt=0, lt=1, description="of the joints' accelerations, for ways round")] = 0.7
    fastest_m_s: Annotated[Positive, Field(description="on such ways")] = 0.2


# A feature that is farther away, or nowhere, is not looked at.
FARTHEST_M = 1e3
# Tolerances: gaze (rad), level (rad), distance (m), direction (rad), Huber's threshold for it, rules (m), cone (m).
GOAL = 1 / np.array([5e-3, 2e-3, 5e-4, 1e-1, 1.0, 5e-5, 1e-3])
WAY = 1 / np.array([5e-3, 2e-3, 5e-4, 1e-1, 1.0, np.inf, np.inf])
STEP = 1 / np.array([2e-4, 5e-4, 1e-3, np.inf, 1.0, np.inf, np.inf])


class Gaze(ViewpointTracker):
    """Where the camera should be, a way there that keeps the rules, and no step that the arm could not brake after.

    The goal is the naive pose in closed form where nothing speaks against it, else the joints within their limits
    that come nearest to it within the rules and see the feature, by bounded least squares from several starts. The
    camera goes there round the feature, by a detour where that is blocked, as fast as the joints' accelerations
    allow; roll and wrist look at the feature from wherever it is on the way. The feature's motion is predicted over
    the period and the joints' lag. Every step is brought within barriers that respect the braking distance, and
    taken only if the arm could come to rest after it out of the zone and above the floor.
    """

    name: ClassVar[str] = "gaze"
    summary: ClassVar[str] = "ours: bounded least squares over the whole pose, every step within the arm's limits"
    Config = GazeConfig

    def __init__(self, config: GazeConfig) -> None:
        self._config = config

    def reset(self, scene: ViewpointScene, joints: FloatArray, rng: np.random.Generator) -> None:
        """Bring the rules into the arm's frame."""
        config = self._config
        margin = config.margin_m + config.registration_margin * scene.registration_error_m
        self._T_base_world = inverse_transform(scene.T_world_base)
        self._world = make_world(
            scene,
            margin_m=margin,
            guard_m=config.margin_m / 2,
            pole_rad=math.radians(config.pole_deg),
            side_rad=math.radians(config.side_deg),
            above_rad=math.radians(config.above_deg),
            cone_rad=np.radians(config.behind_deg),
            wrist_rad=math.radians(config.wrist_deg),
        )
        self._options = np.array([
            config.filter_gain, config.normal_gain, config.patience_rad, config.way_share, config.fastest_m_s,
        ])  # fmt: skip
        self._iterations = np.array([config.goal_iterations, config.step_iterations], dtype=np.float64)
        self._motion: FloatArray | None = None
        self._index = -1
        self._goal, self._last, self._memory = np.array(joints), np.array(joints), np.zeros(MEMORY)
        self._dt_s = scene.dt_s

    def step(self, observation: ViewpointObservation) -> ViewCommand:
        """The set point of the next step and its velocity."""
        normal = observation.T_world_feature[:3, 1]
        # Written so that NaN holds the set point, too.
        if not (np.abs(observation.T_world_feature).max() < FARTHEST_M and 0.5 < normal @ normal < 2.0):
            return ViewCommand(observation.setpoint.copy())
        pose = self._T_base_world @ observation.T_world_feature
        if self._motion is None or observation.index != self._index + 1:  # the first, or after a gap
            still = np.zeros(3)
            self._motion = np.array([pose[:3, 3], still, pose[:3, 1], still])
            self._memory[:] = 0.0
        self._index = observation.index
        target = np.empty(6)
        way = advance(
            self._world, self._options, GOAL, WAY, STEP, self._iterations, observation.index, pose, self._motion,
            self._last, self._goal, self._memory, observation.joints, observation.setpoint,
            observation.setpoint_velocity, target,
        )  # fmt: skip
        velocity = (target - observation.setpoint) / self._dt_s
        return ViewCommand(target, mode="servo", velocity=velocity, solver=way == FITTED)
