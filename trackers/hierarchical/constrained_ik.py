"""AutoCam's constrained inverse kinematics: the objective under the joints' limits, by NLopt's SLSQP."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import nlopt
import numpy as np
from pydantic import Field

from surgbench.config import NotNegative, Positive, Section
from surgbench.geometry import FloatArray
from surgbench.trackers.hierarchical.cost import evaluate
from surgbench.viewpoint.camera_arm import CameraArm


class WeightsConfig(Section):
    """Weights of the objective's three terms."""

    position: Annotated[NotNegative, Field(description="w1, of the distance to the desired position")] = 15.0
    orientation: Annotated[NotNegative, Field(description="w2, of the view's direction and level")] = 30.0
    distance: Annotated[NotNegative, Field(description="w3, of the distance to the feature")] = 25.0


class SolverConfig(Section):
    """Options of the optimiser; the defaults are the published settings (Table IV)."""

    evaluations: Annotated[int, Field(ge=1, description="of the objective, at most")] = 50
    x_tolerance: Annotated[
        NotNegative, Field(description="relative change of the joints at which to stop; the article's 5^-4 in the code")
    ] = 5e-4
    f_tolerance: Annotated[
        NotNegative, Field(description="absolute change of the objective at which to stop; 0 is never")
    ] = 0.0
    direction: Annotated[NotNegative, Field(description="w4, of the view's direction within the orientation")] = 2.0
    level: Annotated[NotNegative, Field(description="w5, of the level x axis within the orientation")] = 0.5
    position_width_m: Annotated[Positive, Field(description="delta_1 of Huber's loss")] = 0.01
    orientation_width: Annotated[Positive, Field(description="delta_2 of Huber's loss")] = 0.17
    distance_width_m: Annotated[Positive, Field(description="delta_3 of Huber's loss")] = 0.02


class Solution(NamedTuple):
    """Where the optimiser ended.

    Attributes:
        joints: ``(6,)`` the best it evaluated, within the limits.
        cost: Of these.
        evaluations: How many there were.
        success: It met a tolerance, and neither ran out of evaluations nor failed.
    """

    joints: FloatArray
    cost: float
    evaluations: int
    success: bool


class ConstrainedIK:
    """Finds joints within bounds for a camera that should be somewhere, look at something, and be level.

    Args:
        arm: Holds the camera.
        bounds: ``(2, 6)`` lower and upper bounds of the joints.
        distance_m: d_t.
        config: Options of the optimiser.
        weights: Of the three terms.
        of_tool: The desired position is the tool's (the published code) and not the camera's (the article).
    """

    def __init__(
        self,
        arm: CameraArm,
        bounds: FloatArray,
        distance_m: float,
        config: SolverConfig,
        weights: WeightsConfig,
        *,
        of_tool: bool = False,
    ) -> None:
        self._arm, self._reach_m, self._config = arm.packed, arm.camera_m, config
        self._bounds = np.array(bounds, dtype=np.float64)
        self._points, self._best = np.zeros((3, 3)), np.zeros(8)
        self._settings = np.array([
            weights.position, weights.orientation, weights.distance, config.direction, config.level,
            config.position_width_m, config.orientation_width, config.distance_width_m, distance_m,
            arm.camera_m if of_tool else 0.0,
        ])  # fmt: skip
        self._optimiser: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_optimiser": None}

    def objective(self, points: FloatArray, joints: FloatArray, gradient: FloatArray) -> float:
        """The objective of a problem at ``(6,)`` joints; ``(6,)`` ``gradient`` is filled. See :meth:`solve`."""
        best = np.full(8, np.inf)
        return float(evaluate(self._arm, self._reach_m, points, self._settings, best, joints, gradient))

    def solve(self, points: FloatArray, start: FloatArray) -> Solution:
        """Solve a problem.

        Args:
            points: ``(3, 3)`` the feature, the desired position, and the world's up, in the frame of the arm's base.
            start: ``(6,)`` joints where the optimiser begins.

        Returns:
            The best joints that were evaluated, never worse than the start: also where the optimiser fails.
        """
        if self._optimiser is None:
            self._optimiser = self._make()
        self._points[:] = points
        seed = np.clip(start, self._bounds[0], self._bounds[1])
        best = self._best
        best[:6], best[6], best[7] = seed, np.inf, 0.0
        try:
            self._optimiser.optimize(seed)
            success = self._optimiser.last_optimize_result() in _SUCCESSES
        except _FAILURES:
            success = False  # what it had is kept
        return Solution(best[:6].copy(), float(best[6]), int(best[7]), success)

    def _make(self) -> Any:
        optimiser = nlopt.opt(nlopt.LD_SLSQP, 6)
        optimiser.set_lower_bounds(self._bounds[0])
        optimiser.set_upper_bounds(self._bounds[1])
        optimiser.set_maxeval(self._config.evaluations)
        optimiser.set_xtol_rel(self._config.x_tolerance)
        optimiser.set_ftol_abs(self._config.f_tolerance)
        arm, reach_m, points, settings, best = self._arm, self._reach_m, self._points, self._settings, self._best

        def objective(joints: FloatArray, gradient: FloatArray) -> float:
            return evaluate(arm, reach_m, points, settings, best, joints, gradient)  # type: ignore[no-any-return]

        optimiser.set_min_objective(objective)
        return optimiser


# Before version 2.11 a failure was Python's own RuntimeError.
_FAILURES = (RuntimeError, nlopt.RoundoffLimited, getattr(nlopt, "runtime_error", RuntimeError))
_SUCCESSES = (nlopt.SUCCESS, nlopt.STOPVAL_REACHED, nlopt.FTOL_REACHED, nlopt.XTOL_REACHED)
