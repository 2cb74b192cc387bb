"""Columns of the tables of the instrument task."""

from __future__ import annotations

from collections.abc import Sequence

STATE_COLUMNS = ("alpha_rad", "beta_rad", "gamma_rad", "x_m", "y_m", "z_m", "q1_rad", "q2_rad", "q3_rad")


KEYPOINT_COLUMNS = ("u1_px", "v1_px", "u2_px", "v2_px")


READING_COLUMNS = ("q1_rad", "q2_rad", "q3_rad")


# T_base_tool as the robot reads it: rotation vector, then position.
KINEMATICS_COLUMNS = ("base_rx_rad", "base_ry_rad", "base_rz_rad", "base_x_m", "base_y_m", "base_z_m")


# All six joints of a da Vinci arm as the robot reads them, in recordings.
ARM_JOINT_COLUMNS = (
    "arm_yaw_rad", "arm_pitch_rad", "arm_insertion_m", "arm_roll_rad", "arm_wrist_pitch_rad", "arm_wrist_yaw_rad",
)  # fmt: skip


# How much of an arm is seen; see the manifest's conventions.
SWAPPED = "swapped"
VISIBILITY_COLUMNS = ("visible", "tool_visible", "front", SWAPPED)


# T_view_cam of an auxiliary view: rotation vector, then position.
VIEW_COLUMNS = ("view_rx_rad", "view_ry_rad", "view_rz_rad", "view_x_m", "view_y_m", "view_z_m")


def label_columns(label: str) -> tuple[str, str]:
    """Column names of a marked point, without the arm's."""
    return (f"{label}_u_px", f"{label}_v_px")


def arm_columns(arm: str, names: Sequence[str]) -> list[str]:
    """Column names of one arm, or of one kind of mask, for example ``left_u1_px``."""
    return [f"{arm}_{name}" for name in names]
