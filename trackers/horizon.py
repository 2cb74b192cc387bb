"""A receding-horizon controller: the set points of the next steps at once, by a quadratic program in each step.

Model predictive control as robots have it since Diehl, Bock, Diedam and Wieber, *Fast direct multiple shooting
algorithms for optimal robot control* (2006): the course is linearised about the one planned a step before, and one
program is solved a step (the "real-time iteration"), here by DAQP (Arnstrom, Bemporad and Axehill, *A dual active-set
solver for embedded quadratic programming using recursive LDL' updates*, IEEE Transactions on Automatic Control, 2022),
from the constraints that were active a step before. What it asks for, and its weights, are our choice: nobody published
such a controller for this task.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from surgbench.compiled import compiled
from surgbench.config import NotNegative, Positive, Section
from surgbench.errors import ConfigError
from surgbench.extras import missing
from surgbench.geometry import FloatArray
from surgbench.trackers.linearised.task import ViewTask
from surgbench.trackers.linearised.view import ERRORS, RULES, linearise
from surgbench.viewpoint.contract import ViewCommand, ViewpointObservation, ViewpointScene, ViewpointTracker

JOINTS = 6
# Of the first step of a trial and after gaps: the plan is as good as at rest, and worth more than one program.
FIRST_PROGRAMS = 4
# DAQP's words for a constraint that may be broken, and for no bound.
SOFT, NONE = 8, 1e30


class HorizonConfig(Section):
    """Options."""

    steps: Annotated[
        tuple[Annotated[int, Field(ge=1, le=100)], ...],
        Field(min_length=2, max_length=40, description="between the set points that are planned; the first is 1"),
    ] = (1, 1, 2, 4, 6, 8, 10)
    filter_gain: Annotated[float, Field(gt=0, le=1, description="alpha of the filter of the feature's motion")] = 0.7
    normal_gain: Annotated[float, Field(gt=0, le=1, description="the same for the feature's normal")] = 0.5
    gaze_rad: Annotated[Positive, Field(description="tolerance of the view's direction")] = 1e-3
    level_rad: Annotated[Positive, Field(description="tolerance of the horizon")] = 2e-3
    distance_m: Annotated[Positive, Field(description="tolerance of the distance")] = 2e-3
    place_m: Annotated[Positive, Field(description="tolerance of the place; farther off, it pulls no harder")] = 0.01
    effort: Annotated[
        Positive, Field(description="weight of accelerations, each as a share of the largest that the joint can do")
    ] = 0.01
    margin_m: Annotated[NotNegative, Field(description="kept from floor, zone, and the smallest distance")] = 0.002
    penalty: Annotated[
        Positive, Field(description="of rules that cannot be kept, against the rest: DAQP's weight of soft constraints")
    ] = 1e4


@compiled(makes_arrays=True, calls="viewpoint")
def quadratic_model(
    arm: FloatArray,
    reach_m: float,
    plan: FloatArray,
    features: FloatArray,
    wanted: FloatArray,
    distance_m: float,
    rules: FloatArray,
    faces: FloatArray,
    weights: FloatArray,
    shares: FloatArray,
    hessian: FloatArray,
    gradient: FloatArray,
    depth: FloatArray,
    slope: FloatArray,
) -> None:
    """The view's cost about a plan, Gauss and Newton's way, and the rules there.

    Args:
        arm: ``(3,)`` of the kinematics.
        reach_m: From tool to camera.
        plan: ``(n, 6)`` set points.
        features: ``(n, 3)`` the feature when the joints will be there.
        wanted: ``(n, 3)`` the camera's place then.
        distance_m: d_t.
        rules: As :func:`surgbench.trackers.linearised.view.linearise` has them.
        faces: Likewise.
        weights: ``(8,)`` one over the errors' tolerances; beyond its, the place weighs less (Huber).
        shares: ``(n,)`` of the horizon.
        hessian: ``(n, 6, 6)``, filled.
        gradient: ``(n, 6)``, filled.
        depth: ``(n, 4)``, filled.
        slope: ``(n, 4, 6)``, filled.
    """
    error, J = np.empty(ERRORS), np.empty((ERRORS, JOINTS))
    for node in range(len(plan)):
        linearise(
            arm, reach_m, plan[node], features[node], wanted[node], distance_m, rules, faces, error, J, depth[node],
            slope[node],
        )  # fmt: skip
        miss = 0.0
        for row in range(ERRORS):
            error[row] *= weights[row]
            for joint in range(JOINTS):
                J[row, joint] *= weights[row]
            if row >= 5:
                miss += error[row] ** 2
        pull = min(1.0, 1.0 / np.sqrt(max(miss, 1e-12)))
        for a in range(JOINTS):
            gradient[node, a] = 0.0
            for b in range(JOINTS):
                hessian[node, a, b] = 0.0
        for row in range(ERRORS):
            weight = shares[node] * (pull if row >= 5 else 1.0)
            for a in range(JOINTS):
                gradient[node, a] += weight * J[row, a] * error[row]
                for b in range(JOINTS):
                    hessian[node, a, b] += weight * J[row, a] * J[row, b]


class Horizon(ViewpointTracker):
    """Linearised model predictive control over the joints, rules and limits as constraints of the whole horizon.

    The unknowns are how the set points at some steps ahead differ from those of the plan before, and by how much each
    rule is broken at each. The cost is that of gaze, level, distance and place (with Huber's loss), each over its
    tolerance, of accelerations, and of broken rules. Limits of position, velocity and acceleration are linear in the
    set points; the rules are taken to first order: above the floor, before the nearest face of the zone, outside a
    sphere about the feature, on the preferred side. The feature moves on as it does. The first set point is commanded.
    """

    name: ClassVar[str] = "horizon"
    summary: ClassVar[str] = "receding horizon: the next 32 steps as one quadratic program"
    Config = HorizonConfig

    def __init__(self, config: HorizonConfig | None = None) -> None:
        self._config = config or HorizonConfig()

    @classmethod
    def unavailable(cls) -> str | None:
        """DAQP is an extra."""
        return missing(("daqp",))

    def reset(self, scene: ViewpointScene, joints: FloatArray, rng: np.random.Generator) -> None:
        """Set the program up: everything of it that does not change in a trial.

        Raises:
            ConfigError: DAQP is not installed.
        """
        if (lacking := self.unavailable()) is not None:
            raise ConfigError(f"tracker '{self.name}' cannot run here: {lacking}")
        config = self._config
        self._task = task = ViewTask(scene, config.filter_gain, config.normal_gain)
        steps = np.array(config.steps)
        self._after_s = task.dt_s * np.cumsum(steps)
        self._weights = 1 / np.repeat(
            [config.gaze_rad, config.level_rad, config.distance_m, config.place_m], [3, 1, 1, 3]
        )
        self._shares = steps / steps.sum()
        self._program = Program(task, steps, config)
        count = len(steps)
        self._model = (
            np.empty((count, JOINTS, JOINTS)), np.empty((count, JOINTS)), np.empty((count, RULES)),
            np.empty((count, RULES, JOINTS)),
        )  # fmt: skip
        self._plan = np.tile(np.asarray(joints, dtype=np.float64), (count, 1))

    def step(self, observation: ViewpointObservation) -> ViewCommand:
        """The first set point of the plan, and its velocity."""
        task, setpoint, velocity = self._task, observation.setpoint, observation.setpoint_velocity
        if not task.look(observation):
            return ViewCommand(setpoint.copy())
        if task.begins:
            self._plan[:] = setpoint
        else:
            self._plan = self._moved_on(setpoint)
        features, wanted = task.ahead(self._after_s + task.lag_s)
        box = task.reachable(setpoint, velocity)
        for _ in range(FIRST_PROGRAMS if task.begins else 1):
            quadratic_model(
                task.arm, task.reach_m, self._plan, features, wanted, task.distance_m, task.rules, task.faces,
                self._weights, self._shares, *self._model,
            )  # fmt: skip
            change = self._program.solve(self._plan, setpoint, velocity, box, *self._model)
            self._plan = np.clip(self._plan + change, task.lower, task.upper)
        target = np.clip(self._plan[0], *box)
        return ViewCommand(target, mode="servo", velocity=(target - setpoint) / task.dt_s, solver=True)

    def _moved_on(self, setpoint: FloatArray) -> FloatArray:
        """The plan a step later: between its set points evenly, and after the last as before it, slowing down."""
        times = np.concatenate([[-self._task.dt_s], self._after_s - self._task.dt_s])
        known = np.vstack([setpoint, self._plan])
        known[1] = setpoint  # where the first of the plan should have brought it
        return np.column_stack([np.interp(self._after_s, times, column) for column in known.T])


class Program:
    """The quadratic program of one step, for DAQP.

    Unknowns: ``(n, 6)`` changes of the plan. Constraints: positions (bounds of the unknowns), velocities between the
    planned set points, accelerations between these, and the rules, which alone may be broken, at a price.

    Args:
        task: The trial's.
        steps: ``(n,)`` between the planned set points.
        config: Weights.
    """

    def __init__(self, task: ViewTask, steps: NDArray[np.int_], config: HorizonConfig) -> None:
        self._task, self._margin_m, count = task, config.margin_m, len(steps)
        self._settings = {"w_soft": config.penalty, "rho_soft": 1e-6}
        between_s = task.dt_s * steps
        step = np.eye(count) - np.eye(count, k=-1)
        # Differences of the planned set points, and of the velocities between them.
        self._moved = np.kron(step, np.eye(JOINTS))
        self._changed = np.kron(step @ np.diag(1 / between_s) @ step, np.eye(JOINTS))
        self._farthest = np.outer(between_s, task.velocity)
        self._change = np.outer((between_s + np.append(0.0, between_s[:-1])) / 2, task.acceleration)
        effort = np.repeat(config.effort * steps / steps.sum(), JOINTS) / np.square(self._change.ravel())
        self._effort = self._changed.T * effort
        self._smooth = self._effort @ self._changed
        self._moves, self._rules = JOINTS * count, RULES * count
        # Those of the first step are in its bounds.
        self._fixed = np.concatenate([self._moved[JOINTS:], self._changed[JOINTS:]])
        self._matrix = np.concatenate([self._fixed, np.zeros((self._rules, self._moves))])
        self._sense = np.zeros(self._moves + len(self._matrix), dtype=np.intc)
        self._sense[-self._rules :] = SOFT
        self._low, self._high = np.full((2, len(self._sense)), NONE)
        self._low *= -1
        self._hessian = np.empty((self._moves, self._moves))
        self._model: Any = None

    def solve(
        self,
        plan: FloatArray,
        setpoint: FloatArray,
        velocity: FloatArray,
        box: FloatArray,
        hessian: FloatArray,
        gradient: FloatArray,
        depth: FloatArray,
        slope: FloatArray,
    ) -> FloatArray:
        """How the plan should change, ``(n, 6)``; not at all where the solver finds nothing.

        Args:
            plan: ``(n, 6)`` what everything is linearised about.
            setpoint: ``(6,)`` now.
            velocity: ``(6,)`` of the set point.
            box: ``(2, 6)`` what the first set point can be.
            hessian: From :func:`quadratic_model`, as the rest.
            gradient: There.
            depth: There.
            slope: There.
        """
        task, moves, low, high = self._task, self._moves, self._low, self._high
        H, A = self._hessian, self._matrix
        H[:] = self._smooth
        for node in range(len(plan)):
            at = slice(JOINTS * node, JOINTS * (node + 1))
            H[at, at] += hessian[node]
            A[len(self._fixed) + RULES * node : len(self._fixed) + RULES * (node + 1), at] = slope[node]
        away = plan - setpoint
        changed = (self._changed @ away.ravel()).reshape(plan.shape)
        changed[0] -= velocity
        moved = np.diff(plan, axis=0)
        f = gradient.ravel() + self._effort @ changed.ravel()
        low[:moves], high[:moves] = (task.lower - plan).ravel(), (task.upper - plan).ravel()
        low[:JOINTS], high[:JOINTS] = box - plan[0]
        after = 2 * moves - JOINTS
        low[moves:after] = (-self._farthest[1:] - moved).ravel()
        high[moves:after] = (self._farthest[1:] - moved).ravel()
        low[after : -self._rules] = (-self._change[1:] - changed[1:]).ravel()
        high[after : -self._rules] = (self._change[1:] - changed[1:]).ravel()
        high[-self._rules :] = -self._margin_m - depth.ravel()
        return self._call(f).reshape(plan.shape)

    def _call(self, f: FloatArray) -> FloatArray:
        import daqp

        problem = (self._hessian, f, self._matrix, self._high, self._low)
        if self._model is None:
            self._model = daqp.Model()
            self._model.settings = self._settings
            self._model.setup(*problem, self._sense)
        else:
            self._model.update(*problem)
        found, _, status, _ = self._model.solve()
        if status < 1:  # from what was active before it may go round in circles
            found, _, status, _ = daqp.solve(*problem, self._sense, **self._settings)
        return np.asarray(found, dtype=np.float64) if status >= 1 else np.zeros(self._moves)
