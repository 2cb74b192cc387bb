"""No tips: the mask alone."""

from __future__ import annotations

from typing import ClassVar

from surgbench.contract import Observation, Plugin, Scene, View
from surgbench.geometry import FloatArray


class NoKeypoints(Plugin):
    """Withholds the tips, so that a tracker has the mask alone."""

    name: ClassVar[str] = "none"
    summary: ClassVar[str] = "no tips: trackers see the mask alone"

    def reset(self, scene: Scene) -> None:
        """Nothing to prepare."""

    def detect(self, observation: Observation, view: View) -> tuple[FloatArray | None, ...]:
        """Nothing for every arm."""
        return (None,) * len(view.keypoints)
