"""Find the first state without a hint: random pose hypotheses, ranked, the best of them refined.

The hypothesis space is that of Liang et al. (:mod:`surgbench.search.hypotheses`). They reach the
position in the image by gradient; here the wrist is placed over a random pixel of the mask instead.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from surgbench.contract import Observation, Plugin, Scene
from surgbench.geometry import FloatArray
from surgbench.search.hypotheses import DISTANCE_M, ELEVATION_DEG, hypothesis_states
from surgbench.state import JointLimits
from surgbench.trackers.initialisers.arms import initialise_each_arm
from surgbench.trackers.initialisers.refinement import Count, RefinementConfig, Scorer, draw_joints, finish


class RandomInitialiser(Plugin):
    """Ranks random pose hypotheses by the tracking loss and refines the best by CMA-ES."""

    name: ClassVar[str] = "random"
    summary: ClassVar[str] = "pose hypotheses of Liang et al., ranked, the best refined: needs no hint"
    needs_truth: ClassVar[bool] = False

    class Config(RefinementConfig):
        """Options."""

        hypotheses: Annotated[Count, Field(description="random states that are ranked")] = 8192
        distance_m: Annotated[tuple[float, float], Field(description="of the wrist along the optical axis")] = (
            DISTANCE_M
        )
        elevation_deg: Annotated[
            tuple[float, float], Field(description="tilt of the shaft against the optical axis")
        ] = ELEVATION_DEG

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
        config = self.config

        def search(alone: Scene, frame: Observation, advance: Callable[[float], None]) -> FloatArray:
            score = Scorer(alone, frame, config.loss, config.hypotheses + config.work, advance)
            drawn = self._draw(frame, alone.instruments[0].generate_limits, rng)
            found: FloatArray = finish(alone, frame, score.best(drawn, config.refined), config, score, rng)
            return found

        states: FloatArray = initialise_each_arm(scene, observation, progress, search)
        return states

    def _draw(self, observation: Observation, limits: JointLimits, rng: np.random.Generator) -> FloatArray:
        """``(hypotheses, 9)`` random states whose wrist projects onto the mask."""
        n = self.config.hypotheses
        roll_camera, roll_local = rng.uniform(0.0, 2 * np.pi, (2, n))
        elevation = np.deg2rad(rng.uniform(*self.config.elevation_deg, n))
        depth = rng.uniform(*self.config.distance_m, n)
        rows, columns = np.nonzero(observation.mask)
        pick = rng.integers(len(rows), size=n)
        joints = draw_joints(observation, limits, n, rng)
        wrist = (columns[pick], rows[pick])
        camera = observation.views[0].camera
        states: FloatArray = hypothesis_states(camera, roll_camera, elevation, roll_local, depth, wrist, joints)
        return states
