"""How much motion a recording has to tell a hand-eye transform and a lag, whatever the tracker."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray, rotation_angle
from surgbench.handeye.fit import NOMINAL, closed_form, residuals
from surgbench.handeye.track import ReadingTrack

# A tracker's errors are alike for about so many frames: that many tell what one would.
ALIKE_FRAMES = 15.0
# A lag is told from another one where it would make a difference of so many standard errors.
TELLING_SIGMAS = 3.0
# A recording that tells the lag no better than to so many frames, 1/6 s of 30 a second, is refused.
WORST_RESOLUTION_FRAMES = 5.0
# Frames that have a reading and an estimate.
LEAST_FRAMES = 30


class TooLittleMotionError(SurgbenchError):
    """A recording has too few frames or too little motion to judge a tracker by."""


@dataclass(frozen=True)
class Motion:
    """What the readings of an arm have to tell.

    Attributes:
        frames: That have a reading.
        rotation_rad: Root mean square angle from the mean orientation.
        translation_m: Root mean square distance from the mean position.
        resolution_frames: The smallest lag from which on every lag would show, given a tracker that is off by 3 degrees
            and 2 mm (:data:`~surgbench.handeye.fit.NOMINAL`): by three standard errors, when all that one constant
            transform can take up is taken up. An arm that rests, moves evenly along a line or to and fro without
            change can't tell some of them. Infinite where the lag can't be told at all.
    """

    frames: int
    rotation_rad: float
    translation_m: float
    resolution_frames: float

    @property
    def is_enough(self) -> bool:
        """Whether the lag is told, and with it whether residuals mean something."""
        return self.frames >= LEAST_FRAMES and self.resolution_frames <= WORST_RESOLUTION_FRAMES

    def __str__(self) -> str:
        tells = "cannot tell a lag"
        if np.isfinite(self.resolution_frames):
            tells = f"tells a lag to {self.resolution_frames:.1f} frames"
        return f"{1e3 * self.translation_m:.1f} mm and {np.degrees(self.rotation_rad):.1f}°, {tells}"


def measure_motion(track: ReadingTrack, times_s: FloatArray, dt_s: float, max_lag_frames: int) -> Motion:
    """What an arm's readings have to tell.

    Args:
        track: The readings.
        times_s: ``(T,)`` of the frames.
        dt_s: Seconds between frames.
        max_lag_frames: The largest lag that would be looked for.
    """
    poses = track.at(times_s)
    there = np.isfinite(poses).all(axis=(1, 2))
    frames = int(there.sum())
    if frames < 2:
        return Motion(frames, 0.0, 0.0, float("inf"))
    places, turns = poses[there, :3, 3], poses[there, :3, :3]
    mean = closed_form(poses[there], np.broadcast_to(np.eye(4), (frames, 4, 4)), np.ones((frames, 2)))[:3, :3]
    return Motion(
        frames,
        float(np.sqrt((rotation_angle(mean.T @ turns) ** 2).mean())),
        float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean())),
        _resolution_frames(track, times_s, poses, dt_s, max_lag_frames),
    )


def _resolution_frames(
    track: ReadingTrack, times_s: FloatArray, poses: FloatArray, dt_s: float, max_lag_frames: int
) -> float:
    """From which lag on every one shows when the readings are held against themselves, that much later."""
    resolution = float("inf")
    for lag in range(1, max_lag_frames + 1):
        later = track.at(times_s + lag * dt_s)
        both = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(later).all(axis=(1, 2))
        frames = int(both.sum())
        if frames < LEAST_FRAMES:
            break
        weights = np.broadcast_to(1.0 / np.square(NOMINAL), (frames, 2))
        off = residuals(closed_form(later[both], poses[both], weights), later[both], poses[both])
        shows = np.sqrt(frames / ALIKE_FRAMES * ((off / np.repeat(NOMINAL, 3)) ** 2).mean(axis=0).sum())
        if shows < TELLING_SIGMAS:
            resolution = float("inf")
        elif not np.isfinite(resolution):
            # It grows with the lag, at first evenly.
            resolution = float(lag if lag > 1 else TELLING_SIGMAS / shows)
    return resolution
