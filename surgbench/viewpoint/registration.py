"""Where the camera arm's base is in the world, from points that both arms touched.

The set-up joints report the bases of the arms too poorly (MEASURED on a robot: some 0.3 m and 10 degrees), so that
before a trial both arms touch the same points. The published way takes their mean difference as a translation, which
leaves the rotation as it is and some 5 mm of error within the reach of the points. What the article says instead is a
transform with the least mean absolute error; its code has none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray, rigid_transform

Method = Literal["none", "translation", "rigid", "lad"]
# Points whose second largest extent is below this lie on a line, about which they say nothing.
SMALLEST_EXTENT_M = 1e-3
# Distances of least absolute deviations are rounded off near 0 at this length, which shrinks until it is the last one.
ROUNDED_M, LEAST_ROUNDED_M, SHRINK = 1e-3, 1e-11, 0.8


class RegistrationError(SurgbenchError):
    """Touched points that register nothing."""


@dataclass(frozen=True, eq=False)
class Touches:
    """The same points, touched by two arms.

    Attributes:
        world_m: ``(n, 3)`` tips of the arm that the world frame belongs to.
        base_m: ``(n, 3)`` tips of the camera arm, in the frame of its base.
    """

    world_m: FloatArray
    base_m: FloatArray


def register(T_world_base: FloatArray, touches: Touches, method: Method) -> FloatArray:
    """T_world_base after registration.

    Args:
        T_world_base: ``(4, 4)`` as the set-up joints report it.
        touches: At least one point for a translation, three that are not on a line for a rigid transform.
        method: ``"none"``; ``"translation"``: add the mean difference of the points (as published); ``"rigid"``: the
            rotation and translation with the least squared difference (Kabsch 1976); ``"lad"``: those with the least
            sum of distances (:func:`least_absolute`), so that one bad touch counts for little.

    Returns:
        ``(4, 4)``.

    Raises:
        RegistrationError: The points are not finite, or too few, or on a line.
    """
    result = np.array(T_world_base, dtype=np.float64)
    if method == "none":
        return result
    world, base = np.asarray(touches.world_m), np.asarray(touches.base_m)
    if world.shape != base.shape or world.ndim != 2 or not (np.isfinite(world).all() and np.isfinite(base).all()):
        raise RegistrationError("touched points must be as many of the one arm as of the other, and finite")
    if method == "translation":
        if not len(world):
            raise RegistrationError("a registration needs touched points")
        result[:3, 3] = world.mean(axis=0) - result[:3, :3] @ base.mean(axis=0)
        return result
    centred = base - base.mean(axis=0)
    if len(world) < 3 or np.linalg.svd(centred, compute_uv=False)[1] < SMALLEST_EXTENT_M:
        raise RegistrationError("a rigid registration needs three touched points that are not on a line")
    return least_absolute(touches) if method == "lad" else least_squares(touches, np.ones(len(world)))


def least_squares(touches: Touches, weights: FloatArray) -> FloatArray:
    """The rigid transform ``(4, 4)`` that takes the base's points to the world's with the least squared difference.

    Args:
        touches: Three points that are not on a line, at least.
        weights: ``(n,)`` of the points.
    """
    shares = weights / weights.sum()
    world_mean, base_mean = shares @ touches.world_m, shares @ touches.base_m
    u, _, vt = np.linalg.svd((shares[:, None] * (touches.world_m - world_mean)).T @ (touches.base_m - base_mean))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rigid_transform(rotation, world_mean - rotation @ base_mean)


def least_absolute(touches: Touches) -> FloatArray:
    """The rigid transform ``(4, 4)`` with the least sum of distances between the two arms' points.

    The article minimises "the mean absolute error between the reprojected points"; as the error it takes the distance
    of two points, not single coordinates, so that the answer does not depend on how the world's axes lie. By
    iteratively reweighted least squares (Weiszfeld 1937): each point weighs the inverse of its distance, the root of
    ``d^2 + r^2`` near 0, with an ``r`` that shrinks from step to step.

    Args:
        touches: Three points that are not on a line, at least.
    """
    result = least_squares(touches, np.ones(len(touches.world_m)))
    rounded = ROUNDED_M
    while rounded > LEAST_ROUNDED_M:
        result = least_squares(touches, 1.0 / np.hypot(distances_m(result, touches), rounded))
        rounded *= SHRINK
    return result


def distances_m(T_world_base: FloatArray, touches: Touches) -> FloatArray:
    """``(n,)`` distances between the two arms' touched points, metres."""
    reprojected = touches.base_m @ T_world_base[:3, :3].T + T_world_base[:3, 3]
    return np.asarray(np.linalg.norm(reprojected - touches.world_m, axis=1))


def residual_m(T_world_base: FloatArray, touches: Touches) -> float:
    """Mean distance between the two arms' touched points, metres: the figure that the article calls the error."""
    return float(distances_m(T_world_base, touches).mean())
