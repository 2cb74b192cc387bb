"""What the trackers have in common that follow the gradient from the start of each frame."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Literal, Protocol

import numpy as np
from pydantic import Field

from surgbench.contract import Estimate, InstrumentTracker, Observation, Scene, Trace
from surgbench.geometry import FloatArray
from surgbench.objective import LossWeights, Objective
from surgbench.pair_objective import PairObjective
from surgbench.search.arms import fit_of_arms
from surgbench.search.pair_options import WithPairOptions
from surgbench.search.spaces import SearchSpaces
from surgbench.state import JointLimits, clip_joints

# A joint on its limit has no slope in the search space, and would stay there: keep this share of its range away.
MARGIN = 1e-6


class Descent(Protocol):
    """One frame's descent.

    Attributes:
        point: ``(9 * arms,)`` where in the search space it has come to.
    """

    point: FloatArray

    def tell(self, gradient: FloatArray) -> None:
        """Take a step, given the gradient at :attr:`point`."""
        ...


class DescentConfig(WithPairOptions):
    """Options; the defaults are those of the released code of Hu et al. 2026."""

    iterations: Annotated[int, Field(ge=1, description="steps a frame")] = 10
    learning_rate: Annotated[float, Field(gt=0, description="size of a step, in the state's natural steps")] = 0.1
    estimate: Annotated[
        Literal["best", "last"], Field(description="the least loss on the descent's way, or where it ends")
    ] = "best"
    joints: Annotated[
        Literal["clamped", "cosine"],
        Field(description="kept within their limits by clipping, or by the cosine of eq. 11"),
    ] = "clamped"
    readings_scale: Annotated[
        float, Field(gt=0, description="factor on the joints' steps where readings are given")
    ] = 0.1
    jaw_step_rad: Annotated[float, Field(gt=0, description="natural step of q3, without readings")] = 0.1
    lost_iou: Annotated[float, Field(ge=0, le=1, description="an estimate that overlaps less is lost")] = 0.5
    loss: LossWeights = LossWeights(keypoint_form="released")


class DescentTracker(InstrumentTracker):
    """Gradient descent in the normalised state, begun anew in each frame.

    Two arms go down together, on their one mask. Their own masks, where there are any, tell how sure it is of each.
    """

    def __init__(self, config: DescentConfig) -> None:
        self._options = config
        self.trace: Trace | None = None

    def reset(self, scene: Scene, state: FloatArray, rng: np.random.Generator) -> None:
        """Prepare the loss and the search spaces."""
        self._objective = self._differentiable(scene, rng)
        self._pair = PairObjective(scene, self._options.loss) if scene.arms == 2 else None
        options = self._options
        self._spaces = SearchSpaces(scene, options.readings_scale, options.jaw_step_rad, options.joints == "clamped")
        limits = scene.joint_limits
        margin = MARGIN * (limits.upper_rad - limits.lower_rad)
        self._inner = JointLimits(limits.lower_rad + margin, limits.upper_rad - margin)

    @abstractmethod
    def _differentiable(self, scene: Scene, rng: np.random.Generator) -> Objective:
        """The loss, and how its gradient is computed."""

    @abstractmethod
    def _descent(self, start: FloatArray) -> Descent:
        """A descent that begins at ``start``, ``(9 * arms,)`` of the search space."""

    def step(self, observation: Observation) -> Estimate:
        """Descend from ``observation.start``."""
        self._objective.observe(observation)
        space = self._spaces.of(observation)
        descent = self._descent(space.encode(clip_joints(observation.start, self._inner)))
        states = [space.decode(descent.point)]
        for _ in range(self._options.iterations):
            gradient = self._objective.gradient(states[-1][None])[0]
            descent.tell(space.pull_back(descent.point, gradient))
            descent.point = space.nearest(descent.point)
            states.append(space.decode(descent.point))
        losses, ious = self._objective(np.array(states))
        if self._pair is not None:
            self._pair.observe(observation)
        chosen = -1 if self._options.estimate == "last" else self._best(np.array(states), losses)
        if self.trace is not None:
            self.trace.states += [state[None] for state in states]
            self.trace.losses += [loss[None] for loss in losses]
        if self._pair is not None:
            fit = fit_of_arms(self._pair, states[chosen])
            return Estimate(states[chosen], fit.confidence, fit.hidden | (fit.overlap < self._options.lost_iou))
        iou = float(ious[chosen])
        return Estimate(states[chosen], confidence=iou, lost=iou < self._options.lost_iou)

    def _best(self, states: FloatArray, losses: FloatArray) -> int:
        """Which of the states on a frame's way, ``(n, 9 * arms)`` with their losses ``(n,)``, is the estimate."""
        return int(np.argmin(losses))
