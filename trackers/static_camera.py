"""The camera that stays where it is: the stationary auxiliary camera (STAT) of the article on AutoCam."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.viewpoint.contract import ViewpointObservation, ViewpointScene, ViewpointTracker


class StaticCamera(ViewpointTracker):
    """Stays where it started, whatever the feature does."""

    name: ClassVar[str] = "static"
    summary: ClassVar[str] = "stays where it started: the stationary auxiliary camera"

    def reset(self, scene: ViewpointScene, joints: FloatArray, rng: np.random.Generator) -> None:
        """Remember where."""
        self._joints = scene.arm.clip(joints)

    def step(self, observation: ViewpointObservation) -> FloatArray:
        """Say it again."""
        return self._joints.copy()
