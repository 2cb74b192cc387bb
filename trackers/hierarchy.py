"""A controller that keeps a strict order: limits and rules before the view, the view before level, distance and place.

Kinematic control by hierarchical quadratic programs: Kanoun, Lamiraux and Wieber, *Kinematic control of redundant
manipulators: generalizing the task-priority framework to inequality task*, IEEE Transactions on Robotics 27(4), 2011;
Escande, Mansard and Wieber, *Hierarchical quadratic programming: fast online humanoid-robot motion generation*,
International Journal of Robotics Research 33(7), 2014. The hierarchy is solved as the first of these has it, a program
for each level, each by DAQP; the second's solver takes all levels at once and finds the same. Which tasks there are,
and their order, is our choice.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from surgbench.config import NotNegative, Positive, Section
from surgbench.errors import ConfigError
from surgbench.extras import missing
from surgbench.geometry import FloatArray
from surgbench.trackers.linearised.task import ViewTask
from surgbench.trackers.linearised.view import DISTANCE, ERRORS, GAZE, LEVEL, PLACE, RULES, linearise
from surgbench.viewpoint.camera_arm import WRIST_PITCH
from surgbench.viewpoint.contract import ViewCommand, ViewpointObservation, ViewpointScene, ViewpointTracker

# In the order of their priority, after limits and rules.
TASKS = (GAZE, LEVEL, DISTANCE, PLACE)
JOINTS = 6
# Directions in which a task changes less than this, of its largest change, are left to the tasks below. Gaze, of three
# numbers, has two; the third is as small as its error.
RANK = 0.05
# On every joint, against directions that no task asks for.
DAMPING = 1e-9
# DAQP's word for no bound.
NONE = 1e30


class HierarchyConfig(Section):
    """Options."""

    filter_gain: Annotated[float, Field(gt=0, le=1, description="alpha of the filter of the feature's motion")] = 0.7
    normal_gain: Annotated[float, Field(gt=0, le=1, description="the same for the feature's normal")] = 0.5
    settle_s: Annotated[
        Positive, Field(description="time constant with which errors of gaze and level are brought to nothing")
    ] = 0.05
    approach_s: Annotated[
        Positive, Field(description="time constant with which errors of distance and place are brought to nothing")
    ] = 0.15
    acceleration_m_s2: Annotated[
        Positive, Field(description="with which the camera counts on braking before its place and before a rule")
    ] = 0.08
    margin_m: Annotated[NotNegative, Field(description="kept from floor, zone, and the smallest distance")] = 0.002
    wrist_room_rad: Annotated[
        NotNegative, Field(description="the place is not worth a wrist nearer to its limits than this")
    ] = 0.2


class Hierarchy(ViewpointTracker):
    """The joints' next step by quadratic programs in strict order, no level at the cost of one above it.

    1. Limits, always: position, velocity, acceleration, and being able to stop. Within them the rules: no faster
       towards floor, zone, smallest distance or wrong side than the camera can brake.
    2. Gaze, 3. level, 4. distance, 5. place: on with the feature, and their errors to nothing with a time constant,
       those of distance and place no faster than the camera can brake. For its place it does not go where the wrist has
       no room left to follow the feature.
    """

    name: ClassVar[str] = "hierarchy"
    summary: ClassVar[str] = "hierarchical quadratic programs on joint velocities: rules, gaze, level, distance, place"
    Config = HierarchyConfig

    def __init__(self, config: HierarchyConfig | None = None) -> None:
        self._config = config or HierarchyConfig()

    @classmethod
    def unavailable(cls) -> str | None:
        """DAQP is an extra."""
        return missing(("daqp",))

    def reset(self, scene: ViewpointScene, joints: FloatArray, rng: np.random.Generator) -> None:
        """Take the scene in.

        Raises:
            ConfigError: DAQP is not installed.
        """
        if (lacking := self.unavailable()) is not None:
            raise ConfigError(f"tracker '{self.name}' cannot run here: {lacking}")
        self._task = ViewTask(scene, self._config.filter_gain, self._config.normal_gain)
        self._J = np.empty((ERRORS, JOINTS))
        self._depth, self._slope = np.empty(RULES), np.empty((RULES, JOINTS))

    def step(self, observation: ViewpointObservation) -> ViewCommand:
        """The next set point, and its velocity."""
        task, setpoint = self._task, observation.setpoint
        if not task.look(observation):
            return ViewCommand(setpoint.copy())
        features, places = task.ahead(np.array([task.lag_s, task.lag_s + task.dt_s]))
        now, after = (self._errors(setpoint, feature, place) for feature, place in zip(features, places, strict=True))
        box = task.reachable(setpoint, observation.setpoint_velocity) - setpoint
        # What the feature's motion does to the errors is made good at once; what was there before, bit by bit.
        wanted = now - after
        share = min(1.0, task.dt_s / self._config.settle_s)
        wanted[GAZE] -= share * now[GAZE]
        wanted[LEVEL] -= share * now[LEVEL]
        wanted[DISTANCE] += self._nearer(now[DISTANCE])
        wanted[PLACE] += self._nearer(now[PLACE])
        boxes = (box, box, box, self._roomy(setpoint, box))
        tasks = [(self._J[rows], wanted[rows], own) for rows, own in zip(TASKS, boxes, strict=True)]
        moved = descend(box, self._slope, self._allowed(), tasks)
        target = np.clip(setpoint + moved, setpoint + box[0], setpoint + box[1])
        return ViewCommand(target, mode="servo", velocity=(target - setpoint) / task.dt_s, solver=True)

    def _errors(self, joints: FloatArray, feature: FloatArray, place: FloatArray) -> FloatArray:
        """The view's errors ``(8,)``; derivatives and rules stay in the arrays that are kept for them."""
        task, error = self._task, np.empty(ERRORS)
        linearise(
            task.arm, task.reach_m, joints, feature, place, task.distance_m, task.rules, task.faces,
            error, self._J, self._depth, self._slope,
        )  # fmt: skip
        return error

    def _nearer(self, error: FloatArray) -> FloatArray:
        """How an error should change in a step."""
        size = float(np.linalg.norm(error))
        if size == 0.0:
            return -error
        share = min(1.0, self._task.dt_s / self._config.approach_s)
        return np.asarray(-error * min(share, float(self._braking(np.array([size]))[0]) / size))

    def _roomy(self, setpoint: FloatArray, box: FloatArray) -> FloatArray:
        """The part of a box in which the wrist is not, or does not come, too near to its limits."""
        room = np.zeros(JOINTS)
        room[WRIST_PITCH:] = self._config.wrist_room_rad
        share = min(1.0, self._task.dt_s / self._config.approach_s)
        least = np.minimum(share * (self._task.lower + room - setpoint), 0.0)
        most = np.maximum(share * (self._task.upper - room - setpoint), 0.0)
        return np.asarray(np.clip(np.array([least, most]), box[0], box[1]))

    def _allowed(self) -> FloatArray:
        """``(4,)`` how much deeper each rule lets the camera go in a step: it must be able to brake before it."""
        room = -self._config.margin_m - self._depth
        return np.asarray(np.where(room >= 0.0, self._braking(np.maximum(room, 0.0)), room))

    def _braking(self, room_m: FloatArray) -> FloatArray:
        """The step after which there is room to brake, ``v dt + v^2 / 2a`` being what there is, times ``dt``."""
        change = self._config.acceleration_m_s2 * self._task.dt_s
        found = np.sqrt(change**2 + 2 * self._config.acceleration_m_s2 * room_m) - change
        return np.asarray(self._task.dt_s * found)


