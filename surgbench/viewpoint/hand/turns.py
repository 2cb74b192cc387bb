"""Rotations one at a time, compiled: what :mod:`surgbench.geometry` does for arrays, in a tenth of its time."""

from __future__ import annotations

import math

import numpy as np

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray, rotation_vector

# Beyond, the sine is too small to tell the axis.
_NEARLY_HALF_TURN = math.pi - 1e-3


@compiled
def _difference(wanted: FloatArray, now: FloatArray, turn: FloatArray) -> float:
    """Fill in the rotation vector (3,) of ``wanted now^T``; its angle."""
    trace = 0.0
    for k in range(3):
        one, other = (k + 1) % 3, (k + 2) % 3
        turn[k] = 0.0
        for column in range(3):
            turn[k] += wanted[other, column] * now[one, column] - wanted[one, column] * now[other, column]
            trace += wanted[k, column] * now[k, column]
    length = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)  # twice the sine
    angle = math.atan2(length, trace - 1.0)
    scale = angle / length if length > 0.0 else 0.5
    for k in range(3):
        turn[k] *= scale
    return angle


def turn_between(now: FloatArray, wanted: FloatArray) -> FloatArray:
    """The rotation vector ``(3,)`` that takes one ``(3, 3)`` rotation to another: ``wanted now^T``."""
    turn = np.empty(3)
    if _difference(wanted, now, turn) > _NEARLY_HALF_TURN:
        return rotation_vector(wanted @ now.T)
    return turn


@compiled
def _turned(turn: FloatArray, rotation: FloatArray, result: FloatArray) -> None:
    angle = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    sine = math.sin(angle) / angle if angle > 1e-9 else 1.0
    versine = (1.0 - math.cos(angle)) / (angle * angle) if angle > 1e-6 else 0.5
    for column in range(3):
        x, y, z = rotation[0, column], rotation[1, column], rotation[2, column]
        along = turn[0] * x + turn[1] * y + turn[2] * z
        for k in range(3):
            one, other = (k + 1) % 3, (k + 2) % 3
            cross = turn[one] * rotation[other, column] - turn[other] * rotation[one, column]
            result[k, column] = (
                rotation[k, column] * (1.0 - versine * angle * angle) + sine * cross + versine * along * turn[k]
            )


def turned(turn_rad: FloatArray, rotation: FloatArray) -> FloatArray:
    """A ``(3, 3)`` rotation, turned by a rotation vector ``(3,)``: ``exp(turn) rotation``."""
    result = np.empty((3, 3))
    _turned(turn_rad, rotation, result)
    return result
