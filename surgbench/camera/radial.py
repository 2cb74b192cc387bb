"""How far from the axis a lens sees a ray, and back: the part of its model that depends on the distance alone."""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial import Polynomial

from surgbench.geometry import FloatArray

# Inverses begin in a table of so many steps, and are made exact by so many steps of Newton's.
_STEPS, _NEWTON = 8192, 12
# Relative: how far a root may be from a real one, and how far before it the limit is.
_REAL = 1e-9


class Radial:
    """``t N(t^2) / D(t^2)`` from 0 to where it no longer grows.

    OpenCV's models are such functions: of a ray's tangent in the common one, of its angle in the fisheye's.

    Args:
        numerator: Coefficients of N, from the constant on.
        denominator: Coefficients of D.
        furthest: The function is not looked at beyond.

    Attributes:
        limit: The last ``t``, at most ``furthest``: the model folds the picture over from there on.
    """

    def __init__(self, numerator: list[float], denominator: list[float], furthest: float) -> None:
        self._numerator, self._denominator = Polynomial(numerator), Polynomial(denominator)
        self.limit = self._limit(furthest)
        self._table = np.linspace(0.0, self.limit, _STEPS + 1)
        self._values = self(self._table)

    def __call__(self, t: FloatArray) -> FloatArray:
        """The function at ``t``, any shape."""
        square = t * t
        value: FloatArray = t * self._numerator(square) / self._denominator(square)
        return value

    def inverse(self, values: FloatArray) -> FloatArray:
        """Where the function has values ``>= 0``, any shape; the limit where it has none so large."""
        after = np.clip(np.searchsorted(self._values, values), 1, _STEPS)
        low, high = self._table[after - 1], self._table[after]
        t = np.clip(np.interp(values, self._values, self._table), low, high)
        for _ in range(_NEWTON):
            slope = self._slope(t)
            step = np.divide(values - self(t), slope, out=np.zeros_like(t), where=slope > 0)
            t = np.clip(t + step, low, high)
        return np.asarray(t)

    def _slope(self, t: FloatArray) -> FloatArray:
        square = t * t
        below = self._denominator(square)
        slope: FloatArray = self._growth()(square) / (below * below)
        return slope

    def _growth(self) -> Polynomial:
        """Numerator of the derivative, of ``t^2``: ``N D + 2 t^2 (N' D - N D')``."""
        above, below = self._numerator, self._denominator
        turn = above.deriv() * below - above * below.deriv()
        growth: Polynomial = above * below + Polynomial([0.0, 2.0]) * turn
        return growth

    def _limit(self, furthest: float) -> float:
        """Where it first stops to grow, or has a pole."""
        # Of shares of the furthest, so that coefficients too small to matter are seen to be.
        scale = Polynomial([0.0, furthest**2])
        ends = [furthest]
        for polynomial in (self._growth()(scale), self._denominator(scale)):
            roots = polynomial.trim(_REAL**2 * np.abs(polynomial.coef).max()).roots()
            real = roots[np.abs(roots.imag) <= _REAL * np.abs(roots)].real
            ends += [math.sqrt(share) * furthest * (1 - _REAL) for share in real if share > 0]
        return min(ends)
