"""What a feature's motion is like: the figures by which recorded and simulated hands are compared."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import butter, sosfiltfilt

from surgbench.geometry import FloatArray
from surgbench.viewpoint.scores import naive_violations
from surgbench.viewpoint.simulator import make_scene
from surgbench.viewpoint.trial import Trial

# Faster changes are tremor, which the recordings that are compared with hardly show.
LOWPASS_HZ = 6.0
# A feature slower than this rests, and one faster is a jump of the measurement (viewpoint logs of AutoCam).
MOVING_M_S = (0.003, 0.150)
PERCENTILES = (10, 50, 90, 99)


def extents_m(points_m: FloatArray) -> FloatArray:
    """``(3,)`` how far points ``(n, 3)`` extend along their principal axes, longest first."""
    centred = points_m - points_m.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1]
    return np.sort(np.ptp(centred @ axes, axis=0))[::-1]


def rates(trial: Trial) -> tuple[FloatArray, FloatArray]:
    """How fast a trial's true feature moves (m/s) and its normal turns (rad/s), ``(T,)`` each, without tremor.

    Raises:
        ValueError: The trial has no truth.
    """
    if trial.truth is None:
        raise ValueError(f"trial '{trial.id}' has no truth")
    smooth = butter(2, LOWPASS_HZ, fs=1.0 / trial.dt_s, output="sos")
    both = [sosfiltfilt(smooth, trial.truth.T_world_feature[:, :3, column], axis=0) for column in (3, 1)]
    speed, turn = (np.linalg.norm(np.gradient(values, trial.dt_s, axis=0), axis=1) for values in both)
    return np.asarray(speed), np.asarray(turn)


def describe_motion(trials: Sequence[Trial]) -> dict[str, tuple[float, ...]]:
    """Figures of trials with truth.

    Returns:
        Name to mean and sample standard deviation over the trials (the latter 0 of one trial), or for ``*_percentiles``
        to the percentiles of :data:`PERCENTILES` over all moving samples and the mean.
    """
    rows: dict[str, list[float]] = {}
    speeds, turns = [], []
    for trial in trials:
        speed, turn = rates(trial)
        assert trial.truth is not None
        moving = (speed > MOVING_M_S[0]) & (speed < MOVING_M_S[1])
        speeds.append(1e3 * speed[moving])
        turns.append(np.degrees(turn[moving]))
        contact = trial.truth.contact
        begins = np.diff(contact.astype(int), prepend=0) == 1
        long, middle, short = 1e3 * extents_m(trial.truth.T_world_feature[:, :3, 3])
        figures = {
            "duration_s": len(contact) * trial.dt_s,
            "mean_speed_mm_s": 1e3 * float(speed.mean()),
            "moving_percent": 100.0 * float(moving.mean()),
            "contacts": float(begins.sum()),
            "contact_s": float(contact.sum()) * trial.dt_s,
            "extent_long_mm": long,
            "extent_middle_mm": middle,
            "extent_short_mm": short,
            "constrained_percent": 100.0 * float(naive_violations(trial, make_scene(trial)).any[trial.measured].mean()),
        }
        for name, value in figures.items():
            rows.setdefault(name, []).append(float(value))
    result: dict[str, tuple[float, ...]] = {
        name: (float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else 0.0)
        for name, values in rows.items()
    }
    for name, samples in (("speed_mm_s_percentiles", speeds), ("turn_deg_s_percentiles", turns)):
        joined = np.concatenate(samples)
        result[name] = (*(float(value) for value in np.percentile(joined, PERCENTILES)), float(joined.mean()))
    return result
