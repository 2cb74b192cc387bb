"""How fast this machine is: a piece of work that never changes, timed beside every run.

It resembles what trackers do, each third of its time on one of: scan lines through polygons with reads from a table of
a mask's sums (compiled, branches and memory), small dense linear algebra call by call from Python, and a larger product
of single-precision matrices, as of a network's layers. It uses none of the engine's own code, which becomes faster from
version to version.
"""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray

TURNS = 5
_POLYGONS, _CORNERS, _ROWS, _COLUMNS = 40, 24, 480, 700
_SMALL, _SAMPLES, _LARGE = 9, 70, 320
# How often, so that each takes a third of the time.
_SCANS, _SYSTEMS, _PRODUCTS = 29, 130, 5


@compiled
def _scan(polygons: FloatArray, sums: NDArray[np.int32], crossings: FloatArray) -> int:
    """Sum of the table between each row's first and last crossing of each polygon."""
    total = 0
    rows = sums.shape[0]
    width = sums.shape[1] - 1
    for polygon in range(len(polygons)):
        corners = polygons[polygon]
        crossings[:, 0] = width
        crossings[:, 1] = 0.0
        for corner in range(len(corners)):
            u0, v0 = corners[corner - 1, 0], corners[corner - 1, 1]
            u1, v1 = corners[corner, 0], corners[corner, 1]
            if v0 > v1:
                u0, v0, u1, v1 = u1, v1, u0, v0
            if v1 - v0 < 1e-9:
                continue
            slope = (u1 - u0) / (v1 - v0)
            for row in range(max(0, int(np.ceil(v0))), min(rows, int(np.ceil(v1)))):
                u = min(max(u0 + slope * (row - v0), 0.0), float(width))
                crossings[row, 0] = min(crossings[row, 0], u)
                crossings[row, 1] = max(crossings[row, 1], u)
        for row in range(rows):
            first, last = int(crossings[row, 0]), int(crossings[row, 1])
            if last > first:
                total += sums[row, last] - sums[row, first]
    return total


class ReferenceWork:
    """The piece of work, on data that are the same everywhere."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        mask = rng.random((_ROWS, _COLUMNS)) < 0.5
        self._sums = np.zeros((_ROWS, _COLUMNS + 1), np.int32)
        np.cumsum(mask, axis=1, out=self._sums[:, 1:])
        angles = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False) + rng.random((_POLYGONS, 1))
        radii = rng.uniform(60.0, 200.0, (_POLYGONS, _CORNERS))
        circles = radii[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        self._polygons: FloatArray = circles + np.array([_COLUMNS / 2, _ROWS / 2])
        self._crossings = np.empty((_ROWS, 2))
        self._samples = rng.standard_normal((_SAMPLES, _SMALL))
        self._large = rng.standard_normal((_LARGE, _LARGE)).astype(np.float32)

    def __call__(self) -> None:
        """Do it once."""
        for _ in range(_SCANS):
            _scan(self._polygons, self._sums, self._crossings)
        for _ in range(_SYSTEMS):
            normal = self._samples.T @ self._samples
            np.linalg.solve(normal, self._samples[0])
            np.linalg.eigh(normal)
        for _ in range(_PRODUCTS):
            self._large @ self._large


def measure_ms(turns: int = TURNS) -> list[float]:
    """Milliseconds of some turns of the work on one thread, each by itself.

    What it needs is compiled, loaded and in the caches before the first.
    """
    work = ReferenceWork()
    work()
    times = []
    for _ in range(turns):
        begin = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - begin))
    return times
