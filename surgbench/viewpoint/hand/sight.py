"""What a stereo picture on the console shows of the ring: whether it is there, and how exactly its place can be seen.

A small thing of radius r at depth z, whose edges are located to ``noise_px`` in each picture, is known

- across the picture to ``z noise / f``;
- in depth to ``z^2 sqrt(2) noise / (f b)``, from the difference of both pictures, where both show it;
- about the view's axis, and about the two others, to the same over ``r sqrt(2)``, from two opposite edges.

So depth is seen the worse the farther away the camera and the shorter its baseline is, and a ring that is seen along
its normal has all of its way square to the wire across the picture. Other cues to depth (size, shadow, which of two
things covers the other) are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.compiled import compiled
from surgbench.geometry import FloatArray, inverse_transform, rigid_transform
from surgbench.viewpoint.optics.grasp_object import TUBE_RADIUS_M
from surgbench.viewpoint.optics.rays import mark_free
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO, StereoCamera
from surgbench.viewpoint.optics.visibility import POINTS, SEEN_SHARE, covering, ring_points_m
from surgbench.viewpoint.placement import view_along


@dataclass(frozen=True, eq=False)
class View:
    """A stereo camera as the console shows it: without its lenses.

    Attributes:
        left: Of the pictures as they are shown.
        right: Likewise.
        T_camera_left: ``(4, 4)`` in the frame of the point whose pose is known.
        T_camera_right: ``(4, 4)``.
    """

    left: Camera
    right: Camera
    T_camera_left: FloatArray
    T_camera_right: FloatArray

    @classmethod
    def of(cls, cameras: StereoCamera) -> View:
        """Of a stereo camera on an arm."""
        return cls(cameras.left.pinhole, cameras.right.pinhole, cameras.T_camera_left, cameras.T_camera_right)

    @property
    def baseline_m(self) -> float:
        """Between the optical centres."""
        return float(np.linalg.norm(self.T_camera_right[:3, 3] - self.T_camera_left[:3, 3]))


def _endoscope() -> View:
    # A stereo laparoscope has its lenses 5 mm apart (Surg Endosc 22, 2008, doi 10.1007/s00464-008-0032-8). Its field of
    # 50 degrees is our choice, and that it fills the console's window of 1024 columns where it is the only view.
    eye = Camera(width=1024, height=768, fx=1097.0, fy=1097.0, cx=511.5, cy=383.5)
    right = rigid_transform(np.eye(3), np.array([0.005, 0.0, 0.0]))
    return View(eye, eye, np.eye(4), right)


AUXILIARY = View.of(AUTOCAM_STEREO)
ENDOSCOPE = _endoscope()
# Where the endoscope's tip is, from the middle of the task: 0.15 m away, from above and from the side of both arms'
# remote centres, between them. Our choice; the article says only that it is stationary.
ENDOSCOPE_FROM_M = 0.15 * np.array([0.02, -0.13, 0.20]) / math.hypot(0.02, 0.13, 0.20)


def endoscope_pose(middle_m: FloatArray) -> FloatArray:
    """T_world_camera ``(4, 4)`` of the endoscope: it looks at the middle of the task, picture upright."""
    rotation = view_along(-ENDOSCOPE_FROM_M / np.linalg.norm(ENDOSCOPE_FROM_M))
    # The controllers' cameras have y up; this one has it down.
    return rigid_transform(rotation * np.array([-1.0, -1.0, 1.0]), middle_m + ENDOSCOPE_FROM_M)


@compiled
def count_points(
    T_ring_eye: FloatArray, intrinsics: FloatArray, points: FloatArray, free: NDArray[np.bool_]
) -> tuple[int, int]:
    """How many points of the ring are inside a picture, and how many of these nothing covers.

    Args:
        T_ring_eye: ``(4, 4)``.
        intrinsics: ``(6,)`` fx, fy, cx, cy, width, height.
        points: ``(n, 3)`` in the ring's frame.
        free: ``(n,)`` what nothing covers.
    """
    inside = seen = 0
    for number in range(len(points)):
        x = y = z = 0.0
        for k in range(3):
            away = points[number, k] - T_ring_eye[k, 3]
            x += T_ring_eye[k, 0] * away
            y += T_ring_eye[k, 1] * away
            z += T_ring_eye[k, 2] * away
        if z <= 0.0:
            continue
        u, v = intrinsics[0] * x / z + intrinsics[2], intrinsics[1] * y / z + intrinsics[3]
        if -0.5 <= u <= intrinsics[4] - 0.5 and -0.5 <= v <= intrinsics[5] - 0.5:
            inside += 1
            seen += free[number]
    return inside, seen


class Sight:
    """Looks at the ring through one view.

    Args:
        view: The stereo camera.
        ring_radius_m: Of the circle in the middle of the ring's tube.
        noise_px: How exactly an edge is located in each picture, one standard deviation.
        one_eye_m: How exactly depth is known to one eye alone.
    """

    def __init__(self, view: View, ring_radius_m: float, noise_px: float, one_eye_m: float) -> None:
        self.view, self._baseline_m = view, view.baseline_m
        self._radius_m, self._noise_px, self._one_eye_m = ring_radius_m, noise_px, one_eye_m
        self._points_m, self._free = ring_points_m(), np.empty((1, POINTS), dtype=np.bool_)
        self._eyes = [
            (
                T_camera_eye,
                np.array([eye.fx, eye.fy, eye.cx, eye.cy, float(eye.width), float(eye.height)]),
            )
            for eye, T_camera_eye in ((view.left, view.T_camera_left), (view.right, view.T_camera_right))
        ]

    def eyes(self, T_world_camera: FloatArray, T_world_ring: FloatArray) -> tuple[int, int]:
        """How many of both pictures the ring is in, and in how many of these the tool does not hide it.

        Of half of the ring at least; what hides it as in :mod:`surgbench.viewpoint.optics.visibility`.
        """
        T_ring_camera = inverse_transform(T_world_ring) @ T_world_camera
        inside = free = 0
        for T_camera_eye, intrinsics in self._eyes:
            T_ring_eye = T_ring_camera @ T_camera_eye
            mark_free(T_ring_eye[None, :3, 3].copy(), self._points_m, TUBE_RADIUS_M, covering(), self._free)
            within, seen = count_points(T_ring_eye, intrinsics, self._points_m, self._free[0])
            inside += within >= SEEN_SHARE * POINTS
            free += seen >= SEEN_SHARE * POINTS
        return inside, free

    def uncertainty(self, depth_m: float, eyes: int) -> tuple[FloatArray, FloatArray]:
        """Standard deviations, along the camera's axes, of where the ring is (m) and how it is turned (rad).

        Args:
            depth_m: From the camera, more than 0.
            eyes: 1 or 2, as many as show it.
        """
        focal_px = self.view.left.fx
        across = depth_m * self._noise_px / focal_px
        deep = math.sqrt(2.0) * depth_m * across / self._baseline_m if eyes == 2 else self._one_eye_m
        turned = np.array([deep, deep, across]) / (math.sqrt(2.0) * self._radius_m)
        return np.array([across, across, deep]), turned