def descend(
    box: FloatArray,
    slope: FloatArray,
    allowed: FloatArray,
    tasks: Sequence[tuple[FloatArray, FloatArray, FloatArray]],
) -> FloatArray:
    """A hierarchy of least squares: every task as well as the limits, the rules and the tasks before it let it.

    Each level is solved in the directions that the levels above have left free, so that what these have is kept.

    Args:
        box: ``(2, n)`` least and largest steps, which always hold.
        slope: ``(m, n)`` of the rules, which hold as far as they can: the squared sum of what they lack is least.
        allowed: ``(m,)`` largest ``slope @ step``.
        tasks: Matrices ``(k, n)``, what they should make of the step, ``(k,)``, and a box like the first: a task takes
            no joint out of its own, or farther out than those before it did.

    Returns:
        ``(n,)`` the step.
    """
    joints, rules = box.shape[1], len(slope)
    # Rules: the step and what each lacks, which is not negative.
    weights = np.append(np.full(joints, DAMPING), np.ones(rules))
    lacking = np.zeros((rules, joints + rules))
    lacking[:, :joints], lacking[:, joints:] = slope, -np.eye(rules)
    high = np.concatenate([box[1], np.full(rules, NONE), allowed])
    low = np.concatenate([box[0], np.zeros(rules), np.full(rules, -NONE)])
    step = _solve(np.diag(weights), np.zeros(joints + rules), lacking, high, low)
    if step is None:
        return np.asarray(box.mean(axis=0))
    found = np.clip(step[:joints], *box)
    limit = np.maximum(allowed, slope @ found)
    free = np.eye(joints)
    for matrix, wanted, own in tasks:
        within = matrix @ free
        hessian = within.T @ within + DAMPING * np.eye(free.shape[1])
        gradient = within.T @ (matrix @ found - wanted)
        rows = np.concatenate([free, slope @ free])
        high = np.concatenate([np.maximum(own[1] - found, 0.0), limit - slope @ found])
        low = np.concatenate([np.minimum(own[0] - found, 0.0), np.full(rules, -NONE)])
        step = _solve(hessian, gradient, rows, high, low)
        if step is not None:
            found = np.clip(found + free @ step, *box)
        _, size, directions = np.linalg.svd(within)
        used = int((size > RANK * max(float(size.max()), RANK)).sum())
        free = free @ directions[used:].T
        if not free.shape[1]:
            break
    return found


def _solve(
    hessian: FloatArray, gradient: FloatArray, rows: FloatArray, high: FloatArray, low: FloatArray
) -> FloatArray | None:
    """One program; ``None`` where the solver finds nothing. The first bounds are the unknowns' where rows are fewer."""
    import daqp

    sense = np.zeros(len(high), dtype=np.intc)
    found, _, status, _ = daqp.solve(hessian, gradient, np.ascontiguousarray(rows), high, low, sense)
    return np.asarray(found, dtype=np.float64) if status >= 1 else None
