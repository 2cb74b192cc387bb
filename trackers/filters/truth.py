"""The truth starts every frame: what a tracker makes of a frame when nothing before it went wrong.

The error of a row run with it is a floor: that of the best estimate near the true state, which is what the masks allow
and no tracker without the truth is to be ranked against.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from surgbench.contract import Plugin, Scene
from surgbench.geometry import FloatArray


class TruthFilter(Plugin):
    """Hands out the true state of the frame to come."""

    name: ClassVar[str] = "truth"
    summary: ClassVar[str] = "the true state starts every frame: for measuring floors, NOT for ranking (generated data)"
    needs_truth: ClassVar[bool] = True

    def give_truth(self, states: FloatArray) -> None:
        """Remember the true states, ``(T, 9 * arms)``."""
        self._states: FloatArray = np.array(states, dtype=np.float64)

    def reset(self, scene: Scene, state: FloatArray) -> None:
        """Start at the first frame."""
        self._frame = 0

    def predict(self) -> FloatArray:
        """The true state of the next frame; of the last one where there are no more."""
        self._frame = min(self._frame + 1, len(self._states) - 1)
        return self._now()

    def update(self, estimate: FloatArray) -> FloatArray:
        """Take no notice of the estimate; returns the true state."""
        return self._now()

    def _now(self) -> FloatArray:
        return np.array(self._states[self._frame])
