"""How far estimates are from what a recording has in place of truth: hand-marked tips, and the robot's joint readings.

Neither is the truth. Hands mark a tip a few pixels off, and encoders sit at the other end of stretched cables; so these
are columns of their own, and no row is ranked by them.
"""

from __future__ import annotations

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.state import JOINTS, JointLimits, Symmetry, twin


def reference_tip_error(estimate_px: FloatArray, marked_px: FloatArray) -> FloatArray:
    """Mean distance of an arm's marked tips to the estimated ones, under the better of the two assignments.

    Args:
        estimate_px: ``(..., 2, 2)`` two tips, (u, v); NaN where one is behind the camera.
        marked_px: Same shape; NaN where a tip was not marked.

    Returns:
        ``(...)`` pixels for each marked tip: half of the paper's sum where both are. NaN where none is, or an estimated
        one that is needed has no pixel.

    Example:
        Both are marked, 5 px off; then one alone, which is held against the nearer.

        >>> from surgbench.references import reference_tip_error
        >>> nan = float("nan")
        >>> estimate = [[80, 60], [100, 60]]
        >>> reference_tip_error([estimate, estimate], [[[103, 64], [83, 64]], [[nan, nan], [100, 62]]])
        array([5., 2.])
    """
    estimate, marked = np.asarray(estimate_px, dtype=np.float64), np.asarray(marked_px, dtype=np.float64)
    there = ~np.isnan(marked).any(axis=-1)
    count = np.where(there.any(axis=-1), there.sum(axis=-1), np.nan)

    def mean(tips: FloatArray) -> FloatArray:
        distance: FloatArray = np.where(there, np.linalg.norm(tips - marked, axis=-1), 0.0).sum(axis=-1) / count
        return distance

    return np.fmin(mean(estimate), mean(estimate[..., ::-1, :]))


def reference_joint_errors(
    estimate: FloatArray,
    readings: FloatArray,
    limits: JointLimits,
    observed: np.ndarray,
    symmetry: Symmetry = "twin",
) -> FloatArray:
    """Of each joint, how far the estimate is from the robot's reading.

    The 180-degree twin turns the wrist's joints about, and a recording does not tell which of the two is right: the one
    whose wrist joints are nearer to the readings counts.

    Args:
        estimate: ``(T, 9)`` states of one arm.
        readings: ``(T, 3)`` q1, q2, q3 as the robot gives them, rad; NaN where there is none. Beyond the limits, as
            jaws that press, they count as at them.
        limits: The instrument's search limits.
        observed: ``(9,)`` bool, :attr:`surgbench.instrument.Instrument.observed`.
        symmetry: The instrument's; one without a twin is held against the readings as it is estimated.

    Returns:
        ``(T, 3)`` rad; NaN where there is no reading, and for joints that the instrument has not.

    Example:
        The twin of the readings' state, but for 0.1 rad of the jaw:

        >>> import numpy as np
        >>> from surgbench.instrument import load_instrument
        >>> from surgbench.references import reference_joint_errors
        >>> driver = load_instrument("large_needle_driver")
        >>> estimate = np.array([[0.3, 0.4, 0.8, 0.0, 0.0, 0.13, -0.2, 0.1, 0.4]])
        >>> readings = np.array([[0.2, -0.1, 0.3]])
        >>> reference_joint_errors(estimate, readings, driver.search_limits, driver.observed).round(9)
        array([[0. , 0. , 0.1]])
    """
    wanted = limits.clip(np.asarray(readings, dtype=np.float64))
    states = np.asarray(estimate, dtype=np.float64)
    own, other = (np.abs(one[..., JOINTS] - wanted) for one in (states, twin(states) if symmetry == "twin" else states))
    nearer = other[..., :2].sum(axis=-1) < own[..., :2].sum(axis=-1)
    errors: FloatArray = np.where(nearer[..., None], other, own)
    errors[..., ~observed[JOINTS]] = np.nan
    return errors
