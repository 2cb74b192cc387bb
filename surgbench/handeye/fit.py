"""The one constant transform between two series of poses, in closed form and against outliers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from surgbench.geometry import FloatArray, inverse_transform, rigid_transform, rotation_from_vector, rotation_vector
from surgbench.state import Symmetry

# Frames whose own transform is tried as a beginning, and how often weights are taken anew from there.
STARTS = 8
ROUNDS = 10
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
# Median absolute deviation of a Gaussian, to its standard deviation.
MAD_SIGMAS = 1.4826
# Finer than any tracker; below it rounding would count.
LEAST_RAD, LEAST_M = 1e-6, 1e-7


class Scales(NamedTuple):
    """How far a component of a residual is usually off.

    Attributes:
        rotation_rad: Each component of the rotation vector.
        translation_m: Each component of the position.
    """

    rotation_rad: float
    translation_m: float


# A good tracker on a real recording: 3 degrees and 2 mm.
NOMINAL = Scales(0.05, 0.002)


def residuals(transform: FloatArray, tracked: FloatArray, arm: FloatArray, symmetry: Symmetry = "twin") -> FloatArray:
    """How far tracked poses are from where a transform puts the arm's, after the twin rule.

    A tracked pose and, of an instrument with a twin, the one turned by half a turn about its z axis, the shaft, have
    nearly the same silhouette: the one of the two that is nearer counts.

    Args:
        transform: ``(4, 4)`` T_cam_base.
        tracked: ``(n, 4, 4)`` T_cam_wrist.
        arm: ``(n, 4, 4)`` T_base_wrist.
        symmetry: The instrument's.

    Returns:
        ``(n, 6)``: rotation vector and difference of positions, radians and metres, in the camera's frame.
    """
    expected = transform @ arm
    rotation = nearest_alike(tracked[:, :3, :3], expected[:, :3, :3], symmetry)
    turned = rotation_vector(rotation @ np.swapaxes(expected[:, :3, :3], 1, 2))
    return np.hstack([turned, tracked[:, :3, 3] - expected[:, :3, 3]])


def nearest_alike(rotation: FloatArray, expected: FloatArray, symmetry: Symmetry = "twin") -> FloatArray:
    """``(n, 3, 3)`` rotations, each turned about its own z axis as the symmetry allows to be nearest to the expected.

    By half a turn or not at all (``twin``), not at all (``none``), or by any angle (``axis``).
    """
    if symmetry == "none":
        return rotation
    if symmetry == "axis":
        between = np.swapaxes(expected, 1, 2) @ rotation
        turn = np.arctan2(between[:, 0, 1] - between[:, 1, 0], between[:, 0, 0] + between[:, 1, 1])
        about = np.zeros((len(turn), 3))
        about[:, 2] = turn
        return np.asarray(rotation @ rotation_from_vector(about))
    along = (rotation[:, :, :2] * expected[:, :, :2]).sum(axis=(1, 2))
    sign = np.where(along < 0, -1.0, 1.0)
    return np.asarray(rotation * np.stack([sign, sign, np.ones_like(sign)], axis=1)[:, None, :])


def closed_form(tracked: FloatArray, arm: FloatArray, weights: FloatArray) -> FloatArray:
    """The transform of least weighted squares (Kabsch's method on positions and axes together).

    With ``X`` for T_cam_base it minimises ``sum w_r |R_c - R_X R_b|² / 2 + w_t |p_c - R_X p_b - t_X|²``; of a small
    angle the first is its square.

    Args:
        tracked: ``(n, 4, 4)`` T_cam_wrist, of two twins the right one.
        arm: ``(n, 4, 4)`` T_base_wrist.
        weights: ``(n, 2)`` of rotations (1/rad²) and positions (1/m²), of which some are above 0.

    Returns:
        ``(4, 4)`` T_cam_base.
    """
    of_turn, of_place = weights.T
    total = max(float(of_place.sum()), np.finfo(np.float64).tiny)
    middle_cam = of_place @ tracked[:, :3, 3] / total
    middle_base = of_place @ arm[:, :3, 3] / total
    places = ((tracked[:, :3, 3] - middle_cam) * of_place[:, None]).T @ (arm[:, :3, 3] - middle_base)
    turns = 0.5 * np.einsum("n,nij,nkj->ik", of_turn, tracked[:, :3, :3], arm[:, :3, :3])
    u, _, v = np.linalg.svd(places + turns)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    return rigid_transform(rotation, middle_cam - rotation @ middle_base)


def costs(
    transforms: FloatArray, tracked: FloatArray, arm: FloatArray, scales: Scales, symmetry: Symmetry = "twin"
) -> FloatArray:
    """What transforms ``(..., 4, 4)`` leave, ``(...)``, mean ``log(1 + (angle/s_r)²) + log(1 + (distance/s_t)²)``."""
    return np.asarray(
        np.log1p(_relative_squares(transforms, tracked, arm, scales, symmetry)).sum(axis=-1).mean(axis=-1)
    )


def robust_fit(tracked: FloatArray, arm: FloatArray, scales: Scales, symmetry: Symmetry = "twin") -> FloatArray:
    """The transform that most frames agree on: iteratively reweighted, with Cauchy's weights.

    It begins at that frame's own transform, of some spread over the series, which costs least.

    Args:
        tracked: ``(n, 4, 4)`` T_cam_wrist.
        arm: ``(n, 4, 4)`` T_base_wrist.
        scales: Beyond which a frame counts less and less.
        symmetry: The instrument's.

    Returns:
        ``(4, 4)`` T_cam_base.
    """
    some = np.unique(np.linspace(0, len(arm) - 1, STARTS).round().astype(int))
    back = inverse_transform(arm[some])
    starts = np.concatenate([tracked[some] @ back, tracked[some] @ HALF_TURN @ back])
    transform = starts[np.argmin(costs(starts, tracked, arm, scales, symmetry))]
    for _ in range(ROUNDS):
        weights = 1.0 / (1.0 + _relative_squares(transform, tracked, arm, scales, symmetry))
        right = tracked.copy()
        right[:, :3, :3] = nearest_alike(tracked[:, :3, :3], transform[:3, :3] @ arm[:, :3, :3], symmetry)
        transform = closed_form(right, arm, weights / np.square(scales))
    return np.asarray(transform)


def spread(off: FloatArray) -> Scales:
    """Robust standard deviations of the components of residuals ``(n, 6)``."""
    deviations = MAD_SIGMAS * np.median(np.abs(off), axis=0)
    return Scales(
        max(float(np.sqrt((deviations[:3] ** 2).mean())), LEAST_RAD),
        max(float(np.sqrt((deviations[3:] ** 2).mean())), LEAST_M),
    )


def _relative_squares(
    transforms: FloatArray, tracked: FloatArray, arm: FloatArray, scales: Scales, symmetry: Symmetry
) -> FloatArray:
    """``(..., n, 2)`` squared angles (by their chord) and distances of the nearest alike, in units of their scales."""
    expected = transforms[..., None, :3, :] @ arm
    along = (expected[..., :3] * tracked[:, :3, :3]).sum(axis=-2)
    # The trace of the rotation between the two, that of the nearest alike; of small angles 3 - trace is the square.
    level = along[..., 0] + along[..., 1]
    if symmetry == "twin":
        level = np.abs(level)
    elif symmetry == "axis":
        across = expected[..., 0] * tracked[:, :3, 1] - expected[..., 1] * tracked[:, :3, 0]
        level = np.hypot(level, across.sum(axis=-1))
    trace = level + along[..., 2]
    squares = np.stack([3.0 - trace, ((expected[..., 3] - tracked[:, :3, 3]) ** 2).sum(axis=-1)], axis=-1)
    return np.asarray(np.maximum(squares, 0.0) / np.square(scales))
