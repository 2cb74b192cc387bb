"""One tracker."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from surgbench.geometry import FloatArray


class Counter:
    """Says one more than the last number; the first one is any."""

    name: ClassVar[str] = "counter"
    summary: ClassVar[str] = "one more than the last number"
    task: ClassVar[str] = "counting"

    def reset(self, scene: None, state: FloatArray, rng: np.random.Generator) -> None:
        """Begin at a number."""
        self._last = float(state[0])

    def step(self, observation: float) -> float:
        """What comes now, before it is seen."""
        answer, self._last = self._last + 1, observation
        return answer
