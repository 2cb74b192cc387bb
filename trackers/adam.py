"""Gradient descent on the exact gradient of the silhouette, for the baseline GD (NvDiffRast) of Hu et al. 2026."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from surgbench.contract import Scene
from surgbench.geometry import FloatArray
from surgbench.objective import Objective
from surgbench.search.descent import Descent, DescentConfig, DescentTracker
from surgbench.trackers.optimisers.adam import Adam


class AdamTracker(DescentTracker):
    """Adam on the gradient of the area integral behind the pixel counts."""

    name: ClassVar[str] = "adam"
    summary: ClassVar[str] = "gradient descent with Adam on silhouettes and tips, the baseline of Hu et al. 2026"

    class Config(DescentConfig):
        """Options; the defaults are those of the released code, but for its mistake."""

        released_iterate: Annotated[
            bool,
            Field(
                description="two arms with a mask each: both are estimated where the left one alone fits best, as by a "
                "mistake in the paper's code"
            ),
        ] = False
        pair_options: ClassVar[tuple[str, ...]] = ("released_iterate",)

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()
        super().__init__(self.config)

    def _differentiable(self, scene: Scene, rng: np.random.Generator) -> Objective:
        return Objective(scene, self.config.loss)

    def _descent(self, start: FloatArray) -> Descent:
        descent: Descent = Adam(start, self.config.learning_rate)
        return descent

    def _best(self, states: FloatArray, losses: FloatArray) -> int:
        if self.config.released_iterate and self._pair is not None and self._pair.tells_apart:
            return int(np.argmin(self._pair.arms(states)[0][:, 0]))
        return super()._best(states, losses)
