"""A run as pictures, frame by frame: what is asked of a task whose runs can be seen."""

from __future__ import annotations

from typing import Protocol

from surgbench.report.drawing import Picture


class Filmed(Protocol):
    """One run; :meth:`surgbench.task.Task.filmed` makes it."""

    @property
    def frames(self) -> int:
        """How many there are to draw, from 0."""
        ...

    @property
    def dt_s(self) -> float:
        """Seconds from frame to frame."""
        ...

    @property
    def every(self) -> int:
        """Frames from one picture of a film to the next, as suits the task."""
        ...

    @property
    def legend(self) -> str:
        """What is seen in the pictures, and what its colours mean, in one line."""
        ...

    def picture(self, frame: int) -> Picture:
        """One frame, ``(height, width, 3)`` uint8 RGB, of the same even size for all."""
        ...
