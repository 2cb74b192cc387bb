"""A robot's readings as functions of time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from surgbench.geometry import FloatArray, rigid_transform
from surgbench.handeye.stretch import stretch_motions
from surgbench.instrument.arm import ARM_JOINTS

# Between readings that are further apart, in frames, nothing is known.
MAX_GAP_FRAMES = 3.0
# In frames: nearer to a reading is at it.
SLACK_FRAMES = 1e-6


class Timeline:
    """When something was read, and between which readings a time lies.

    Args:
        times_s: ``(n,)`` seconds, increasing.
        dt_s: Seconds between frames.
    """

    def __init__(self, times_s: FloatArray, dt_s: float) -> None:
        self.times_s = np.asarray(times_s, dtype=np.float64)
        self._gap_s, self._slack_s = (MAX_GAP_FRAMES + SLACK_FRAMES) * dt_s, SLACK_FRAMES * dt_s

    def known(self, wanted_s: FloatArray) -> NDArray[np.bool_]:
        """At which of ``(m,)`` times something is known: not before the first reading, after the last, or in gaps."""
        if len(self.times_s) < 2:
            return np.zeros(len(wanted_s), dtype=bool)
        _, past, ahead = self._place(wanted_s)
        # A reading itself counts, whatever lies beside it.
        near = (past + ahead <= self._gap_s) | (np.minimum(np.abs(past), np.abs(ahead)) <= self._slack_s)
        return near & (past >= -self._slack_s) & (ahead >= -self._slack_s)

    def mix(self, values: FloatArray, wanted_s: FloatArray) -> FloatArray:
        """``(m, ...)`` of values ``(n, ...)`` on straight lines between readings; NaN where nothing is known."""
        known = self.known(wanted_s)
        mixed = np.full((len(wanted_s), *values.shape[1:]), np.nan)
        if known.any():
            before, past, ahead = self._place(wanted_s[known])
            share = np.clip(past / (past + ahead), 0.0, 1.0).reshape(-1, *[1] * (values.ndim - 1))
            mixed[known] = (1.0 - share) * values[before] + share * values[before + 1]
        return mixed

    def _place(self, wanted_s: FloatArray) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
        """The reading before, how long ago that was, and how long it is to the next."""
        before = np.clip(np.searchsorted(self.times_s, wanted_s), 1, len(self.times_s) - 1) - 1
        return before, wanted_s - self.times_s[before], self.times_s[before + 1] - wanted_s


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
        self._line = Timeline(times_s[there], dt_s)
        self._places = poses[there, :3, 3]
        self._stretch = stretch_motions(self._line.times_s, poses[there])
        # Of fewer than two readings there is nothing between.
        turns = Rotation.from_matrix(poses[there, :3, :3]) if there.any() else None
        self._turn = Slerp(self._line.times_s, turns) if turns is not None and there.sum() > 1 else None

    def at(self, times_s: FloatArray) -> FloatArray:
        """Poses ``(n, 4, 4)`` at ``(n,)`` seconds; NaN before the first reading, after the last, and in gaps."""
        known = self._line.known(times_s)
        found = np.full((len(times_s), 4, 4), np.nan)
        if self._turn is not None and known.any():
            wanted = np.clip(times_s[known], self._line.times_s[0], self._line.times_s[-1])
            found[known] = rigid_transform(self._turn(wanted).as_matrix(), self._line.mix(self._places, wanted))
        return found

    @property
    def is_stretched(self) -> bool:
        """Whether the arm is one whose cables may be stretched."""
        return bool(self._stretch.any())

    def stretch_at(self, times_s: FloatArray) -> FloatArray:
        """What stretched cables do to the poses, ``(n, 6, 4)``, see :func:`.stretch_motions`; 0 where poses are NaN."""
        if self._turn is None:
            return np.zeros((len(times_s), 6, ARM_JOINTS))
        return np.nan_to_num(self._line.mix(self._stretch, times_s))
