"""Adam (D. P. Kingma and J. Ba, "Adam: A Method for Stochastic Optimization", ICLR 2015)."""

from __future__ import annotations

import numpy as np

from surgbench.geometry import FloatArray

EPSILON = 1e-8


class Adam:
    """One descent. The size of the gradient does not matter, only how steady it is.

    Args:
        point: ``(d,)`` where it begins.
        learning_rate: The most that a component moves in a step, about.
        decay: How much of the means of the gradient and of its square is kept at each step.
    """

    def __init__(self, point: FloatArray, learning_rate: float, decay: tuple[float, float] = (0.9, 0.999)) -> None:
        self.point: FloatArray = np.array(point, dtype=np.float64)
        self._rate = learning_rate
        self._decay = decay
        self._mean: FloatArray = np.zeros_like(self.point)
        self._square: FloatArray = np.zeros_like(self.point)
        self._steps = 0

    def tell(self, gradient: FloatArray) -> None:
        """Take a step, given the ``(d,)`` gradient at :attr:`point`; components that are not finite count as zero."""
        slope = np.where(np.isfinite(gradient), gradient, 0.0)
        first, second = self._decay
        self._steps += 1
        self._mean = first * self._mean + (1 - first) * slope
        self._square = second * self._square + (1 - second) * slope**2
        mean = self._mean / (1 - first**self._steps)
        square = self._square / (1 - second**self._steps)
        self.point = self.point - self._rate * mean / (np.sqrt(square) + EPSILON)
