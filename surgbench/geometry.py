"""Rotations and rigid transforms in the look-at parameterisation of the instrument state.

``R = Ry(gamma) Rx(alpha) Rz(beta)`` (Hu et al. 2026, eq. 9) turns vectors of the wrist-pitch frame
into the camera frame (OpenCV axes: x right, y down, z forward).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def wrap_angle(angle_rad: FloatArray | float) -> FloatArray:
    """Wrap angles into [-pi, pi).

    Args:
        angle_rad: Any shape.

    Returns:
        Same shape, radians.
    """
    wrapped: FloatArray = np.mod(np.asarray(angle_rad, dtype=np.float64) + np.pi, 2 * np.pi) - np.pi
    return wrapped


def look_at_rotation(angles_rad: FloatArray) -> FloatArray:
    """Rotation matrices of look-at angles (eq. 9).

    Args:
        angles_rad: ``(..., 3)`` alpha, beta, gamma.

    Returns:
        ``(..., 3, 3)``: ``Ry(gamma) Rx(alpha) Rz(beta)``.
    """
    angles = np.asarray(angles_rad, dtype=np.float64)
    (sa, sb, sg), (ca, cb, cg) = np.moveaxis(np.sin(angles), -1, 0), np.moveaxis(np.cos(angles), -1, 0)
    rows = [
        [cg * cb + sg * sa * sb, -cg * sb + sg * sa * cb, sg * ca],
        [ca * sb, ca * cb, -sa],
        [-sg * cb + cg * sa * sb, sg * sb + cg * sa * cb, cg * ca],
    ]
    rotation: FloatArray = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return rotation


def look_at_angles(rotation: FloatArray) -> FloatArray:
    """Inverse of :func:`look_at_rotation`.

    Args:
        rotation: ``(..., 3, 3)`` rotation matrices.

    Returns:
        ``(..., 3)`` alpha in [-pi/2, pi/2], beta and gamma in [-pi, pi], radians.
    """
    r = np.asarray(rotation, dtype=np.float64)
    alpha = np.arcsin(np.clip(-r[..., 1, 2], -1.0, 1.0))
    beta = np.arctan2(r[..., 1, 0], r[..., 1, 1])
    gamma = np.arctan2(r[..., 0, 2], r[..., 2, 2])
    return np.stack([alpha, beta, gamma], axis=-1)


def rotation_angle(rotation: FloatArray) -> FloatArray:
    """Geodesic angle of rotation matrices, ``|log(R)|``, exact near 0 and near pi.

    Args:
        rotation: ``(..., 3, 3)``.

    Returns:
        ``(...)`` radians in [0, pi].
    """
    r = np.asarray(rotation, dtype=np.float64)
    trace = np.trace(r, axis1=-2, axis2=-1)
    skew = np.stack(
        [
            r[..., 2, 1] - r[..., 1, 2],
            r[..., 0, 2] - r[..., 2, 0],
            r[..., 1, 0] - r[..., 0, 1],
        ],
        axis=-1,
    )
    angle: FloatArray = np.arctan2(np.linalg.norm(skew, axis=-1), trace - 1.0)
    return angle
