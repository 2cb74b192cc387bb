"""Moving means of poses, as the published code of AutoCam takes them: of lists, every member counting the same."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from surgbench.compiled import compiled
from surgbench.geometry import FloatArray


@compiled
def quaternion(pose: FloatArray, out: FloatArray) -> None:
    """Unit quaternion w, x, y, z of a pose's rotation, w not negative (Shepperd: from its largest part)."""
    trace = pose[0, 0] + pose[1, 1] + pose[2, 2]
    largest, most = -1, trace
    for k in range(3):
        if pose[k, k] > most:
            largest, most = k, pose[k, k]
    if largest < 0:
        out[0] = 1.0 + trace
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            out[1 + k] = pose[j, i] - pose[i, j]
    else:
        i, j = (largest + 1) % 3, (largest + 2) % 3
        out[0] = pose[j, i] - pose[i, j]
        out[1 + largest] = 1.0 + pose[largest, largest] - pose[i, i] - pose[j, j]
        out[1 + i] = pose[i, largest] + pose[largest, i]
        out[1 + j] = pose[j, largest] + pose[largest, j]
    length = math.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2 + out[3] ** 2)
    if out[0] < 0:
        length = -length
    for k in range(4):
        out[k] /= length


@compiled
def rotate(q: FloatArray, pose: FloatArray) -> None:
    """A unit quaternion's rotation into a pose."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    pose[0, 0], pose[0, 1], pose[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    pose[1, 0], pose[1, 1], pose[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    pose[2, 0], pose[2, 1], pose[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    pose[3, 0] = pose[3, 1] = pose[3, 2] = 0.0
    pose[3, 3] = 1.0


@compiled
def take_mean(values: FloatArray, count: int, out: FloatArray) -> None:
    """Mean of the rows of a ring buffer that has been written to ``count`` times."""
    present = min(count, len(values))
    for k in range(values.shape[1]):
        out[k] = 0.0
    for row in range(present):
        for k in range(values.shape[1]):
            out[k] += values[row, k]
    for k in range(values.shape[1]):
        out[k] /= present


@compiled(makes_arrays=True)
def mean_pose(
    pose: FloatArray, positions: FloatArray, rotations: FloatArray, count: NDArray[np.int64], out: FloatArray
) -> None:
    """Take a pose in, and give the mean of the last ones.

    Args:
        pose: ``(4, 4)``, the newest.
        positions: ``(m, 3)`` ring buffer, updated.
        rotations: ``(n, 4)`` ring buffer of quaternions, updated.
        count: ``(1,)`` how many poses there have been, updated.
        out: ``(4, 4)``, filled.
    """
    place, turn = positions[count[0] % len(positions)], rotations[count[0] % len(rotations)]
    for k in range(3):
        place[k] = pose[k, 3]
    quaternion(pose, turn)
    count[0] += 1
    position, rotation = np.empty(3), np.empty(4)
    take_mean(positions, count[0], position)
    take_mean(rotations, count[0], rotation)
    length = math.sqrt((rotation**2).sum())
    if length > 1e-6:
        rotation /= length
    else:  # opposite ones cancel
        rotation[:] = turn
    rotate(rotation, out)
    for k in range(3):
        out[k, 3] = position[k]


class PoseMean:
    """The mean of the last poses; before there are so many, of all.

    The rotation is the mean of quaternions whose real parts are not negative, normalised: right for rotations that are
    near to each other and not near half a turn, where such quaternions change their sign.

    Args:
        positions: How many positions.
        rotations: How many rotations.
    """

    def __init__(self, positions: int, rotations: int) -> None:
        self._positions, self._rotations = np.zeros((positions, 3)), np.zeros((rotations, 4))
        self._count = np.zeros(1, dtype=np.int64)

    def __call__(self, pose: FloatArray) -> FloatArray:
        """Take a pose ``(4, 4)`` in; the mean ``(4, 4)``."""
        out = np.empty((4, 4))
        mean_pose(pose, self._positions, self._rotations, self._count, out)
        return out
