"""Hand-eye transform and lag between tracked wrist poses and an arm's readings of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.handeye.align import Frames, align
from surgbench.handeye.motion import LEAST_FRAMES, WORST_RESOLUTION_FRAMES, Motion, TooLittleMotionError, measure_motion
from surgbench.handeye.track import ReadingTrack
from surgbench.state import Symmetry

# Three seconds of 30 frames: what users of published recordings met was less (SurgPose: up to 71 frames).
MAX_LAG_FRAMES = 90


@dataclass(frozen=True)
class HandEye:
    """How tracked poses and readings of an arm belong together, and what is left between them.

    Attributes:
        lag_frames: How late the readings are: what was read in frame ``t + lag`` belongs to the picture of frame ``t``.
            Negative where the readings run ahead of the pictures.
        lag_interval_frames: Of 95 %, from how much residuals scatter and for how long they are alike.
        T_cam_base: ``(4, 4)`` the hand-eye transform.
        stretch: ``(4,)`` how far the readings of yaw, pitch, insertion and roll run ahead of the moving joint, radians
            and metres; 0 of an arm that does not turn about its base's origin.
        off: ``(T, 6)`` tracked from expected poses: rotation vector and difference of positions in the camera's frame,
            radians and metres, after the twin rule; NaN where a frame has no estimate or no reading.
        middle_base_m: ``(3,)`` mean position of the wrist in the base's frame.
        motion: What the readings have to tell.
    """

    lag_frames: float
    lag_interval_frames: tuple[float, float]
    T_cam_base: FloatArray
    stretch: FloatArray
    off: FloatArray
    middle_base_m: FloatArray
    motion: Motion

    @property
    def frames(self) -> int:
        """Frames that were compared."""
        return len(self.rotation_rad)

    @cached_property
    def rotation_rad(self) -> FloatArray:
        """Of each frame that was compared, the angle that is left."""
        return np.asarray(np.linalg.norm(self.off[self._compared, :3], axis=1))

    @cached_property
    def translation_m(self) -> FloatArray:
        """Of each frame that was compared, the distance that is left."""
        return np.asarray(np.linalg.norm(self.off[self._compared, 3:], axis=1))

    @property
    def _compared(self) -> NDArray[np.bool_]:
        return np.asarray(np.isfinite(self.off).all(axis=1))


def estimate_hand_eye(
    times_s: FloatArray,
    tracked: FloatArray,
    readings: FloatArray,
    dt_s: float,
    counts: NDArray[np.bool_] | None = None,
    max_lag_frames: int = MAX_LAG_FRAMES,
    symmetry: Symmetry = "twin",
) -> HandEye:
    """The one transform and the one lag that most frames agree on.

    The model is ``T_cam_wrist(t) = T_cam_base T_base_wrist(t + lag)``, the readings ahead of moving joints by the
    stretch of their cables (:mod:`surgbench.handeye.stretch`). Lags are searched with a transform that is fitted to
    each in closed form, against outliers; from the best, all are refined together (Cauchy's loss on residuals in
    units of their robust spread).

    Args:
        times_s: ``(T,)`` of the frames, increasing.
        tracked: ``(T, 4, 4)`` estimates of T_cam_wrist; NaN where a frame has none.
        readings: ``(T, 4, 4)`` T_base_wrist by the arm's kinematics, NaN where one is missing.
        dt_s: Seconds between frames.
        counts: ``(T,)`` which estimates to learn from; all unless told. Residuals are of all.
        max_lag_frames: The largest lag to look for, to either side.
        symmetry: The instrument's, :attr:`surgbench.instrument.Instrument.symmetry`: which of the poses that look the
            same counts.

    Raises:
        TooLittleMotionError: Too few frames, or the arm moves too little; one line.

    Example:
        A circle that is read two frames late:

        >>> import numpy as np
        >>> from surgbench.geometry import rigid_transform, rotation_from_vector
        >>> from surgbench.handeye import estimate_hand_eye
        >>> def pose(frame):
        ...     turn = np.stack([0.2 * np.sin(0.11 * frame), 0.3 * np.cos(0.07 * frame), 0 * frame], axis=1)
        ...     place = np.stack([np.cos(0.09 * frame), np.sin(0.05 * frame), 0 * frame], axis=1)
        ...     return rigid_transform(rotation_from_vector(turn), 0.02 * place)
        >>> frames = np.arange(200.0)
        >>> T_cam_base = rigid_transform(rotation_from_vector(np.array([0.0, 0.5, 0.0])), np.array([0.0, 0.0, 0.1]))
        >>> found = estimate_hand_eye(frames / 30, T_cam_base @ pose(frames), pose(frames - 2), dt_s=1 / 30)
        >>> round(found.lag_frames, 3), bool(np.abs(found.T_cam_base - T_cam_base).max() < 1e-6)
        (2.0, True)
    """
    track = ReadingTrack(times_s, readings, dt_s)
    usable = np.isfinite(tracked).all(axis=(1, 2)) & (True if counts is None else counts)
    if usable.sum() < LEAST_FRAMES:
        raise TooLittleMotionError(f"{usable.sum()} frames have an estimate to go by; {LEAST_FRAMES} are needed")
    motion = measure_motion(track, times_s, dt_s, max_lag_frames)
    if not motion.is_enough:
        few = f"{motion.frames} frames with readings; " if motion.frames < LEAST_FRAMES else ""
        raise TooLittleMotionError(
            f"the arm moves too little to judge by: {few}{motion}; it must be to {WORST_RESOLUTION_FRAMES:g}, as of a "
            "longer or livelier recording"
        )
    found = align(Frames(times_s[usable], tracked[usable], track, dt_s, symmetry), max_lag_frames)
    whole = Frames(times_s, tracked, track, dt_s, symmetry).known(found.lag_frames)
    off = np.full((len(times_s), 6), np.nan)
    off[np.isin(times_s, whole.times_s)] = whole.off(found)
    middle = whole.arm(found.lag_frames)[:, :3, 3].mean(axis=0)
    return HandEye(found.lag_frames, found.interval_frames, found.T_cam_base, found.stretch, off, middle, motion)
