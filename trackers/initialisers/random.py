"""Find the first state without a hint: random pose hypotheses, ranked, the best of them refined.

The hypothesis space is that of Liang et al. (:mod:`surgbench.trackers.initialisers.hypotheses`). They reach the
position in the image by gradient; here the wrist is placed over a random pixel of the mask instead. The
shaft dominates the silhouette, so that the first ranking finds it and little else; then the roll about it and
the joints are drawn anew around the best shafts, and thin parts of the mask are weighted up throughout.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from surgbench.contract import Observation, Plugin, Scene
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.objective import LossWeights
from surgbench.state import ANGLES, BETA, JOINTS, POSITION, JointLimits
from surgbench.trackers.initialisers.arms import initialise_each_arm
from surgbench.trackers.initialisers.hypotheses import DISTANCE_M, ELEVATION_DEG, Range, hypothesis_states
from surgbench.trackers.initialisers.refinement import WIDE, Refiner, Scorer

Count = Annotated[int, Field(ge=1)]

SHAFT_SLIP_M = 2e-3  # how well a shaft tells where along it the wrist is


class RandomInitialiser(Plugin):
    """Ranks random pose hypotheses by the tracking loss and refines the best by CMA-ES."""

    name: ClassVar[str] = "random"
    summary: ClassVar[str] = "pose hypotheses of Liang et al., ranked, the best refined: needs no hint"
    needs_truth: ClassVar[bool] = False

    class Config(BaseModel):
        """Options."""

        model_config = ConfigDict(frozen=True, extra="forbid")

        hypotheses: Annotated[Count, Field(description="random states that are ranked")] = 8192
        refined: Annotated[Count, Field(description="best hypotheses that are refined")] = 16
        shafts: Annotated[Count, Field(description="best of those, whose roll and joints are drawn anew")] = 2
        finalists: Annotated[Count, Field(description="best states that are refined to the end")] = 4
        generations: Annotated[tuple[int, int], Field(description="of a refinement, and of the last one")] = (20, 100)
        population: Annotated[int, Field(ge=4, description="samples a generation")] = 70
        distance_m: Annotated[Range, Field(description="of the wrist along the optical axis")] = DISTANCE_M
        elevation_deg: Annotated[Range, Field(description="tilt of the shaft against the optical axis")] = ELEVATION_DEG
        loss: LossWeights = LossWeights()

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()

    def initialise(
        self,
        scene: Scene,
        observation: Observation,
        rng: np.random.Generator,
        truth: FloatArray | None,
        progress: Callable[[float], None],
    ) -> FloatArray:
        """Search every arm in its own part of the mask.

        Raises:
            SurgbenchError: The first mask is empty, or two arms cannot be told apart in it.
        """

        def search(alone: Scene, frame: Observation, advance: Callable[[float], None]) -> FloatArray:
            return self._initialise_arm(alone, frame, rng, advance)

        return initialise_each_arm(scene, observation, progress, search)

    def _initialise_arm(
        self, scene: Scene, observation: Observation, rng: np.random.Generator, progress: Callable[[float], None]
    ) -> FloatArray:
        config = self.config
        drawn = scene.instruments[0].generate_limits
        short, long = config.generations
        refinements = (2 * config.refined + config.shafts) * short + config.finalists * long
        work = 2 * config.hypotheses + config.population * refinements
        score = Scorer(scene, observation, config.loss, work, progress)
        refine = Refiner(scene, observation, score, config.population, rng)
        coarse = score.best(self._draw(observation, drawn, rng), config.refined)
        shafts = refine(coarse, WIDE, short, config.shafts)
        anew = score.best(self._draw_anew(shafts, observation, drawn, rng), config.refined)
        candidates = np.concatenate([shafts, anew])
        finalists = refine(candidates, WIDE, short, config.finalists)
        best: FloatArray = refine(finalists, 1.0, long, 1)[0]
        return best

    def _draw_anew(
        self, shafts: FloatArray, observation: Observation, limits: JointLimits, rng: np.random.Generator
    ) -> FloatArray:
        """``(hypotheses, 9)`` states on the given shafts, with another roll and other joints."""
        states = np.resize(shafts, (self.config.hypotheses, shafts.shape[1]))
        states[:, BETA] = rng.uniform(0.0, 2 * np.pi, len(states))
        along_shaft = look_at_rotation(states[:, ANGLES])[:, :, 2]
        states[:, POSITION] += rng.normal(0.0, SHAFT_SLIP_M, (len(states), 1)) * along_shaft
        states[:, JOINTS] = _draw_joints(observation, limits, len(states), rng)
        return states

    def _draw(self, observation: Observation, limits: JointLimits, rng: np.random.Generator) -> FloatArray:
        """``(hypotheses, 9)`` random states whose wrist projects onto the mask."""
        n = self.config.hypotheses
        roll_camera, roll_local = rng.uniform(0.0, 2 * np.pi, (2, n))
        elevation = np.deg2rad(rng.uniform(*self.config.elevation_deg, n))
        depth = rng.uniform(*self.config.distance_m, n)
        rows, columns = np.nonzero(observation.mask)
        pick = rng.integers(len(rows), size=n)
        joints = _draw_joints(observation, limits, n, rng)
        wrist = (columns[pick], rows[pick])
        return hypothesis_states(observation.views[0].camera, roll_camera, elevation, roll_local, depth, wrist, joints)


def _draw_joints(observation: Observation, limits: JointLimits, count: int, rng: np.random.Generator) -> FloatArray:
    """``(count, 3)``: the readings where there are any, else anything an instrument in use does."""
    if observation.joints is not None:
        return np.tile(observation.joints, (count, 1))
    return rng.uniform(limits.lower_rad, limits.upper_rad, (count, 3))
