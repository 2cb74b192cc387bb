"""A robot's readings of a pose as a function of time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from surgbench.geometry import FloatArray, rigid_transform
from surgbench.handeye.stretch import stretch_motions

# Between readings that are further apart, in frames, nothing is known.
MAX_GAP_FRAMES = 3.0


class ReadingTrack:
    """Poses at any time, between the ones that were read: positions linear, rotations along the shortest way.

    Args:
        times_s: ``(T,)`` seconds, increasing.
        poses: ``(T, 4, 4)``, NaN where one is missing.
        dt_s: Seconds between frames.

    Example:
        Between the second and the third of three frames; and after the last, where nothing is known.

        >>> import numpy as np
        >>> from surgbench.geometry import rigid_transform
        >>> from surgbench.handeye import ReadingTrack
        >>> places = np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.2], [0.0, 0.0, 0.4]])
        >>> track = ReadingTrack(np.array([0.0, 1.0, 2.0]), rigid_transform(np.eye(3), places), dt_s=1.0)
        >>> track.at(np.array([1.5, 2.5]))[:, 2, 3].round(9)
        array([0.3, nan])
    """

    def __init__(self, times_s: FloatArray, poses: FloatArray, dt_s: float) -> None:
        there = np.isfinite(poses).all(axis=(1, 2))
        self._times = np.asarray(times_s, dtype=np.float64)[there]
        self._places = poses[there, :3, 3]
        self._stretch = stretch_motions(self._times, poses[there])
        self._gap_s = (MAX_GAP_FRAMES + 1e-6) * dt_s
        self._slack_s = 1e-6 * dt_s
        # Of fewer than two readings there is nothing between.
        self._turn = Slerp(self._times, Rotation.from_matrix(poses[there, :3, :3])) if there.sum() > 1 else None

    def at(self, times_s: FloatArray) -> FloatArray:
        """Poses ``(n, 4, 4)`` at ``(n,)`` seconds; NaN before the first reading, after the last, and in gaps."""
        wanted = np.asarray(times_s, dtype=np.float64)
        found = np.full((len(wanted), 4, 4), np.nan)
        if self._turn is None:
            return found
        before, share, known = self._between(wanted)
        if known.any():
            clipped = np.clip(wanted[known], self._times[0], self._times[-1])
            places = _mix(self._places, before[known], share[known])
            found[known] = rigid_transform(self._turn(clipped).as_matrix(), places)
        return found

    def stretch_at(self, times_s: FloatArray) -> FloatArray:
        """What stretched cables do to the poses, ``(n, 6, 4)``, see :func:`.stretch_motions`; 0 where poses are NaN."""
        wanted = np.asarray(times_s, dtype=np.float64)
        found = np.zeros((len(wanted), 6, 4))
        if self._turn is not None:
            before, share, known = self._between(wanted)
            found[known] = _mix(self._stretch, before[known], share[known])
        return found

    def _between(self, wanted: FloatArray) -> tuple[NDArray[np.intp], FloatArray, NDArray[np.bool_]]:
        """Of each time the reading before it, the share of the way to the next, and whether that is known."""
        times = self._times
        inside = (wanted >= times[0] - self._slack_s) & (wanted <= times[-1] + self._slack_s)
        clipped = np.clip(wanted, times[0], times[-1])
        before = np.clip(np.searchsorted(times, clipped), 1, len(times) - 1) - 1
        past, ahead = clipped - times[before], times[before + 1] - clipped
        # A reading itself counts, whatever lies beside it.
        known = inside & ((past + ahead <= self._gap_s) | (np.minimum(past, ahead) <= self._slack_s))
        return before, past / (past + ahead), known


def _mix(values: FloatArray, before: NDArray[np.intp], share: FloatArray) -> FloatArray:
    share = share.reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((1.0 - share) * values[before] + share * values[before + 1])
