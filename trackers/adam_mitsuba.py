"""Gradient descent through a general differentiable renderer, for the baseline GD (PyTorch3D) of Hu et al. 2026."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from surgbench.contract import Scene
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.objective import Objective
from surgbench.rendering.backends import cuda_problem, llvm_problem
from surgbench.search.descent import Descent, DescentConfig, DescentTracker
from surgbench.trackers.optimisers.adam import Adam
from surgbench.trackers.optimisers.projective import ProjectiveObjective


class AdamMitsubaTracker(DescentTracker):
    """``adam``, its gradient of the silhouette through Mitsuba: about a second for each step."""

    name: ClassVar[str] = "adam-mitsuba"
    summary: ClassVar[str] = "adam with Mitsuba's projective silhouette gradient: slow; needs LLVM 17 or a GPU"

    class Config(DescentConfig):
        """Options; the defaults are those of the released code."""

    def __init__(self, config: Config | None = None) -> None:
        self.config = config or self.Config()
        super().__init__(self.config)

    @classmethod
    def unavailable(cls) -> str | None:
        """Why it cannot run on this machine, in one line with what would help; ``None`` where it can."""
        llvm = llvm_problem()
        if llvm is None or (cuda := cuda_problem()) is None:
            return None
        return f"{llvm}; or a GPU ({cuda})"

    def _differentiable(self, scene: Scene, rng: np.random.Generator) -> Objective:
        problem = self.unavailable()
        if problem is not None:  # an LLVM that is too old would kill the process
            raise SurgbenchError(f"tracker '{self.name}' {problem}")
        cuda = (scene.device == "cuda" or llvm_problem() is not None) and cuda_problem() is None
        variant = "cuda_ad_rgb" if cuda else "llvm_ad_rgb"
        objective: Objective = ProjectiveObjective(scene, self.config.loss, variant, rng)
        return objective

    def _descent(self, start: FloatArray) -> Descent:
        descent: Descent = Adam(start, self.config.learning_rate)
        return descent
