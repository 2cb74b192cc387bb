"""Transform, lag and stretched cables between tracked poses and readings: a search over lags, then all together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from surgbench.geometry import FloatArray, rigid_transform, rotation_from_vector
from surgbench.handeye.fit import NOMINAL, Scales, costs, residuals, robust_fit, spread
from surgbench.handeye.motion import ALIKE_FRAMES, LEAST_FRAMES, TooLittleMotionError
from surgbench.handeye.stretch import USUAL
from surgbench.handeye.track import ReadingTrack
from surgbench.state import Symmetry

# A lag at which fewer of the frames have a reading is not looked at.
LEAST_SHARE = 0.5
# The search looks at every other lag and at no more frames than these, spread evenly; then at every lag nearby.
SEARCH_STEP = 2
SEARCH_FRAMES = 300
# How far from the best whole lag the best one may be: stretched cables pass for as much.
REFINED_FRAMES = 2.0
# Scales are taken anew after the first of so many refinements.
REFINEMENTS = 2
# For the interval of 95 %, residuals are taken to be alike over as much as this share of all frames; and what the
# normal 1.96 becomes where so much is taken from so little (Kiefer and Vogelsang 2005, Bartlett's kernel).
CORRELATED_SHARE = 0.5
INTERVAL_SIGMAS = 3.48
# What the fit of stretched cables leaves of them in the lag: at most so much on eight synthetic arms (docs/handeye.md).
STRETCH_DOUBT_FRAMES = 0.2

LAG = 6  # of the parameters: turn, shift, lag, stretch
PARAMETERS = 11
# Steps of derivatives, in scales and frames.
STEPS = np.array([1e-3] * 6 + [0.25] + [1e-3] * 4)


@dataclass(frozen=True)
class Alignment:
    """What tracked poses and readings differ by.

    Attributes:
        lag_frames: Of the readings behind the pictures.
        T_cam_base: ``(4, 4)``.
        stretch: ``(4,)`` how far the readings of yaw, pitch, insertion and roll run ahead of the moving joint.
        interval_frames: Of the lag, 95 %.
    """

    lag_frames: float
    T_cam_base: FloatArray
    stretch: FloatArray
    interval_frames: tuple[float, float] = (float("-inf"), float("inf"))


@dataclass(frozen=True)
class Frames:
    """Frames and readings.

    Attributes:
        times_s: ``(n,)``.
        tracked: ``(n, 4, 4)`` T_cam_wrist.
        track: The readings.
        dt_s: Seconds between frames.
        symmetry: The instrument's.
    """

    times_s: FloatArray
    tracked: FloatArray
    track: ReadingTrack
    dt_s: float
    symmetry: Symmetry = "twin"

    def arm(self, lag_frames: float) -> FloatArray:
        """``(n, 4, 4)`` what the readings say of each frame, if they are so late."""
        return self.track.at(self.times_s + lag_frames * self.dt_s)

    def known(self, *lags_frames: float) -> Frames:
        """Those that have an estimate, and a reading at each of some lags."""
        there = np.isfinite(self.tracked).all(axis=(1, 2))
        for lag in lags_frames:
            there &= np.isfinite(self.arm(lag)).all(axis=(1, 2))
        return replace(self, times_s=self.times_s[there], tracked=self.tracked[there])

    def off(self, found: Alignment) -> FloatArray:
        """Residuals ``(n, 6)``, radians and metres in the camera's frame."""
        stretched = self.track.stretch_at(self.times_s + found.lag_frames * self.dt_s) @ found.stretch
        turned = stretched.reshape(-1, 2, 3) @ found.T_cam_base[:3, :3].T
        expected = self.arm(found.lag_frames)
        return residuals(found.T_cam_base, self.tracked, expected, self.symmetry) + turned.reshape(-1, 6)


def align(frames: Frames, max_lag_frames: int) -> Alignment:
    """The transform, lag and stretch that most frames agree on.

    Raises:
        TooLittleMotionError: Too few frames have an estimate and a reading.
    """
    lag = _search(frames, max_lag_frames)
    # The same frames for every lag that is looked at from here on.
    frames = frames.known(lag - REFINED_FRAMES, lag, lag + REFINED_FRAMES)
    count = len(frames.times_s)
    if count < LEAST_FRAMES:
        raise TooLittleMotionError(f"{count} frames have an estimate and a reading; {LEAST_FRAMES} are needed")
    arm, scales = frames.arm(lag), NOMINAL
    for _ in range(REFINEMENTS):
        transform = robust_fit(frames.tracked, arm, scales, frames.symmetry)
        scales = spread(residuals(transform, frames.tracked, arm, frames.symmetry))
    found = Alignment(float(lag), transform, np.zeros(4))
    for _ in range(REFINEMENTS):
        found = _refine(frames, found, lag, scales)
        scales = spread(frames.off(found))
    return found


def _search(frames: Frames, max_lag_frames: int) -> int:
    """The lag in whole frames at which the readings fit best, stretched cables left out."""
    some = np.unique(np.linspace(0, len(frames.times_s) - 1, SEARCH_FRAMES).round().astype(int))
    few = replace(frames, times_s=frames.times_s[some], tracked=frames.tracked[some])

    def best(lags: range) -> int:
        return min(lags, key=lambda lag: (_cost(few, lag), abs(lag)))

    coarse = best(range(-max_lag_frames, max_lag_frames + 1, SEARCH_STEP))
    return best(range(coarse - SEARCH_STEP + 1, coarse + SEARCH_STEP))


