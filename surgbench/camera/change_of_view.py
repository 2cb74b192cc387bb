"""States as another camera would count them, and derivatives carried back from there."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.state import STATE_SIZE

_compiled = compiled(makes_arrays=True)

# Where the shaft stands along a view's y axis, beta and gamma are one angle: below this cosine of alpha, gamma is 0,
# and the rates are taken as if the cosine were this.
LEAST_COSINE = 1e-9


class ChangeOfView:
    """From the reference camera's frame, in which states are given, to the frame of another camera.

    The joints are the same in every view. A view in the reference camera's own place gets the states as they are, to
    the last bit.

    Args:
        T_view_cam: ``(4, 4)`` from the reference camera's frame to the view's.

    Example:
        A camera turned by a quarter about its own axis has its y axis where the other's x axis is, and sees the
        instrument turned by as much.

        >>> import numpy as np
        >>> from surgbench.camera.change_of_view import ChangeOfView
        >>> change = ChangeOfView(np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
        >>> moved = change.states(np.array([0, 0, 0, 0.01, 0, 0.13, 0.2, -0.1, 0.3]))
        >>> moved[1:].round(3)  # all but alpha, which stays 0
        array([ 1.571,  0.   ,  0.   ,  0.01 ,  0.13 ,  0.2  , -0.1  ,  0.3  ])
    """

    def __init__(self, T_view_cam: FloatArray) -> None:
        self._T = np.array(T_view_cam, dtype=np.float64, order="C")
        self._same = bool(np.array_equal(self._T, np.eye(4)))

    def states(self, states: FloatArray) -> FloatArray:
        """States ``(..., 9 * arms)`` of the reference frame as states of the view's."""
        if self._same:
            return states
        moved = np.array(states, dtype=np.float64, order="C")
        _move(moved.reshape(-1, STATE_SIZE), self._T)
        return moved

    def pull_back(self, states: FloatArray, gradient: FloatArray) -> FloatArray:
        """Derivative with respect to states of a function of the states that :meth:`states` makes of them.

        Both rates of the angles give the same angular velocity w: ``w = J(angles) d(angles)/dt`` in the reference
        frame, and ``R_view_cam w`` in the view's.

        Args:
            states: ``(n, 9 * arms)`` of the reference frame, or one state ``(9 * arms,)`` for all derivatives.
            gradient: ``(n, 9 * arms)`` derivatives with respect to the view's states.

        Returns:
            ``(n, 9 * arms)``.

        Example:
            What grows with y in the turned camera of :class:`ChangeOfView` grows with x in the reference camera.

            >>> import numpy as np
            >>> from surgbench.camera.change_of_view import ChangeOfView
            >>> change = ChangeOfView(np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
            >>> state = np.array([0, 0, 0, 0.01, 0, 0.13, 0.2, -0.1, 0.3])
            >>> change.pull_back(state, np.array([[0, 0, 0, 0, 2.0, 0, 0, 0, 0]]))
            array([[0., 0., 0., 2., 0., 0., 0., 0., 0.]])
        """
        if self._same:
            return gradient
        pulled = np.array(gradient, dtype=np.float64, order="C")
        here = np.array(states, dtype=np.float64, order="C")
        _pull(here.reshape(-1, STATE_SIZE), self._T, pulled.reshape(-1, STATE_SIZE))
        return pulled


@_compiled
def _turned(state: Any, T: Any, R: Any) -> None:
    """Rotation of a state in the view's frame."""
    sa, sb, sg = math.sin(state[0]), math.sin(state[1]), math.sin(state[2])
    ca, cb, cg = math.cos(state[0]), math.cos(state[1]), math.cos(state[2])
    for i in range(3):
        x, y, z = T[i, 0], T[i, 1], T[i, 2]
        R[i, 0] = x * (cg * cb + sg * sa * sb) + y * ca * sb + z * (-sg * cb + cg * sa * sb)
        R[i, 1] = x * (-cg * sb + sg * sa * cb) + y * ca * cb + z * (sg * sb + cg * sa * cb)
        R[i, 2] = x * sg * ca - y * sa + z * cg * ca


@_compiled
def _move(states: Any, T: Any) -> None:
    R = np.empty((3, 3))
    for k in range(states.shape[0]):
        state = states[k]
        _turned(state, T, R)
        cosine = math.hypot(R[1, 0], R[1, 1])
        state[0] = math.atan2(-R[1, 2], cosine)
        if cosine >= LEAST_COSINE:
            state[1] = math.atan2(R[1, 0], R[1, 1])
            state[2] = math.atan2(R[0, 2], R[2, 2])
        else:
            state[1] = math.atan2(-R[0, 1], R[0, 0])
            state[2] = 0.0 * cosine  # not a number stays none
        x, y, z = state[3], state[4], state[5]
        for i in range(3):
            state[3 + i] = T[i, 0] * x + T[i, 1] * y + T[i, 2] * z + T[i, 3]


@_compiled
def _rates(state: Any, T: Any, R: Any, rates: Any) -> None:
    """``(3, 3)`` derivatives of the view's angles with respect to the reference frame's."""
    _turned(state, T, R)
    cosine = math.hypot(R[1, 0], R[1, 1])
    # Ry(gamma) z of the view's gamma: the shaft's axis laid into the plane of x and z.
    sg, cg = (R[0, 2] / cosine, R[2, 2] / cosine) if cosine >= LEAST_COSINE else (0.0, 1.0)
    least = max(cosine, LEAST_COSINE)
    for j in range(3):
        # Axes about which alpha, beta and gamma turn, in the reference frame: Ry(gamma) x, the shaft, and y.
        if j == 0:
            x, y, z = math.cos(state[2]), 0.0, -math.sin(state[2])
        elif j == 1:
            ca = math.cos(state[0])
            x, y, z = math.sin(state[2]) * ca, -math.sin(state[0]), math.cos(state[2]) * ca
        else:
            x, y, z = 0.0, 1.0, 0.0
        u = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z
        v = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z
        w = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z
        rates[0, j] = cg * u - sg * w
        rates[1, j] = (sg * u + cg * w) / least
        rates[2, j] = v - R[1, 2] * rates[1, j]


@_compiled
def _pull(states: Any, T: Any, gradients: Any) -> None:
    R, rates = np.empty((3, 3)), np.empty((states.shape[0], 3, 3))
    for k in range(states.shape[0]):
        _rates(states[k], T, R, rates[k])
    for k in range(gradients.shape[0]):
        # One state of some arms may stand for all: its arms come round again and again.
        rate, g = rates[k % states.shape[0]], gradients[k]
        a, b, c = g[0], g[1], g[2]
        x, y, z = g[3], g[4], g[5]
        for j in range(3):
            g[j] = a * rate[0, j] + b * rate[1, j] + c * rate[2, j]
            g[3 + j] = x * T[0, j] + y * T[1, j] + z * T[2, j]


def angle_rates(angles_rad: FloatArray) -> FloatArray:
    """``(..., 3, 3)``: rates of ``(..., 3)`` look-at angles, a row each, for an angular velocity in their frame.

    Example:
        Of a shaft along the optical axis: alpha turns it about x, beta about z, and gamma about y.

        >>> import numpy as np
        >>> from surgbench.camera.change_of_view import angle_rates
        >>> angle_rates(np.zeros(3)) @ [0.1, 0.2, 0.3]  # rad/s
        array([0.1, 0.3, 0.2])
    """
    alpha, gamma = angles_rad[..., 0], angles_rad[..., 2]
    zero, one = np.zeros_like(gamma), np.ones_like(gamma)
    level = np.stack([np.sin(gamma), zero, np.cos(gamma)], axis=-1)
    beta_rate = level / np.maximum(np.cos(alpha), LEAST_COSINE)[..., None]
    gamma_rate = np.stack([zero, one, zero], axis=-1) + np.sin(alpha)[..., None] * beta_rate
    return np.stack([np.stack([np.cos(gamma), zero, -np.sin(gamma)], axis=-1), beta_rate, gamma_rate], axis=-2)
