"""How far estimates are from the truth and from the masks: pure functions on arrays.

Definitions follow Hu et al. 2026, section IV; ``docs/metrics.md`` has every column with its equation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgbench.alike import choose_seen_alike
from surgbench.geometry import FloatArray, look_at_rotation, rotation_angle, wrap_angle
from surgbench.state import ANGLES, BETA, JOINTS, POSITION, STATE_SIZE, Symmetry, twin

if TYPE_CHECKING:
    from surgbench.camera import Camera
    from surgbench.instrument import Instrument

POSE_ERRORS = (
    "rotation_error_rad",
    "translation_error_m",
    "tip_error_m",
    "q1_error_rad",
    "q2_error_rad",
    "q3_error_rad",
    "keypoint_error_px",
)

# Components of the state whose intervals are looked at together, and how often their intervals hold the truth.
INTERVAL_COVERAGES = {
    "interval_coverage": slice(0, STATE_SIZE),
    "interval_coverage_rotation": ANGLES,
    "interval_coverage_translation": POSITION,
    "interval_coverage_q1": slice(6, 7),
    "interval_coverage_q2": slice(7, 8),
    "interval_coverage_q3": slice(8, 9),
}
# A Gaussian lies within so many standard deviations of its mean with a probability of 0.9.
INTERVAL_SIGMAS = 1.6449

# An arm of which less than this share of the picture's pixels shows is out of view: 345 of 700 x 493, where an
# instrument in its place has 6000 and more.
OUT_OF_VIEW_SHARE = 0.001
# A tracker is right again where the tips are no further off than this.
RECOVERED_M = 0.005

# Turning beta by pi and back rounds it by up to a few units in the last place of 2 pi; that is no error.
BETA_ROUNDING_RAD = 16 * np.finfo(np.float64).eps


def choose_twin(estimate: FloatArray, truth: FloatArray, symmetry: Symmetry = "twin") -> FloatArray:
    """Per state, the estimate or its 180-degree twin, whichever has the smaller wrapped error of beta.

    The two have nearly the same silhouette; this is the paper's rule for which of them is evaluated, in all
    columns. Of two equally far ones the estimate itself is kept.

    Args:
        estimate: ``(..., 9)`` states of one arm.
        truth: Same shape.
        symmetry: The instrument's, :attr:`surgbench.instrument.Instrument.symmetry`; unless it is ``twin``, estimates
            are kept as they are.

    Returns:
        Same shape. A beta that equals the true one up to full turns and rounding is the true one.

    Example:
        >>> import numpy as np
        >>> from surgbench.metrics import choose_twin
        >>> from surgbench.state import twin
        >>> truth = np.array([0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.2, -0.1, 0.3])
        >>> choose_twin(twin(truth), truth)
        array([ 0.3 ,  0.4 ,  0.8 ,  0.  ,  0.  ,  0.13,  0.2 , -0.1 ,  0.3 ])
    """
    estimate, truth = np.asarray(estimate, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    other = twin(estimate) if symmetry == "twin" else estimate
    own_error = np.abs(wrap_angle(estimate[..., BETA] - truth[..., BETA]))
    other_error = np.abs(wrap_angle(other[..., BETA] - truth[..., BETA]))
    chosen: FloatArray = np.where((other_error < own_error)[..., None], other, estimate)
    tolerance = BETA_ROUNDING_RAD * (1.0 + np.abs(truth[..., BETA]))
    same = np.minimum(own_error, other_error) <= tolerance
    chosen[..., BETA] = np.where(same, truth[..., BETA], chosen[..., BETA])
    return chosen


def rotation_error(estimate_angles: FloatArray, true_angles: FloatArray) -> FloatArray:
    """Geodesic distance ``|log(R^T R_hat)|`` of two orientations.

    Args:
        estimate_angles: ``(..., 3)`` alpha, beta, gamma, radians.
        true_angles: Same shape.

    Returns:
        ``(...)`` radians in [0, pi]; exactly 0 for equal angles.

    Example:
        >>> import numpy as np
        >>> from surgbench.metrics import rotation_error
        >>> true_angles = np.array([0.3, 0.4, 0.8])
        >>> rotation_error(true_angles + [[0.1, 0, 0], [0, -0.1, 0], [0, 2 * np.pi, 0]], true_angles).round(9)
        array([0.1, 0.1, 0. ])
    """
    estimate, true = look_at_rotation(estimate_angles), look_at_rotation(true_angles)
    # Written out, since a matrix product may round (i, j) and (j, i) differently, and then R^T R has an angle.
    return rotation_angle((true[..., :, :, None] * estimate[..., :, None, :]).sum(axis=-3))


def pose_errors(
    instrument: Instrument, camera: Camera, estimate: FloatArray, truth: FloatArray
) -> dict[str, FloatArray]:
    """All errors of one arm against the truth, frame by frame, after :func:`choose_twin`.

    What cannot be seen of the instrument is not scored: see :func:`surgbench.alike.choose_seen_alike`.

    Args:
        instrument: Gives the tips.
        camera: The reference camera.
        estimate: ``(T, 9)``.
        truth: ``(T, 9)``.

    Returns:
        ``POSE_ERRORS`` to ``(T,)``: geodesic rotation error (rad), distance of the wrist-pitch frame's origin (m),
        mean distance of the tips (m), absolute joint errors (rad; q3 is the half jaw angle), and the sum of
        the tips' pixel distances under the better assignment. That last one is NaN where a tip is behind
        the camera; the error of a joint that the instrument has not is NaN.

    Example:
        2 mm too far to the right:

        >>> import numpy as np
        >>> from surgbench.camera import Camera
        >>> from surgbench.instrument import load_instrument
        >>> from surgbench.metrics import pose_errors
        >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
        >>> truth = np.array([[0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.2, -0.1, 0.3]])
        >>> estimate = truth + [0, 0, 0, 0.002, 0, 0, 0, 0, 0]
        >>> errors = pose_errors(load_instrument("large_needle_driver"), camera, estimate, truth)
        >>> errors["rotation_error_rad"], errors["translation_error_m"], errors["tip_error_m"].round(9)
        (array([0.]), array([0.002]), array([0.002]))
    """
    truth = np.asarray(truth, dtype=np.float64)
    chosen = choose_seen_alike(choose_twin(estimate, truth, instrument.symmetry), truth, instrument.observed)
    tips, true_tips = instrument.tips_cam(chosen), instrument.tips_cam(truth)
    joints = np.abs(chosen[..., JOINTS] - truth[..., JOINTS])
    joints[..., ~instrument.observed[JOINTS]] = np.nan
    values = (
        rotation_error(chosen[..., ANGLES], truth[..., ANGLES]),
        np.linalg.norm(chosen[..., POSITION] - truth[..., POSITION], axis=-1),
        np.linalg.norm(tips - true_tips, axis=-1).mean(axis=-1),
        joints[..., 0],
        joints[..., 1],
        joints[..., 2],
        keypoint_error(*(camera.project(places[..., : len(instrument.spec.tips), :]) for places in (tips, true_tips))),
    )
    return dict(zip(POSE_ERRORS, values, strict=True))


def keypoint_error(estimate_px: FloatArray, true_px: FloatArray) -> FloatArray:
    """Sum of both tips' pixel distances under the better of the two assignments.

    Args:
        estimate_px: ``(..., 2, 2)`` two tips, (u, v); ``(..., 1, 2)`` of a tool with one.
        true_px: Same shape.

    Returns:
        ``(...)`` pixels; NaN where a tip is.

    Example:
        Tips have no order: one is met, the other missed by 3 columns and 4 rows.

        >>> from surgbench.metrics import keypoint_error
        >>> print(keypoint_error([[80, 60], [100, 60]], [[103, 64], [80, 60]]))
        5.0
    """
    estimate, true = np.asarray(estimate_px, dtype=np.float64), np.asarray(true_px, dtype=np.float64)
    straight = np.linalg.norm(estimate - true, axis=-1).sum(axis=-1)
    crossed = np.linalg.norm(estimate[..., ::-1, :] - true, axis=-1).sum(axis=-1)
    better: FloatArray = np.minimum(straight, crossed)
    return better


def masks_apart(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    """``1 - IoU`` of two masks, ``(height, width)`` bool each; 0 where both are empty.

    Example:
        >>> import numpy as np
        >>> from surgbench.metrics import masks_apart
        >>> masks_apart(np.array([[True, True, False]]), np.array([[False, True, False]]))
        0.5
    """
    counts = (np.count_nonzero(mask) for mask in (one, other, one & other))
    return float(mask_error(*counts))


def mask_error(area_estimate: ArrayLike, area_reference: ArrayLike, overlap: ArrayLike) -> FloatArray:
    """``1 - IoU`` of two masks from their pixel counts.

    Args:
        area_estimate: Pixels of the estimated silhouette, any shape.
        area_reference: Pixels of the reference mask.
        overlap: Pixels in both.

    Returns:
        Same shape, 0 to 1; 0 where both masks are empty.

    Example:
        Half of 300 pixels in common, 450 in one or the other; then nothing, and nothing at all:

        >>> from surgbench.metrics import mask_error
        >>> mask_error([300, 300, 0], [300, 300, 0], [150, 0, 0]).round(3)
        array([0.667, 1.   , 0.   ])
    """
    common = np.asarray(overlap, dtype=np.float64)
    union = np.asarray(area_estimate, dtype=np.float64) + np.asarray(area_reference, dtype=np.float64) - common
    error: FloatArray = np.where(union > 0, 1.0 - common / np.where(union > 0, union, 1.0), 0.0)
    return error


def interval_coverages(
    estimate: FloatArray,
    standard_deviations: FloatArray,
    truth: FloatArray,
    observed: ArrayLike | None = None,
    symmetry: Symmetry = "twin",
) -> dict[str, FloatArray]:
    """Of each frame, the share of components whose stated central 90 % interval holds the truth.

    After :func:`choose_twin`, whose standard deviations are those of the state itself; angles by their wrapped error.

    Args:
        estimate: ``(..., 9)`` states of one arm.
        standard_deviations: Same shape, or ``(9,)`` for all; rad and m, above 0; NaN where a frame has none.
        truth: As those.
        observed: ``(9,)`` bool, or ``(..., 9)``: components that can be seen of the instrument; all unless told.
            Others do not count.
        symmetry: The instrument's, for :func:`choose_twin`.

    Returns:
        The names of ``INTERVAL_COVERAGES`` to ``(...)`` shares, 0 to 1; NaN where a frame has no standard deviations,
        and where a group has nothing that can be seen.

    Example:
        1 mm is expected; the wrist is off by 1 mm in x, by 2 mm in y and not at all in z.

        >>> import numpy as np
        >>> from surgbench.metrics import interval_coverages
        >>> truth = np.array([0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.2, -0.1, 0.3])
        >>> estimate = truth + [0, 0, 0, 0.001, 0.002, 0, 0, 0, 0]
        >>> shares = interval_coverages(estimate, np.full(9, 0.001), truth)
        >>> float(shares["interval_coverage_translation"].round(3)), float(shares["interval_coverage_q1"])
        (0.667, 1.0)
    """
    truth = np.asarray(truth, dtype=np.float64)
    errors = choose_twin(estimate, truth, symmetry) - truth
    errors[..., ANGLES] = wrap_angle(errors[..., ANGLES])
    held = np.abs(errors) <= INTERVAL_SIGMAS * np.asarray(standard_deviations)
    inside: FloatArray = np.where(np.isnan(standard_deviations), np.nan, held)
    seen = np.broadcast_to(True if observed is None else np.asarray(observed, dtype=bool), inside.shape)
    return {name: _share(inside[..., group], seen[..., group]) for name, group in INTERVAL_COVERAGES.items()}


def _share(inside: FloatArray, seen: np.ndarray) -> FloatArray:
    """Mean over the last axis of what is seen; NaN where nothing is."""
    if seen.all():
        share: FloatArray = inside.mean(axis=-1)
        return share
    count = seen.sum(axis=-1)
    shares: FloatArray = np.where(seen, inside, 0.0).sum(axis=-1) / np.where(count > 0, count, np.nan)
    return shares


def lost_precision(lost: ArrayLike, out_of_view: ArrayLike) -> FloatArray:
    """Of the frames of which a tracker says that it is lost: 1 where an instrument is out of view, else 0.

    Their mean is the precision of saying so.

    Args:
        lost: ``(T,)`` bool.
        out_of_view: ``(T,)`` bool.

    Returns:
        ``(T,)``; NaN in all other frames, and in all where no instrument is ever out of view.

    Example:
        Two frames out of view, of which the tracker notices the second, and goes on for one too many:

        >>> from surgbench.metrics import lost_precision
        >>> lost_precision([False, False, True, True], [False, True, True, False])
        array([nan, nan,  1.,  0.])
    """
    lost, out_of_view = np.asarray(lost, dtype=bool), np.asarray(out_of_view, dtype=bool)
    return np.where(lost & out_of_view.any(), out_of_view.astype(np.float64), np.nan)


def lost_recall(lost: ArrayLike, out_of_view: ArrayLike) -> FloatArray:
    """Of the frames in which an instrument is out of view: 1 where the tracker says that it is lost, else 0.

    Their mean is the recall.

    Args:
        lost: ``(T,)`` bool.
        out_of_view: ``(T,)`` bool.

    Returns:
        ``(T,)``; NaN in all other frames.

    Example:
        Two frames out of view, of which the tracker notices the second, and goes on for one too many:

        >>> from surgbench.metrics import lost_recall
        >>> lost_recall([False, False, True, True], [False, True, True, False])
        array([nan,  0.,  1., nan])
    """
    lost, out_of_view = np.asarray(lost, dtype=bool), np.asarray(out_of_view, dtype=bool)
    return np.where(out_of_view, lost.astype(np.float64), np.nan)


def frames_to_recover(tip_errors: ArrayLike, out_of_view: ArrayLike) -> float:
    """Median over an arm's returns into view: frames from the first in view until the tips are right again.

    That is the first frame whose tip error is at most ``RECOVERED_M``. A return after which none is counts as all the
    frames until the arm is out of view again or the sequence ends: a lower bound.

    Args:
        tip_errors: ``(T,)`` metres; frames out of view are not looked at.
        out_of_view: ``(T,)`` bool.

    Returns:
        Frames, 0 for right at once; NaN where the arm never returns.

    Example:
        Back in the third frame, right in the fifth:

        >>> from surgbench.metrics import frames_to_recover
        >>> frames_to_recover([0.001, 0.1, 0.03, 0.01, 0.002], [False, True, False, False, False])
        2.0
    """
    errors, away = np.asarray(tip_errors, dtype=np.float64), np.asarray(out_of_view, dtype=bool)
    taken = []
    for first in np.flatnonzero(away[:-1] & ~away[1:]) + 1:
        later = np.flatnonzero(away[first:])
        stay = errors[first : first + later[0]] if later.size else errors[first:]
        right = np.flatnonzero(stay <= RECOVERED_M)
        taken.append(right[0] if right.size else len(stay))
    return float(np.median(taken)) if taken else float("nan")


def translation_error_scaled(estimate_m: FloatArray, truth_m: FloatArray) -> float:
    """Mean distance of an arm's places from the true ones after the one factor that brings them nearest.

    A silhouette does not show whether an instrument is larger and further away. What is left after the factor, ``s`` of
    least ``sum |s p - p*|²``, is the tracker's doing.

    Args:
        estimate_m: ``(T, 3)`` places of the wrist in the camera's frame; frames with NaN do not count.
        truth_m: Same shape.

    Returns:
        Metres; NaN without frames.

    Example:
        Everything 1 % too far away:

        >>> import numpy as np
        >>> from surgbench.metrics import translation_error_scaled
        >>> truth = np.array([[0.0, 0.01, 0.12], [0.02, 0.0, 0.14]])
        >>> round(translation_error_scaled(1.01 * truth, truth), 12)
        0.0
    """
    counts = np.isfinite(estimate_m).all(axis=-1) & np.isfinite(truth_m).all(axis=-1)
    estimate, truth = estimate_m[counts], truth_m[counts]
    if not len(estimate):
        return float("nan")
    factor = float((estimate * truth).sum() / (estimate**2).sum())
    return float(np.linalg.norm(factor * estimate - truth, axis=-1).mean())


def jitter(tips: FloatArray, dt_s: ArrayLike) -> float:
    """How much the estimate trembles: root mean square acceleration of the point midway between the tips.

    The second difference of the midpoint over ``dt_s`` squared, in m/s²; where frames are not evenly spaced, the
    second divided difference, twice. It holds the motion's own acceleration
    too, so it compares trackers on the same sequence; it is not an error and the truth's is not 0. The midpoint
    is the same for a state and its twin.

    Args:
        tips: ``(T, 2, 3)`` tips in the camera frame, metres, of consecutive frames; NaN where a frame does not count.
        dt_s: Seconds from frame to frame: one number, or ``(T - 1,)`` (:func:`surgbench.timing.steps_s`).

    Returns:
        m/s²; NaN where no three frames in a row count.

    Example:
        To and fro by 1 mm every 0.1 s: the velocity changes by 2 cm/s from frame to frame.

        >>> import numpy as np
        >>> from surgbench.metrics import jitter
        >>> tips = np.zeros((6, 2, 3))
        >>> tips[1::2, :, 0] = 0.001
        >>> round(jitter(tips, dt_s=0.1), 9)
        0.2
    """
    midpoint = np.asarray(tips, dtype=np.float64).mean(axis=-2)
    if len(midpoint) < 3:
        return float("nan")
    before, after = _steps_around(dt_s, len(midpoint))
    moved = np.diff(midpoint, axis=0)
    uneven = 2 * (moved[1:] / after - moved[:-1] / before) / (before + after)
    # Even steps as they are published, to the last digit.
    acceleration = np.where(before == after, np.diff(midpoint, n=2, axis=0) / before**2, uneven)
    squared = (acceleration**2).sum(axis=-1)
    squared = squared[~np.isnan(squared)]
    return float(np.sqrt(squared.mean())) if squared.size else float("nan")


def lag(positions: FloatArray, true_positions: FloatArray, dt_s: ArrayLike) -> float:
    """By how much time positions trail behind the true motion: least squares of their error on the true velocity.

    A position that is late by ``tau`` is off by ``-tau v``, so that ``tau = -sum(e . v) / sum(v . v)`` with the error
    ``e`` and the true velocity ``v`` (central differences, hence without the first and the last frame). Errors that
    have nothing to do with the motion cancel; negative means ahead.

    Args:
        positions: ``(T, 3)`` estimates or search starts of consecutive frames, metres; NaN where one does not count.
        true_positions: Same shape.
        dt_s: Seconds from frame to frame: one number, or ``(T - 1,)`` (:func:`surgbench.timing.steps_s`).

    Returns:
        Seconds; NaN without motion, which fewer than three frames are.

    Example:
        Each estimate is where the instrument was a frame, 0.1 s, ago; then where it is to be in a frame.

        >>> import numpy as np
        >>> from surgbench.metrics import lag
        >>> true = np.outer(np.linspace(0.0, 0.01, 11), [1.0, 2.0, 2.0])  # metres
        >>> round(lag(true[:-1], true[1:], dt_s=0.1), 9), round(lag(true[1:], true[:-1], dt_s=0.1), 9)
        (0.1, -0.1)
    """
    estimate, true = np.asarray(positions, dtype=np.float64), np.asarray(true_positions, dtype=np.float64)
    if len(true) < 3:
        return float("nan")
    before, after = _steps_around(dt_s, len(true))
    steps = np.diff(true, axis=0)
    # Uneven steps: of the parabola through three frames, at the middle one.
    uneven = (steps[1:] * (before / after) + steps[:-1] * (after / before)) / (before + after)
    velocity = np.where(before == after, (true[2:] - true[:-2]) / (2 * before), uneven)
    error = (estimate - true)[1:-1]
    counts = ~np.isnan(error).any(axis=-1)
    error, velocity = error[counts], velocity[counts]
    moved = float((velocity**2).sum())
    if moved == 0.0:
        return float("nan")
    return -float((error * velocity).sum()) / moved


def _steps_around(dt_s: ArrayLike, frames: int) -> tuple[FloatArray, FloatArray]:
    """Seconds to each frame but the first and the last from the one before, and from it to the next, ``(T - 2, 1)``."""
    steps = np.broadcast_to(np.asarray(dt_s, dtype=np.float64), (frames - 1,))[:, None]
    return steps[:-1], steps[1:]