def _cost(frames: Frames, lag_frames: int) -> float:
    """What the best transform leaves at a lag; infinite where too few frames have a reading."""
    arm = frames.arm(lag_frames)
    there = np.isfinite(arm).all(axis=(1, 2))
    if there.sum() < max(LEAST_SHARE * len(arm), 2):
        return float("inf")
    tracked, arm = frames.tracked[there], arm[there]
    found = robust_fit(tracked, arm, NOMINAL, frames.symmetry)
    return float(costs(found, tracked, arm, NOMINAL, frames.symmetry))


def _refine(frames: Frames, start: Alignment, lag_frames: int, scales: Scales) -> Alignment:
    """All together from nearby, with Cauchy's loss on residuals in their scales."""
    middle = frames.arm(start.lag_frames)[:, :3, 3].mean(axis=0)
    middle_cam = start.T_cam_base[:3, :3] @ middle + start.T_cam_base[:3, 3]
    units = np.repeat(scales, 3)
    # Residuals count as if each frame were one of its own, which is so many times too much.
    doubt = np.sqrt(ALIKE_FRAMES) / USUAL

    def at(change: FloatArray) -> Alignment:
        turn = rotation_from_vector(scales.rotation_rad * change[:3]) @ start.T_cam_base[:3, :3]
        place = middle_cam + scales.translation_m * change[3:6]
        stretch = start.stretch + change[LAG + 1 :] * USUAL
        return Alignment(float(start.lag_frames + change[LAG]), rigid_transform(turn, place - turn @ middle), stretch)

    def off(change: FloatArray) -> FloatArray:
        found = at(change)
        return np.concatenate([(frames.off(found) / units).ravel(), found.stretch * doubt])

    lower, upper = np.full(PARAMETERS, -np.inf), np.full(PARAMETERS, np.inf)
    lower[LAG], upper[LAG] = (lag_frames + side * REFINED_FRAMES - start.lag_frames for side in (-1, 1))
    begin = np.zeros(PARAMETERS)
    begin[LAG] = np.clip(0.0, lower[LAG] + 1e-6, upper[LAG] - 1e-6)
    solution = least_squares(
        off,
        begin,
        bounds=(lower, upper),
        loss=_loss,  # type: ignore[arg-type]  # the stubs ask for a keyword that SciPy never gives
        x_scale=1.0,
        xtol=1e-6,
        max_nfev=40,
    )
    change = np.asarray(solution.x, dtype=np.float64)
    found = at(change)
    half = INTERVAL_SIGMAS * _lag_deviation(off, change, lower, upper)
    if frames.track.is_stretched:
        half = float(np.hypot(half, STRETCH_DOUBT_FRAMES))
    return replace(found, interval_frames=(found.lag_frames - half, found.lag_frames + half))


def _loss(squares: FloatArray) -> FloatArray:
    """Cauchy's loss of squared residuals ``(m,)`` and its first two derivatives, ``(3, m)``; plain squares of the last.

    These are what is expected of the cables, of which there are no outliers.
    """
    wide = 1.0 + squares
    found = np.stack([np.log(wide), 1.0 / wide, -1.0 / wide**2])
    plain = slice(len(squares) - len(USUAL), None)
    found[:, plain] = np.stack([squares[plain], np.ones(len(USUAL)), np.zeros(len(USUAL))])
    return found


def _lag_deviation(
    off: Callable[[FloatArray], FloatArray], change: FloatArray, lower: FloatArray, upper: FloatArray
) -> float:
    """Standard deviation of the lag, in frames: the sandwich of an M-estimator with scores that are correlated.

    Newey and West's weights fall to nothing over ``CORRELATED_SHARE`` of the frames: what an arm's readings are off by
    drifts slowly.
    """
    columns = []
    for which, step in enumerate(STEPS):
        ahead, behind = change.copy(), change.copy()
        ahead[which] = min(change[which] + step, upper[which])
        behind[which] = max(change[which] - step, lower[which])
        columns.append((off(ahead) - off(behind)) / (ahead[which] - behind[which]))
    jacobian, left = np.stack(columns, axis=1), off(change)
    _, first, second = _loss(left**2)
    slope = first + 2.0 * second * left**2
    score = (first * left)[:, None] * jacobian
    stretch, score = jacobian[-len(USUAL) :], score[: -len(USUAL)].reshape(-1, 6, PARAMETERS).sum(axis=1)
    # What is expected of the cables is as uncertain as it is firm.
    meat = score.T @ score + stretch.T @ stretch
    reach = CORRELATED_SHARE * len(score)
    for apart in range(1, int(np.ceil(reach))):
        pairs = score[apart:].T @ score[:-apart]
        meat += (1.0 - apart / reach) * (pairs + pairs.T)
    bread = np.linalg.pinv((slope[:, None] * jacobian).T @ jacobian)
    return float(np.sqrt(max((bread @ meat @ bread)[LAG, LAG], 0.0)))
