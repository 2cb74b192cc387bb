"""TuRBO-1: Bayesian optimisation in a trust region, ask and tell.

Eriksson et al., "Scalable Global Optimization via Local Bayesian Optimization" (NeurIPS 2019, arXiv:1910.01739). The
Gaussian process is BoTorch's; everything random is drawn from the generator that is handed in. Needs the extra
``turbo``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from surgbench.geometry import FloatArray
from surgbench.processes.torch_threads import one_thread
from surgbench.trackers.optimisers.gaussian_process import GaussianProcess
from surgbench.trackers.optimisers.trust_region import TrustRegion, largest_offset

PERTURBED = 20  # coordinates of a candidate that differ from the best point's, on average, at most
MODELLED = 200  # points nearest to the best that the Gaussian process is made of: its time grows with their cube


class Turbo:
    """Minimises a function on the unit cube whose coordinates may be periodic.

    A periodic coordinate (an angle over a full turn) goes into the Gaussian process as a point on a circle, and the
    trust region reaches across the seam.

    Args:
        periodic: ``(d,)`` which coordinates are.
        batch: Points to be evaluated at a time, and before the first Gaussian process.
        rng: The only source of randomness.
    """

    def __init__(self, periodic: NDArray[np.bool_], batch: int, rng: np.random.Generator) -> None:
        self._periodic = np.asarray(periodic, dtype=bool)
        self._batch = batch
        self._rng = rng
        self._begin()

    def _begin(self) -> None:
        d = len(self._periodic)
        self.region = TrustRegion(d, self._batch)
        self._points: FloatArray = np.empty((0, d))
        self._values: FloatArray = np.empty(0)
        self._model: GaussianProcess | None = None

    def ask(self) -> FloatArray:
        """``(batch, d)`` points of the unit cube to evaluate."""
        if not len(self._points):
            return np.asarray(qmc.LatinHypercube(len(self._periodic), rng=self._rng).random(self._batch))
        with one_thread():
            near = self._near_best()
            self._model = GaussianProcess(self._points[near], self._values[near], self._periodic, self._model)
            candidates = self._candidates(self._model.lengths)
            draws = self._model.sample(candidates, self._rng.standard_normal((self._batch, len(candidates))))
        taken: list[int] = []
        for draw in draws:  # Thompson sampling, no candidate twice
            draw[taken] = np.inf
            taken.append(int(np.argmin(draw)))
        asked: FloatArray = candidates[taken]
        return asked

    def tell(self, points: FloatArray, values: FloatArray) -> None:
        """Take a batch in; a trust region that has collapsed is left, and the next batch begins a new one.

        Args:
            points: ``(n, d)`` as asked for.
            values: ``(n,)``; those that are not finite count as the worst of the others.
        """
        finite = np.isfinite(values)
        worst = float(np.max(values[finite])) if finite.any() else 0.0
        values = np.where(finite, values, worst)
        self._points = np.concatenate([self._points, points])
        self._values = np.concatenate([self._values, values])
        self.region.update(values)
        if self.region.collapsed:
            self._begin()

    def _near_best(self) -> NDArray[np.intp]:
        """Which points the model is made of."""
        away = largest_offset(self._points, self._points[int(np.argmin(self._values))], self._periodic)
        return np.argsort(away, kind="stable")[:MODELLED]

    def _candidates(self, lengths: FloatArray) -> FloatArray:
        """Sobol points of the trust region: longer where the function changes slowly."""
        d = len(self._periodic)
        centre = self._points[int(np.argmin(self._values))]
        side = self.region.length * lengths / np.exp(np.mean(np.log(lengths)))
        side = np.where(self._periodic, np.minimum(side, 1.0), side)
        wanted = max(min(100 * d, 5000), 2 * self._batch)
        count = 1 << (wanted - 1).bit_length()  # Sobol points come in powers of two
        spread = qmc.Sobol(d, rng=self._rng).random(count)
        lower, upper = centre - side / 2, centre + side / 2
        lower = np.where(self._periodic, lower, np.maximum(lower, 0.0))
        upper = np.where(self._periodic, upper, np.minimum(upper, 1.0))
        points = lower + (upper - lower) * spread
        moved = self._rng.random((count, d)) < min(PERTURBED / d, 1.0)
        moved[np.arange(count), self._rng.integers(d, size=count)] = True
        points = np.where(moved, points, centre)
        wrapped: FloatArray = np.where(self._periodic, np.mod(points, 1.0), points)
        return wrapped
