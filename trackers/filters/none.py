"""No filter: the last estimate starts the next frame."""

from __future__ import annotations

from typing import ClassVar

from surgbench.contract import Plugin, Scene
from surgbench.geometry import FloatArray
from surgbench.state import clip_joints


class NoFilter(Plugin):
    """Passes the last estimate on, joints clamped to their limits."""

    name: ClassVar[str] = "none"
    summary: ClassVar[str] = "the last estimate starts the next frame"

    def reset(self, scene: Scene, state: FloatArray) -> None:
        """Start at ``state``, ``(9 * arms,)``."""
        self._limits = scene.joint_limits
        self._state = clip_joints(state, self._limits)

    def predict(self) -> FloatArray:
        """The last estimate."""
        return self._state.copy()

    def update(self, estimate: FloatArray) -> FloatArray:
        """Remember a frame's estimate."""
        self._state = clip_joints(estimate, self._limits)
        return self._state.copy()
