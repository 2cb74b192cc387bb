"""The pose hypotheses of Liang et al. (arXiv:2503.05953; figures as in their released code).

The shaft is tilted by 30 to 60 degrees against the optical axis, at any roll, 0.10 to 0.17 m away.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from surgbench.camera import Camera
from surgbench.geometry import FloatArray, look_at_angles
from surgbench.state import ANGLES, JOINTS, POSITION, STATE_SIZE

DISTANCE_M = (0.10, 0.17)
ELEVATION_DEG = (30.0, 60.0)


def hypothesis_states(
    camera: Camera,
    roll_camera_rad: FloatArray,
    elevation_rad: FloatArray,
    roll_local_rad: FloatArray,
    distance_m: FloatArray,
    wrist_px: tuple[ArrayLike, ArrayLike],
    joints_rad: FloatArray,
) -> FloatArray:
    """States with ``R = Rz(roll_camera) Ry(elevation) Rz(roll_local)`` whose wrist is seen at a given pixel.

    Args:
        camera: The reference camera.
        roll_camera_rad: ``(n,)`` direction in the image that the shaft leans to.
        elevation_rad: ``(n,)`` angle of the shaft and the optical axis.
        roll_local_rad: ``(n,)`` turn about the shaft.
        distance_m: ``(n,)`` of the wrist along the optical axis.
        wrist_px: u and v of the wrist, each ``(n,)``.
        joints_rad: ``(n, 3)``.

    Returns:
        ``(n, 9)``.

    Example:
        A shaft that leans by 45 degrees to the right, its wrist 13 cm away in the image's middle:

        >>> import numpy as np
        >>> from surgbench.camera import Camera
        >>> from surgbench.search.hypotheses import hypothesis_states
        >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
        >>> none, lean, far = np.zeros(1), np.array([np.pi / 4]), np.array([0.13])
        >>> states = hypothesis_states(camera, none, lean, none, far, ([80], [60]), np.array([[0.1, 0.2, 0.3]]))
        >>> states[0, 2:].round(3)  # alpha and beta are 0
        array([0.785, 0.   , 0.   , 0.13 , 0.1  , 0.2  , 0.3  ])
    """
    states = np.empty((len(distance_m), STATE_SIZE))
    states[:, ANGLES] = look_at_angles(_rot_z(roll_camera_rad) @ _rot_y(elevation_rad) @ _rot_z(roll_local_rad))
    u, v = np.asarray(wrist_px[0]), np.asarray(wrist_px[1])
    x, y = (u - camera.cx) / camera.fx * distance_m, (v - camera.cy) / camera.fy * distance_m
    states[:, POSITION] = np.stack([x, y, distance_m], axis=1)
    states[:, JOINTS] = joints_rad
    return states


def _rot_z(angle_rad: FloatArray) -> FloatArray:
    c, s, zero, one = np.cos(angle_rad), np.sin(angle_rad), np.zeros_like(angle_rad), np.ones_like(angle_rad)
    return np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)


def _rot_y(angle_rad: FloatArray) -> FloatArray:
    c, s, zero, one = np.cos(angle_rad), np.sin(angle_rad), np.zeros_like(angle_rad), np.ones_like(angle_rad)
    return np.stack([c, zero, s, zero, one, zero, -s, zero, c], axis=-1).reshape(-1, 3, 3)
