"""How fast a dataset is made on this machine: the beginning of it, made in a temporary folder."""

from __future__ import annotations

import tempfile
import time
from contextlib import suppress
from pathlib import Path

from surgbench.generation import GenerationPlan
from surgbench.processes.pool import ProcessPool

# So long the work is watched once its first part is done.
WATCH_S = 3.0


class _EnoughError(Exception):
    """Enough was seen."""


def frame_seconds(plan: GenerationPlan) -> float:
    """Seconds of one process for each frame or sample, of the first that are made."""
    marks: list[tuple[float, float]] = []

    def mark(frames: float) -> None:
        marks.append((time.monotonic(), frames))
        if marks[-1][0] - marks[0][0] > WATCH_S:
            raise _EnoughError

    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, suppress(_EnoughError):
        plan.write(Path(folder), ProcessPool(), mark)
    if len(marks) < 2:
        return (time.monotonic() - began) / max(1.0, sum(frames for _, frames in marks))
    return (marks[-1][0] - marks[0][0]) / sum(frames for _, frames in marks[1:])
