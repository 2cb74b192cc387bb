"""The stereo camera that the camera arm holds, and how it is mounted.

The point that controllers move, "camera", lies 45 mm along the tool's z, its axes the tool's (the published code).
The left optical centre is in that point; where the ring was in the authors' pictures tells how the camera is turned
about it (:class:`Mount`). As the camera's y axis points up when it is level, the pictures are upside down.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.config import Finite, Section
from surgbench.geometry import FloatArray, inverse_transform, rigid_transform, rotation_from_vector

Triple = tuple[Finite, Finite, Finite]
DEGREE = float(np.pi / 180)


class Mount(Section):
    """How the left camera is turned in the frame of the controlled point; their origins are one.

    ``R_camera_left = Rx(pitch) Ry(yaw)``. What lies on the z axis of the controlled point is seen ``f tan(pitch)``
    below the principal point, and ``f tan(-yaw)`` to its right.

    The authors' logs have the ring (+8, +37) px from the middle of the left picture and (-97, +33) px from that of the
    right one, at 107.5 mm (medians). The principal points and the baseline account for (-8, -4) and (-105, +2) of
    this; these two angles bring all four within 7 px.
    """

    pitch_rad: Finite = 5.5 * DEGREE
    yaw_rad: Finite = -1.6 * DEGREE


class StereoCamera(Section):
    """Two cameras with distorting lenses.

    Attributes:
        left: With its distortion (k1, k2, p1, p2, k3).
        right: As well.
        rotation_rad: Rotation vector of T_left_right.
        translation_m: The right optical centre in the left camera's frame.
        mount: How the left camera sits on the arm.
    """

    left: Camera
    right: Camera
    rotation_rad: Triple = (0.0, 0.0, 0.0)
    translation_m: Triple
    mount: Mount = Mount()

    @property
    def T_left_right(self) -> FloatArray:  # noqa: N802
        """``(4, 4)``: points of the right camera's frame in the left one's."""
        return rigid_transform(rotation_from_vector(np.array(self.rotation_rad)), np.array(self.translation_m))

    @property
    def T_camera_left(self) -> FloatArray:  # noqa: N802
        """``(4, 4)``: points of the left camera's frame in that of the controlled point."""
        pitch = rotation_from_vector(np.array([self.mount.pitch_rad, 0.0, 0.0]))
        yaw = rotation_from_vector(np.array([0.0, self.mount.yaw_rad, 0.0]))
        return rigid_transform(pitch @ yaw, np.zeros(3))

    @property
    def T_camera_right(self) -> FloatArray:  # noqa: N802
        """``(4, 4)``: points of the right camera's frame in that of the controlled point."""
        return np.asarray(self.T_camera_left @ self.T_left_right)

    @property
    def baseline_m(self) -> float:
        """Between the optical centres."""
        return float(np.linalg.norm(self.translation_m))

    def see(self, T_world_camera: FloatArray, points_world: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Where both cameras see points, if nothing hides them.

        Args:
            T_world_camera: ``(..., 4, 4)`` the controlled point.
            points_world: ``(..., 3)`` metres, one for each pose.

        Returns:
            ``(..., 2, 2)`` pixels, left then right, NaN where there are none; ``(..., 2)`` whether they are inside the
            picture.
        """
        pixels, inside = [], []
        for camera, T_camera_eye in ((self.left, self.T_camera_left), (self.right, self.T_camera_right)):
            back = inverse_transform(T_world_camera @ T_camera_eye)
            points = (back[..., :3, :3] @ np.asarray(points_world)[..., None])[..., 0] + back[..., :3, 3]
            pixels.append(camera.see(points))
            inside.append(camera.contains(pixels[-1]))
        return np.stack(pixels, axis=-2), np.stack(inside, axis=-1)


# Calibration of the authors' centroid recordings (42 pairs; AlexandreBanks6/RCL_Autocam_Public, CameraCalibration/
# Calib/Calib_ForCentroidValid), at the 0.4 of full resolution at which they work. Baseline from poses of one tag seen
# by both cameras in their logs; the published code does not use the stereo transform.
AUTOCAM_STEREO = StereoCamera(
    left=Camera(
        width=512,
        height=384,
        fx=387.365,
        fy=385.763,
        cx=247.653,
        cy=187.991,
        distortion=(0.19200, -0.55520, 0.003479, -0.001754, 0.46844),
    ),
    right=Camera(
        width=512,
        height=384,
        fx=396.165,
        fy=395.569,
        cx=250.865,
        cy=193.999,
        distortion=(0.26822, -0.80736, 0.005358, -0.005432, 0.77761),
    ),
    translation_m=(0.0265, 0.0, 0.0),
)
