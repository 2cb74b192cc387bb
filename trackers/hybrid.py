"""Our tracker: robust Gauss-Newton on the contour with a motion belief, and a search for what it may have missed.

Three things make it accurate. The contour's residuals and Jacobians are exact (no pixels are rendered), so that a few
Gauss-Newton steps reach the optimum to a small part of a pixel. A belief of constant velocity with all its
correlations takes part in the estimate. And where the silhouette leaves edges unexplained (a jaw that has slipped
behind the other, a fast turn about the shaft), other states are drawn around the estimate, scored by eq. 5, evolved for
a few generations of CMA-ES, refined, and followed beside it as hypotheses of their own until the masks decide.

Of two arms each is held against what the other does not hide, and both are fitted together.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from surgbench.contract import Estimate, InstrumentTracker, Observation, Scene, Trace
from surgbench.geometry import FloatArray
from surgbench.trackers.registration.options import HybridOptions
from surgbench.trackers.registration.pair import Pair
from surgbench.trackers.registration.seeker import Seeker


class HybridTracker(InstrumentTracker):
    """Follows the contour, and looks elsewhere when it does not fit."""

    name: ClassVar[str] = "hybrid"
    summary: ClassVar[str] = "ours: Gauss-Newton on the contour, evolution where it leaves edges unexplained"

    class Config(HybridOptions):
        """Options."""

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()
        self.trace: Trace | None = None

    def reset(self, scene: Scene, state: FloatArray, rng: np.random.Generator) -> None:
        """Prepare the scorer, the fit and the belief."""
        self._arms = Seeker(scene, state, self.config, rng) if scene.arms == 1 else Pair(scene, state, self.config, rng)

    def step(self, observation: Observation) -> Estimate:
        """Follow every hypothesis; search where the best leaves edges unexplained; report the best."""
        self._arms.trace = self.trace
        estimate: Estimate = self._arms.step(observation)
        return estimate

    @property
    def shape(self) -> FloatArray:
        """``(m,)`` what was learned so far of instruments and camera (:class:`Shape`), by the best story."""
        shape: FloatArray = self._arms.shape
        return shape
