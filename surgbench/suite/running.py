"""One call of ``run`` while it is under way: the children at work, and who is told how far they are."""

from __future__ import annotations

import contextlib
import statistics
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from surgbench.processes.child import Child, ChildProblemError


class Run:
    """What goes on in one call, shared by all of its jobs, which may run in several threads.

    Args:
        advance: Takes the frames done since.
        stage: Takes a description and a fraction while something that frames do not count goes on.
        folder: Where child processes are to be, as files are named as seen from there; ``None``: where this one is.

    Attributes:
        done: Frames that have been done.
    """

    def __init__(
        self,
        advance: Callable[[float], None] = lambda frames: None,
        stage: Callable[[str, float], None] = lambda description, fraction: None,
        folder: str | None = None,
    ) -> None:
        self._folder = folder
        self.stage = stage
        self.done = 0.0
        self._advance = advance
        self._stopping = threading.Event()
        self._children: set[Child] = set()
        self._calibration_ms: list[float] = []

    def part(self) -> Run:
        """The same run with a count of its own, for one job."""
        part = Run(self.advance, self.stage, self._folder)
        part._stopping, part._children = self._stopping, self._children
        return part

    def advance(self, frames: float) -> None:
        """So many more frames have been done."""
        self.done += frames
        self._advance(frames)

    @property
    def calibration_ms(self) -> float | None:
        """What the reference work took in the children, the median of all turns; ``None`` where it was not timed."""
        return statistics.median(self._calibration_ms) if self._calibration_ms else None

    @property
    def stopping(self) -> bool:
        """Whether nothing new is to be begun."""
        return self._stopping.is_set()

    def stop(self) -> None:
        """Begin nothing new."""
        self._stopping.set()

    def kill(self) -> None:
        """Begin nothing new, and end what is in work at once."""
        self.stop()
        for child in list(self._children):
            child.kill()

    def check(self) -> None:
        """See that there is something to go on for.

        Raises:
            ChildProblemError: The run is being ended.
        """
        if self.stopping:
            raise ChildProblemError("failed", "stopped")

    @contextmanager
    def child(self, module: str, timeout_s: float, memory: str | None = None) -> Iterator[Child]:
        """A child process that is ended with the block, or with the run.

        Before and after the block the reference work (:mod:`surgbench.processes.reference_work`) is timed in it.

        Args:
            module: What it runs.
            timeout_s: The longest silence that is waited for.
            memory: How much it may use, as ``"2 GB"``.

        Raises:
            ChildProblemError: The run is being ended.
        """
        self.check()
        child = Child(timeout_s, module, memory=memory, folder=self._folder)
        self._children.add(child)
        try:
            self.check()  # it may have been ended while the process began
            self._calibration_ms += child.calibrate()
            yield child
            with contextlib.suppress(ChildProblemError):  # nothing that the run was about
                self._calibration_ms += child.calibrate()
        finally:
            self._children.discard(child)
            child.stop()
