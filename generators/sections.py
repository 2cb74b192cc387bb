"""Parts of a preset about what the robot reads of itself, and where data and tracker differ."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator

from surgbench.config import Section

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Correlation = Annotated[float, Field(ge=0, lt=1)]


class Kinematics(Section):
    """How the robot's reading of its tool pose errs, and the calibration of its base. Our choice, not published.

    With ``motion.kind: rcm`` the reading is the forward kinematics of disturbed joints: radians are those of yaw,
    pitch and roll, metres those of the insertion. With ``free`` there is no robot: drift and noise are those of one
    transform that lumps all errors together (rotation vector and translation in the camera frame).

    Attributes:
        hand_eye_rad: Standard deviation of the base's nominal place in the camera, each component of a rotation vector.
        hand_eye_m: The same, each component of its translation.
        bias_rad: Standard deviation of what is constant over a sequence; ``rcm`` only.
        bias_m: The same.
        drift_rad: Stationary standard deviation of what changes slowly.
        drift_m: The same.
        drift_rho: Its correlation from frame to frame.
        stretch_rad: How far the reading runs ahead of a moving joint, its cables stretched; ``rcm`` only.
        stretch_m: The same.
        noise_rad: Standard deviation of what is new in every frame.
        noise_m: The same.
    """

    hand_eye_rad: NotNegative = 0.015
    hand_eye_m: NotNegative = 0.002
    bias_rad: NotNegative = 0.005
    bias_m: NotNegative = 0.0005
    drift_rad: NotNegative = 0.003
    drift_m: NotNegative = 0.0005
    drift_rho: Correlation = 0.998
    stretch_rad: NotNegative = 0.003
    stretch_m: NotNegative = 0.0005
    noise_rad: NotNegative = 0.0002
    noise_m: NotNegative = 0.00005


class Mismatch(Section):
    """How what is rendered differs from the camera and the instrument that the dataset declares.

    Attributes:
        body_scale: Size of wrist and jaws, their distances included.
        shaft_radius_scale: Thickness of the shaft.
        jaw_extra_m: How much longer the jaws are, at their tips.
        focal_scale: Of fx and fy.
        centre_offset_px: Of the principal point.
        distortion: Of the lens, OpenCV's order (k1, k2, p1, p2, k3), where the declared camera has none.
        joint_offset_rad: Added to all readings of q1, q2, q3.
    """

    body_scale: Positive = 1.0
    shaft_radius_scale: Positive = 1.0
    jaw_extra_m: Finite = 0.0
    focal_scale: tuple[Positive, Positive] = (1.0, 1.0)
    centre_offset_px: tuple[Finite, Finite] = (0.0, 0.0)
    distortion: Annotated[tuple[Finite, ...], Field(max_length=5)] = ()
    joint_offset_rad: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)

    @field_validator("distortion")
    @classmethod
    def _count(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if len(value) not in (0, 4, 5):
            raise ValueError("distortion must have 4 or 5 coefficients, k1, k2, p1, p2 and k3, or none")
        return value
