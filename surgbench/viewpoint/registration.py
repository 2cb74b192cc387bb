"""Where the camera arm's base is in the world, from points that both arms touched.

The set-up joints report the bases of the arms too poorly (MEASURED on a robot: some 0.3 m and 10 degrees), so that
before a trial both arms touch the same points. The published way takes their mean difference as a translation, which
leaves the rotation as it is and some 5 mm of error within the reach of the points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray

Method = Literal["none", "translation", "rigid"]
# Points whose second largest extent is below this lie on a line, about which they say nothing.
SMALLEST_EXTENT_M = 1e-3


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
            rotation and translation with the least squared difference (Kabsch 1976).

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
    if method == "rigid":
        centred_world, centred_base = world - world.mean(axis=0), base - base.mean(axis=0)
        if len(world) < 3 or np.linalg.svd(centred_base, compute_uv=False)[1] < SMALLEST_EXTENT_M:
            raise RegistrationError("a rigid registration needs three touched points that are not on a line")
        u, _, vt = np.linalg.svd(centred_world.T @ centred_base)
        result[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    elif not len(world):
        raise RegistrationError("a registration needs touched points")
    result[:3, 3] = world.mean(axis=0) - result[:3, :3] @ base.mean(axis=0)
    return result


def residual_m(T_world_base: FloatArray, touches: Touches) -> float:
    """Mean distance between the two arms' touched points, metres: the figure that the article calls the error."""
    difference = touches.base_m @ T_world_base[:3, :3].T + T_world_base[:3, 3] - touches.world_m
    return float(np.linalg.norm(difference, axis=1).mean())
