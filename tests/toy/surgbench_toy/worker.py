"""The process that trackers run in."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from surgbench.processes.service import Tell, serve_parent
from surgbench.randomness import generator
from surgbench.registry import create, find
from surgbench.suite.settings import Plug


def run(tell: Tell, plug: Plug, first: float, values: list[float]) -> tuple[Any, ...]:
    """``("answers", what the tracker said, milliseconds each)``."""
    tracker = create(find("tracker", plug.reference), plug.options)
    tracker.reset(None, np.array([first]), generator(tracker=plug.name))
    answers, times = [], []
    for value in values:
        begin = time.perf_counter()
        answers.append(float(tracker.step(value)))
        times.append(1e3 * (time.perf_counter() - begin))
    return ("answers", answers, times)


if __name__ == "__main__":
    serve_parent(run)
