"""A patient-side manipulator: from its first four joints to the instrument's wrist, and back.

The da Vinci's arm turns an instrument about a fixed point, the remote centre, at the body wall. Its base frame has its
origin there, z pointing up along the arm. Yaw, pitch, insertion and roll place the wrist-pitch frame (DH frame 4: z
along the shaft towards the jaws); the shaft's centre line always passes through the remote centre. Modified
Denavit-Hartenberg parameters, ``T = Rx(alpha) Tx(a) Rz(theta) Tz(d)`` (jhu-dvrk/sawIntuitiveResearchKit,
share/kinematic/PSM.json and share/tool):

==  =========  ======  ==  =========  ========================
i   joint      alpha   a   theta      d
==  =========  ======  ==  =========  ========================
1   yaw        +pi/2   0   q1 + pi/2  0
2   pitch      -pi/2   0   q2 - pi/2  0
3   insertion  +pi/2   0   0          q3 + insertion_offset_m
4   roll       0       0   q4         roll_offset_m
==  =========  ======  ==  =========  ========================
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surgbench.geometry import FloatArray, rigid_transform

YAW, PITCH, INSERTION, ROLL = range(4)
ARM_JOINTS = 4


@dataclass(frozen=True)
class Manipulator:
    """Kinematics of an arm with an instrument mounted, down to the wrist-pitch frame.

    Attributes:
        roll_offset_m: Of the instrument (joint 4).
        insertion_offset_m: Of the arm (joint 3).
        lower: ``(4,)`` lower limits: radians, radians, metres, radians.
        upper: ``(4,)`` upper limits.
    """

    roll_offset_m: float
    insertion_offset_m: float = -0.4318
    lower: tuple[float, float, float, float] = (-1.588, -0.925025, 0.0, -4.53786)
    upper: tuple[float, float, float, float] = (1.588, 0.925025, 0.24, 4.53786)

    def within_limits(self, joints: FloatArray) -> np.ndarray:
        """Which of ``(..., 4)`` joints lie within the limits, ``(...)`` bool."""
        inside = (joints >= np.array(self.lower)) & (joints <= np.array(self.upper))
        return np.asarray(inside.all(axis=-1))

    def depth_m(self, insertion_m: FloatArray | float) -> FloatArray:
        """How far below the remote centre the wrist is at an insertion, metres; negative above it."""
        return np.asarray(insertion_m, dtype=np.float64) + self.insertion_offset_m + self.roll_offset_m

    def forward(self, joints: FloatArray) -> FloatArray:
        """Forward kinematics.

        Args:
            joints: ``(..., 4)`` yaw, pitch (radians), insertion (metres), roll (radians).

        Returns:
            ``(..., 4, 4)`` T_base_wrist.
        """
        joints = np.asarray(joints, dtype=np.float64)
        x3, y3, axis = _frame_3(joints[..., YAW], joints[..., PITCH])
        cos, sin = np.cos(joints[..., ROLL, None]), np.sin(joints[..., ROLL, None])
        rotation = np.stack([cos * x3 + sin * y3, cos * y3 - sin * x3, axis], axis=-1)
        return rigid_transform(rotation, self.depth_m(joints[..., INSERTION])[..., None] * axis)

    def inverse(self, T_base_wrist: FloatArray) -> FloatArray:
        """The joints that reach a pose, in closed form; unique where pitch is within ±pi/2.

        Args:
            T_base_wrist: ``(..., 4, 4)``. The shaft's line (its z axis) must pass through the origin; of one that does
                not, the point nearest to the origin counts as the remote centre.

        Returns:
            ``(..., 4)`` joints: yaw and roll in [-pi, pi], pitch in [-pi/2, pi/2]. They may lie outside the limits.
        """
        pose = np.asarray(T_base_wrist, dtype=np.float64)
        axis = pose[..., :3, 2]
        yaw, pitch = _aim(axis)
        x3, y3, _ = _frame_3(yaw, pitch)
        across = pose[..., :3, 0]
        roll = np.arctan2((y3 * across).sum(axis=-1), (x3 * across).sum(axis=-1))
        return np.stack([yaw, pitch, self._insertion((axis * pose[..., :3, 3]).sum(axis=-1)), roll], axis=-1)

    def reach(self, wrist_base_m: FloatArray) -> FloatArray:
        """Yaw, pitch and insertion that bring the wrist to a point below the remote centre.

        Args:
            wrist_base_m: ``(..., 3)`` metres in the base frame, not its origin.

        Returns:
            ``(..., 3)``; they may lie outside the limits.
        """
        point = np.asarray(wrist_base_m, dtype=np.float64)
        depth = np.linalg.norm(point, axis=-1)
        return np.stack([*_aim(point / depth[..., None]), self._insertion(depth)], axis=-1)

    def jacobian(self, joints: FloatArray) -> FloatArray:
        """Geometric Jacobian of the wrist-pitch frame.

        Args:
            joints: ``(..., 4)``.

        Returns:
            ``(..., 6, 4)``: velocity of the frame's origin (m/s), then angular velocity (rad/s), both in the base
            frame, per unit of joint velocity.
        """
        joints = np.asarray(joints, dtype=np.float64)
        _, y3, axis = _frame_3(joints[..., YAW], joints[..., PITCH])
        wrist = self.depth_m(joints[..., INSERTION])[..., None] * axis
        yaw_axis = np.broadcast_to([0.0, -1.0, 0.0], axis.shape)
        result = np.zeros((*joints.shape[:-1], 6, ARM_JOINTS))
        # The pitch axis is frame 2's z, which is frame 3's y.
        for column, turning in ((YAW, yaw_axis), (PITCH, y3), (ROLL, axis)):
            result[..., :3, column] = np.cross(turning, wrist)
            result[..., 3:, column] = turning
        result[..., :3, INSERTION] = axis
        return result

    def _insertion(self, depth_m: FloatArray) -> FloatArray:
        return depth_m - self.insertion_offset_m - self.roll_offset_m


def _frame_3(yaw_rad: FloatArray, pitch_rad: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Axes of DH frame 3, ``(..., 3)`` each; the third is the shaft's."""
    s1, c1, s2, c2 = np.sin(yaw_rad), np.cos(yaw_rad), np.sin(pitch_rad), np.cos(pitch_rad)
    x3 = np.stack([-s1 * s2, -c2, c1 * s2], axis=-1)
    y3 = np.stack([-c1, np.zeros_like(c1), -s1], axis=-1)
    z3 = np.stack([s1 * c2, -s2, -c1 * c2], axis=-1)
    return x3, y3, z3


def _aim(axis: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Yaw and pitch that point the shaft along unit vectors ``(..., 3)``."""
    return np.arctan2(axis[..., 0], -axis[..., 2]), np.arcsin(np.clip(-axis[..., 1], -1.0, 1.0))


# A Classic arm (PSM.json) with a Large Needle Driver 400006, and the same arm with the longer instruments of the S and
# Si (420006, 420093 and others).
CLASSIC_400006 = Manipulator(roll_offset_m=0.4162)
CLASSIC_420006 = Manipulator(roll_offset_m=0.4670)
