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

    Example:
        >>> import numpy as np
        >>> from surgbench.geometry import wrap_angle
        >>> wrap_angle(np.array([0.5, 1.0, 1.5]) * np.pi) / np.pi
        array([ 0.5, -1. , -0.5])
    """
    wrapped: FloatArray = np.mod(np.asarray(angle_rad, dtype=np.float64) + np.pi, 2 * np.pi) - np.pi
    return wrapped


def look_at_rotation(angles_rad: FloatArray) -> FloatArray:
    """Rotation matrices of look-at angles (eq. 9).

    Args:
        angles_rad: ``(..., 3)`` alpha, beta, gamma.

    Returns:
        ``(..., 3, 3)``: ``Ry(gamma) Rx(alpha) Rz(beta)``.

    Example:
        The last column is where the shaft points, in the camera frame: away from the camera and a little down, then
        to the right and a little up.

        >>> import numpy as np
        >>> from surgbench.geometry import look_at_rotation
        >>> angles = np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, np.pi / 2]])
        >>> look_at_rotation(angles)[:, :, 2].round(3)
        array([[ 0.   ,  0.1  ,  0.995],
               [ 0.995, -0.1  ,  0.   ]])
    """
    angles = np.asarray(angles_rad, dtype=np.float64)
    sines, cosines = np.sin(angles), np.cos(angles)
    sa, sb, sg = sines[..., 0], sines[..., 1], sines[..., 2]
    ca, cb, cg = cosines[..., 0], cosines[..., 1], cosines[..., 2]
    rotation = np.empty((*angles.shape, 3))
    rotation[..., 0, 0], rotation[..., 0, 1] = cg * cb + sg * sa * sb, -cg * sb + sg * sa * cb
    rotation[..., 1, 0], rotation[..., 1, 1] = ca * sb, ca * cb
    rotation[..., 2, 0], rotation[..., 2, 1] = -sg * cb + cg * sa * sb, sg * sb + cg * sa * cb
    rotation[..., 0, 2], rotation[..., 1, 2], rotation[..., 2, 2] = sg * ca, -sa, cg * ca
    return rotation


def look_at_angles(rotation: FloatArray) -> FloatArray:
    """Inverse of :func:`look_at_rotation`.

    Args:
        rotation: ``(..., 3, 3)`` rotation matrices.

    Returns:
        ``(..., 3)`` alpha in [-pi/2, pi/2], beta and gamma in [-pi, pi], radians.

    Example:
        >>> import numpy as np
        >>> from surgbench.geometry import look_at_angles, look_at_rotation
        >>> look_at_angles(look_at_rotation(np.array([0.3, -2.0, 0.8]))).round(9)
        array([ 0.3, -2. ,  0.8])
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

    Example:
        >>> import numpy as np
        >>> from surgbench.geometry import rotation_angle, rotation_from_vector
        >>> print(rotation_angle(rotation_from_vector(np.array([0.0, 3e-9, 4e-9]))).round(15))  # rad
        5e-09
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
    # 2 sin and 2 cos of the angle. The cosine alone is flat at 0 and pi, and says nothing of an angle below 1e-8.
    angle: FloatArray = np.arctan2(np.linalg.norm(skew, axis=-1), trace - 1.0)
    return angle


def rigid_transform(rotation: FloatArray, translation_m: FloatArray) -> FloatArray:
    """``(..., 4, 4)`` transforms of ``(..., 3, 3)`` rotations and ``(..., 3)`` translations.

    Example:
        A tool 13 cm before the camera, turned by a quarter about the optical axis: its x axis points down.

        >>> import numpy as np
        >>> from surgbench.geometry import rigid_transform
        >>> T_cam_tool = rigid_transform(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([0.0, 0.0, 0.13]))
        >>> T_cam_tool @ [0.01, 0.0, 0.0, 1.0]  # 1 cm along the tool's x axis, in the camera frame
        array([0.  , 0.01, 0.13, 1.  ])
    """
    transform = np.zeros((*np.shape(translation_m)[:-1], 4, 4))
    transform[..., :3, :3] = rotation
    transform[..., :3, 3] = translation_m
    transform[..., 3, 3] = 1.0
    return transform


