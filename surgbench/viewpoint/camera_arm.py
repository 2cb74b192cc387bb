"""The arm that holds the camera: its kinematics as a robot's user sees them, its limits, and where the camera sits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.instrument.arm import CLASSIC_420006, Manipulator
from surgbench.viewpoint import kinematics

YAW, PITCH, INSERTION, ROLL, WRIST_PITCH, WRIST_YAW = range(6)
DEGREE = np.pi / 180


@dataclass(frozen=True)
class CameraArm:
    """An arm of the da Vinci that holds a camera: unless told, a patient-side manipulator with a ProGrasp (420093).

    Joints are ``(6,)``: yaw, pitch (rad), insertion (m), roll, wrist pitch, wrist yaw (rad). The base frame has its
    origin in the remote centre and z up along the arm. Limits are those of the robot's configuration files
    (jhu-dvrk/sawIntuitiveResearchKit: share/kinematic/PSM.json, and since March 2023 those of its trajectories).
    Other arms are read from files (:mod:`surgbench.viewpoint.arm_files`). One with fewer joints has the rest of them
    locked, the lower limit equal to the upper one: an endoscope is a straight wrist, one that looks to 30 degrees a
    bent one.

    Attributes:
        manipulator: The first four joints.
        wrist_length_m: From the wrist pitch to the wrist yaw axis.
        wrist_lower_rad: Lower limits of wrist pitch and wrist yaw.
        wrist_upper_rad: Upper limits.
        velocity: ``(6,)`` largest joint velocities, rad/s and m/s.
        acceleration: ``(6,)`` largest joint accelerations, rad/s^2 and m/s^2.
        camera_m: How far the camera is from the tool's origin, along its z; the camera looks along that z.
        name: For messages.
    """

    manipulator: Manipulator = CLASSIC_420006
    wrist_length_m: float = 0.0107
    wrist_lower_rad: tuple[float, float] = (-1.39626, -1.39626)
    wrist_upper_rad: tuple[float, float] = (1.39626, 1.39626)
    velocity: tuple[float, ...] = (90 * DEGREE, 90 * DEGREE, 0.2, *(1080 * DEGREE,) * 3)
    acceleration: tuple[float, ...] = (90 * DEGREE, 90 * DEGREE, 0.2, *(720 * DEGREE,) * 3)
    camera_m: float = 0.045
    name: str = "psm_classic"

    @cached_property
    def packed(self) -> FloatArray:
        """``(3,)``, what the functions of :mod:`surgbench.viewpoint.kinematics` take as ``arm``."""
        return np.array([self.manipulator.insertion_offset_m, self.manipulator.roll_offset_m, self.wrist_length_m])

    @cached_property
    def lower(self) -> FloatArray:
        """``(6,)`` lower joint limits."""
        return np.array([*self.manipulator.lower, *self.wrist_lower_rad])

    @cached_property
    def upper(self) -> FloatArray:
        """``(6,)`` upper joint limits."""
        return np.array([*self.manipulator.upper, *self.wrist_upper_rad])

    @cached_property
    def locked(self) -> NDArray[np.bool_]:
        """``(6,)`` which joints cannot move."""
        return np.asarray(self.lower == self.upper)

    @cached_property
    def middle(self) -> FloatArray:
        """``(6,)`` joints in the middle of their limits."""
        return np.asarray((self.lower + self.upper) / 2)

    def within_limits(self, joints: FloatArray, tolerance: float = 0.0) -> NDArray[np.bool_]:
        """Which of ``(..., 6)`` joints lie within the limits, ``(...)`` bool."""
        inside = (joints >= self.lower - tolerance) & (joints <= self.upper + tolerance)
        return np.asarray(inside.all(axis=-1))

    def clip(self, joints: FloatArray) -> FloatArray:
        """Joints within the limits."""
        return np.clip(joints, self.lower, self.upper)

    def forward(self, joints: FloatArray) -> FloatArray:
        """T_base_camera of ``(..., 6)`` joints, ``(..., 4, 4)``."""
        joints = np.ascontiguousarray(joints, dtype=np.float64)
        poses = np.empty((*joints.shape[:-1], 4, 4))
        kinematics.forward_all(self.packed, joints.reshape(-1, 6), poses.reshape(-1, 4, 4))
        poses[..., :3, 3] += self.camera_m * poses[..., :3, 2]
        return poses

    def inverse(self, T_base_camera: FloatArray, near: FloatArray | None = None) -> FloatArray:
        """The joints that bring the camera to a pose, in closed form.

        Args:
            T_base_camera: ``(..., 4, 4)``.
            near: ``(6,)`` joints; the roll is given in the turn nearest to theirs. In the middle of its range unless
                told.

        Returns:
            ``(..., 6)``; outside the limits where the pose is out of reach, never NaN.
        """
        poses = np.array(T_base_camera, dtype=np.float64)
        poses[..., :3, 3] -= self.camera_m * poses[..., :3, 2]
        joints = np.empty((*poses.shape[:-2], 6))
        close = self.middle if near is None else np.asarray(near, dtype=np.float64)
        kinematics.inverse_all(self.packed, poses.reshape(-1, 4, 4), close, joints.reshape(-1, 6))
        return joints

    def newton(self, T_base_camera: FloatArray, start: FloatArray) -> tuple[FloatArray, bool]:
        """The joints ``(6,)`` that bring the camera to a pose by damped Newton steps, and whether they converged.

        Args:
            T_base_camera: ``(4, 4)``.
            start: ``(6,)`` where the steps begin; the roll is given in the turn nearest to its.
        """
        pose = np.array(T_base_camera, dtype=np.float64)
        pose[:3, 3] -= self.camera_m * pose[:3, 2]
        joints = np.empty(6)
        converged = kinematics.newton(self.packed, pose, np.asarray(start, dtype=np.float64), joints)
        joints[ROLL] += 2 * np.pi * np.round((start[ROLL] - joints[ROLL]) / (2 * np.pi))
        return joints, bool(converged)


# AutoCam's, and the default.
PSM_CLASSIC = CameraArm()
