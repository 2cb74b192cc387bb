"""States as another camera would count them, and derivatives carried back from there."""

from __future__ import annotations

import numpy as np

from surgbench.geometry import FloatArray, look_at_angles, look_at_rotation
from surgbench.state import ALPHA, ANGLES, GAMMA, POSITION, split_arms

# Where the shaft stands along a view's y axis, beta and gamma are one angle; their rates stay finite up to here.
LEAST_COSINE = 1e-9


class ChangeOfView:
    """From the reference camera's frame, in which states are given, to the frame of another camera.

    The joints are the same in every view. A view in the reference camera's own place gets the states as they are, to
    the last bit.

    Args:
        T_view_cam: ``(4, 4)`` from the reference camera's frame to the view's; or ``(..., 4, 4)``, of as many views
            as there are states of one arm.
    """

    def __init__(self, T_view_cam: FloatArray) -> None:
        self._T = np.asarray(T_view_cam, dtype=np.float64)
        self._same = bool(np.array_equal(self._T, np.eye(4)))

    def states(self, states: FloatArray) -> FloatArray:
        """States ``(..., 9 * arms)`` of the reference frame as states of the view's."""
        if self._same:
            return states
        moved = np.array(states, dtype=np.float64, order="C")
        arms = split_arms(moved)
        turn, shift = self._T[..., None, :3, :3], self._T[..., None, :3, 3]
        with np.errstate(invalid="ignore"):  # what is not finite stays so
            arms[..., ANGLES] = look_at_angles(turn @ look_at_rotation(arms[..., ANGLES]))
            arms[..., POSITION] = (turn @ arms[..., POSITION, None])[..., 0] + shift
        return moved

    def pull_back(self, states: FloatArray, gradient: FloatArray) -> FloatArray:
        """Derivative with respect to states of a function of the states that :meth:`states` makes of them.

        Both rates of the angles give the same angular velocity w: ``w = J(angles) d(angles)/dt`` in the reference
        frame, and ``R_view_cam w`` in the view's.

        Args:
            states: ``(..., 9 * arms)`` of the reference frame.
            gradient: ``(..., 9 * arms)`` derivatives with respect to the view's states, to be broadcast with them.

        Returns:
            ``(..., 9 * arms)``.
        """
        if self._same:
            return gradient
        pulled = np.array(gradient, dtype=np.float64, order="C")
        arms, turn = split_arms(pulled), self._T[:3, :3]
        with np.errstate(invalid="ignore"):
            here = _angular_velocities(split_arms(states)[..., ANGLES])
            there = angle_rates(split_arms(self.states(states))[..., ANGLES])
            arms[..., ANGLES] = np.einsum("...i,...ij->...j", arms[..., ANGLES], there @ turn @ here)
        arms[..., POSITION] = arms[..., POSITION] @ turn
        return pulled


def _angular_velocities(angles_rad: FloatArray) -> FloatArray:
    """``(..., 3, 3)``: the angular velocity in the camera frame, a column for the rate of each of ``(..., 3)`` angles.

    Of ``Ry(gamma) Rx(alpha) Rz(beta)`` the axes are ``Ry(gamma) x`` for alpha, the shaft for beta, and y for gamma.
    """
    gamma = angles_rad[..., GAMMA]
    zero, one = np.zeros_like(gamma), np.ones_like(gamma)
    alpha_axis = np.stack([np.cos(gamma), zero, -np.sin(gamma)], axis=-1)
    shaft = look_at_rotation(angles_rad)[..., 2]
    return np.stack([alpha_axis, shaft, np.stack([zero, one, zero], axis=-1)], axis=-1)


def angle_rates(angles_rad: FloatArray) -> FloatArray:
    """``(..., 3, 3)``: rates of ``(..., 3)`` angles, a row each, for an angular velocity in the camera frame."""
    alpha, gamma = angles_rad[..., ALPHA], angles_rad[..., GAMMA]
    sin_gamma, cos_gamma = np.sin(gamma), np.cos(gamma)
    zero, one = np.zeros_like(gamma), np.ones_like(gamma)
    level = np.stack([sin_gamma, zero, cos_gamma], axis=-1)  # Ry(gamma) z: the shaft's axis laid into the plane of x, z
    beta_rate = level / np.maximum(np.cos(alpha), LEAST_COSINE)[..., None]
    gamma_rate = np.stack([zero, one, zero], axis=-1) + np.sin(alpha)[..., None] * beta_rate
    return np.stack([np.stack([cos_gamma, zero, -sin_gamma], axis=-1), beta_rate, gamma_rate], axis=-2)
