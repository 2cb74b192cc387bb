"""The tips that come with the dataset: noisy truth in generated data, marked or detected ones in recordings."""

from __future__ import annotations

from typing import ClassVar

from surgbench.contract import Observation, Plugin, Scene, View
from surgbench.geometry import FloatArray


class ObservedKeypoints(Plugin):
    """Passes on what the dataset holds."""

    name: ClassVar[str] = "observed"
    summary: ClassVar[str] = "the tips that the dataset holds, noise and drop-outs included"

    def reset(self, scene: Scene) -> None:
        """Nothing to prepare."""

    def detect(self, observation: Observation, view: View) -> tuple[FloatArray | None, ...]:
        """The view's own tips, one where the other is not known."""
        return view.tips