def inverse_transform(transform: FloatArray) -> FloatArray:
    """Inverses of rigid transforms ``(..., 4, 4)``.

    Example:
        >>> import numpy as np
        >>> from surgbench.geometry import inverse_transform, rigid_transform
        >>> T_cam_tool = rigid_transform(np.diag([-1.0, -1.0, 1.0]), np.array([0.02, 0.01, 0.13]))
        >>> inverse_transform(T_cam_tool)[:3, 3]  # where the camera is in the tool's frame, metres
        array([ 0.02,  0.01, -0.13])
    """
    back = np.swapaxes(transform[..., :3, :3], -1, -2)
    return rigid_transform(back, -(back @ transform[..., :3, 3, None])[..., 0])


def is_rigid(transform: FloatArray, tolerance: float = 1e-6) -> bool:
    """Whether a ``(4, 4)`` matrix is a rotation and a translation.

    Example:
        >>> import numpy as np
        >>> from surgbench.geometry import is_rigid
        >>> is_rigid(np.eye(4)), is_rigid(np.diag([1.0, 1.0, -1.0, 1.0]))  # a mirror is none
        (True, False)
    """
    rotation = transform[:3, :3]
    orthogonal = np.abs(rotation @ rotation.T - np.eye(3)).max() <= tolerance
    return bool(orthogonal and np.linalg.det(rotation) > 0 and (transform[3] == [0, 0, 0, 1]).all())


def nearest_rotation(matrix: FloatArray) -> FloatArray:
    """The rotation nearest to a ``(3, 3)`` matrix, by the sum of squared differences (Arun et al. 1987).

    Example:
        >>> import numpy as np
        >>> from surgbench.geometry import nearest_rotation
        >>> rounded = np.array([[0.9211, -0.3894, 0], [0.3894, 0.9211, 0], [0, 0, 1]])  # to 4 digits
        >>> rotation = nearest_rotation(rounded)
        >>> print(np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-15, np.abs(rotation - rounded).max() < 1e-4)
        True True
    """
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    u[:, 2] *= np.sign(np.linalg.det(u @ vt))  # else a mirror
    nearest: FloatArray = u @ vt
    return nearest


def rotation_from_vector(vector_rad: FloatArray) -> FloatArray:
    """Rotation matrices of rotation vectors (Rodrigues' formula), exact near 0.

    Args:
        vector_rad: ``(..., 3)``: the axis times the angle.

    Returns:
        ``(..., 3, 3)``.

    Example:
        The x axis turned by 60 degrees about z, towards y:

        >>> import numpy as np
        >>> from surgbench.geometry import rotation_from_vector
        >>> rotation_from_vector(np.array([0.0, 0.0, np.pi / 3]))[:, 0].round(3)
        array([0.5  , 0.866, 0.   ])
    """
    vector = np.asarray(vector_rad, dtype=np.float64)
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    skew = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    # numpy's sinc(t) is sin(pi t) / (pi t).
    rotation: FloatArray = (
        np.eye(3) + np.sinc(angle / np.pi) * skew + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * (skew @ skew)
    )
    return rotation


def rotation_vector(rotation: FloatArray) -> FloatArray:
    """Inverse of :func:`rotation_from_vector`, exact near 0 and near pi.

    Args:
        rotation: ``(..., 3, 3)`` rotation matrices.

    Returns:
        ``(..., 3)``: the axis times the angle, of length at most pi.

    Example:
        >>> import numpy as np
        >>> from surgbench.geometry import rotation_vector
        >>> rotation_vector(np.diag([-1.0, 1.0, -1.0])) / np.pi  # half a turn about y
        array([0., 1., 0.])
    """
    r = np.asarray(rotation, dtype=np.float64)
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    sx, sy, sz = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    xy, xz, yz = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    # Four times the products of the quaternion (w, x, y, z) with itself; the row of its largest part is well scaled.
    rows = [
        [1 + xx + yy + zz, sx, sy, sz],
        [sx, 1 + xx - yy - zz, xy, xz],
        [sy, xy, 1 - xx + yy - zz, yz],
        [sz, xz, yz, 1 - xx - yy + zz],
    ]
    products = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    largest = np.argmax(np.diagonal(products, axis1=-2, axis2=-1), axis=-1)
    quaternion = np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    quaternion = np.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    length = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(length, quaternion[..., :1])
    vector: FloatArray = quaternion[..., 1:] * np.divide(angle, length, out=np.full_like(angle, 2.0), where=length > 0)
    return vector
