"""The best course in hindsight, to hold controllers against: it is told the whole trial beforehand."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from surgbench.config import NotNegative, Section
from surgbench.extras import missing
from surgbench.geometry import FloatArray, inverse_transform
from surgbench.trackers.foreseeing.course import CourseProgram, Problem
from surgbench.trackers.gaze import Gaze, GazeConfig
from surgbench.trackers.horizon import Horizon
from surgbench.viewpoint.contract import ViewCommand, ViewpointObservation, ViewpointScene, ViewpointTracker
from surgbench.viewpoint.placement import UP, naive_pose
from surgbench.viewpoint.registration import Touches
from surgbench.viewpoint.scores import COST_TOLERANCES
from surgbench.viewpoint.simulator import Simulation
from surgbench.viewpoint.trial import Trial

CONTROLLERS: dict[str, Callable[[], ViewpointTracker]] = {"gaze": lambda: Gaze(GazeConfig()), "horizon": Horizon}


class ForesightConfig(Section):
    """Options."""

    begins: Annotated[
        tuple[Literal["gaze", "horizon"], ...],
        Field(min_length=1, description="controllers whose courses are improved; the best of what comes out is taken"),
    ] = ("gaze", "horizon")
    every: Annotated[int, Field(ge=1, description="steps from knot to knot of the course")] = 4
    rounds: Annotated[int, Field(ge=0, description="quadratic programs, at most; 0: those courses as they are")] = 12
    margin_m: Annotated[NotNegative, Field(description="kept from floor, no-go zone and feature")] = 0.0005


class Foresight(ViewpointTracker):
    """Minimises ``view_cost`` over a whole trial at once, within the arm's limits and the rules.

    It begins with the courses of `gaze` and of `horizon`, improves each by quadratic programs over all knots
    (:mod:`surgbench.trackers.foreseeing.course`), and takes the better. After a gap in the measurements, during which
    the arm is brought to rest, what remains is planned anew. What it reaches is a local optimum; how near to the best
    it is, is measured by ``benchmarks/viewpoint_optimum.py``.
    """

    name: ClassVar[str] = "foresight"
    summary: ClassVar[str] = "no controller: the optimum in hindsight, told the whole trial (extra 'control')"
    foresees: ClassVar[bool] = True
    Config = ForesightConfig

    def __init__(self, config: ForesightConfig | None = None) -> None:
        self._config = config or ForesightConfig()

    @classmethod
    def unavailable(cls) -> str | None:
        """What is not installed."""
        return missing(("clarabel", "daqp"))

    def reset(self, scene: ViewpointScene, joints: FloatArray, rng: np.random.Generator) -> None:
        """Plan the course up to the first gap."""
        self._scene = scene
        self._future = np.empty((0, 4, 4)) if scene.future is None else scene.future
        self._begin, self._plan = 0, np.empty((0, 6))
        self._expected = 0
        seen = np.flatnonzero(np.isfinite(self._future).all(axis=(1, 2)))
        if len(seen):
            self._expected = int(seen[0])
            self._replan(self._expected, np.array(joints), np.zeros(6))

    def step(self, observation: ViewpointObservation) -> ViewCommand:
        """The set point of the plan and its velocity."""
        index = observation.index
        if index != self._expected:
            self._replan(index, observation.setpoint, observation.setpoint_velocity)
        self._expected = index + 1
        at = index - self._begin
        if not 0 <= at < len(self._plan):
            return ViewCommand(observation.setpoint.copy())
        before = self._plan[at - 1] if at else observation.setpoint
        velocity = (self._plan[at] - before) / self._scene.dt_s
        return ViewCommand(self._plan[at].copy(), mode="servo", velocity=velocity, solver=True)

    def _replan(self, begin: int, setpoint: FloatArray, velocity: FloatArray) -> None:
        """Plan from a step up to the next gap."""
        self._begin = begin
        features = self._future[begin:]
        gaps = np.flatnonzero(~np.isfinite(features).all(axis=(1, 2)))
        features = features[: gaps[0]] if len(gaps) else features
        self._plan = np.empty((0, 6))
        if len(features):
            self._plan = self._course(features, setpoint, velocity)

    def _course(self, features: FloatArray, setpoint: FloatArray, velocity: FloatArray) -> FloatArray:
        """``(T, 6)`` set points after each step."""
        scene = self._scene
        self.problem = self._problem(features, setpoint, velocity)
        program = CourseProgram(self.problem, self._config.every)
        knots = program.knots
        found = []
        for name in self._config.begins:
            begin = _causal(CONTROLLERS[name](), scene, features, setpoint)
            at = np.minimum(np.arange(knots.count) * self._config.every, len(begin) - 1)
            velocities = np.gradient(begin, scene.dt_s, axis=0)[at] if len(begin) > 1 else np.zeros((knots.count, 6))
            velocities[0], velocities[-1] = velocity, 0.0
            found.append(program.improve(velocities, self._config.rounds))
        velocities, self.merits = min(found, key=lambda result: result[1][-1].total)
        places = knots.places(setpoint, velocities)
        return np.asarray(knots.steps(places, velocities, knots.setpoint))

    def _problem(self, features: FloatArray, setpoint: FloatArray, velocity: FloatArray) -> Problem:
        """Everything in the frame of the arm's base."""
        scene, workspace = self._scene, self._scene.workspace
        T_base_world = inverse_transform(scene.T_world_base)
        turn, base = scene.T_world_base[:3, :3], scene.T_world_base[:3, 3]
        naive = naive_pose(features, scene.distance_m)
        wanted = np.stack([features[:, :3, 3], naive[:, :3, 3]], axis=1) @ T_base_world[:3, :3].T + T_base_world[:3, 3]
        faces, floor = workspace.zone.faces, workspace.floor
        tolerances = [
            math.radians(COST_TOLERANCES["vva_deg"]), 1e-3 * COST_TOLERANCES["fd_mm"],
            math.radians(COST_TOLERANCES["pf_deg"]), 1e-3 * COST_TOLERANCES["pn_full_mm"],
        ]  # fmt: skip
        return Problem(
            arm=scene.arm.packed,
            reach_m=scene.arm.camera_m,
            limits=np.array([scene.arm.lower, scene.arm.upper, scene.arm.velocity, scene.arm.acceleration]),
            wanted=np.ascontiguousarray(wanted),
            # Where the feature is one step later; after the last one it stays.
            feature=np.ascontiguousarray(wanted[np.minimum(np.arange(1, len(wanted) + 1), len(wanted) - 1), 0]),
            distance_m=scene.distance_m,
            weights=1 / np.array(tolerances),
            up=turn.T @ UP,
            rules=np.array([
                [*(turn.T @ floor[:3]), floor[3] - floor[:3] @ base],
                [*(turn.T @ np.array(workspace.preferred_side)), workspace.proximity_m],
            ]),
            faces=np.column_stack([faces[:, :3] @ turn, faces[:, 3] - faces[:, :3] @ base]),
            margin_m=self._config.margin_m,
            dt_s=scene.dt_s,
            lag_s=scene.servo_lag_s,
            start=np.array([setpoint, velocity]),
        )  # fmt: skip


def _causal(
    controller: ViewpointTracker, scene: ViewpointScene, features: FloatArray, setpoint: FloatArray
) -> FloatArray:
    """``(T + 1, 6)`` set points of a controller on the same features, from rest."""
    steps = scene.dt_s * np.arange(len(features), dtype=np.float64)
    empty = np.empty((0, 3))
    trial = Trial(
        "foreseen", scene.dt_s, steps, features, scene.T_world_base, Touches(empty, empty), scene.workspace.zone.points,
        setpoint,
    )  # fmt: skip
    return Simulation(controller, trial, scene, np.random.default_rng(0)).run().setpoints
