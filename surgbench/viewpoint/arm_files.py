"""Camera arms as data: the packaged ones, a user's own file, and what a dataset keeps of either.

All of them are chains of the da Vinci's kind (:mod:`surgbench.viewpoint.kinematics`): yaw and pitch about a remote
centre, insertion, roll, and a wrist of two joints, each of which may be locked.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

from pydantic import model_validator

from surgbench.config import Finite, Name, NotNegative, Positive, Section, locate, parse_model, read_yaml
from surgbench.instrument.arm import Manipulator
from surgbench.viewpoint.camera_arm import PSM_CLASSIC, CameraArm

DEFAULT_CAMERA_ARM = "psm_classic"
JOINT_NAMES = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")
# Within these the closed form of the inverse kinematics is unique.
WIDEST_RAD = {"yaw": math.pi, "pitch": math.pi / 2, "wrist_pitch": math.pi / 2, "wrist_yaw": math.pi / 2}
# What planners are told of a joint that does not move.
LOCKED_RATE = 1.0


class CameraArmJoint(Section):
    """One joint, radians or (insertion) metres and seconds.

    Attributes:
        limits: Least and largest reading.
        velocity: Largest.
        acceleration: Largest.
        locked: Where it stays; instead of the others.
    """

    limits: tuple[Finite, Finite] | None = None
    velocity: Positive | None = None
    acceleration: Positive | None = None
    locked: Finite | None = None

    @model_validator(mode="after")
    def _sensible(self) -> CameraArmJoint:
        moving = (self.limits, self.velocity, self.acceleration)
        if self.locked is not None:
            if any(value is not None for value in moving):
                raise ValueError("a joint that is locked has no limits, velocity or acceleration")
        elif any(value is None for value in moving):
            raise ValueError("a joint needs limits, velocity and acceleration, or locked")
        elif self.limits is not None and not self.limits[0] < self.limits[1]:
            raise ValueError("limits must be [least, largest]")
        return self

    @property
    def range(self) -> tuple[float, float]:
        """Least and largest reading, the same of a locked joint."""
        if self.locked is not None:
            return self.locked, self.locked
        assert self.limits is not None
        return self.limits


class CameraArmJoints(Section):
    """All six."""

    yaw: CameraArmJoint
    pitch: CameraArmJoint
    insertion: CameraArmJoint
    roll: CameraArmJoint
    wrist_pitch: CameraArmJoint
    wrist_yaw: CameraArmJoint

    def named(self) -> dict[str, CameraArmJoint]:
        """Name to joint, in the order of the chain."""
        return {name: getattr(self, name) for name in JOINT_NAMES}


class CameraArmSpec(Section):
    """A camera arm's file.

    Attributes:
        format: Of the file.
        name: Of the arm.
        title: For people.
        sources: Where the figures are from.
        insertion_offset_m: d of joint 3 where the insertion reads 0.
        roll_offset_m: d of joint 4.
        wrist_length_m: a of joint 6, from the wrist pitch to the wrist yaw axis.
        camera_m: How far the camera is from the tool's origin along its z, along which it looks.
        joints: Their limits.
    """

    format: Literal["surgbench-camera-arm-1"]
    name: Name
    title: str = ""
    sources: tuple[str, ...] = ()
    insertion_offset_m: Finite
    roll_offset_m: Finite
    wrist_length_m: NotNegative = 0.0
    camera_m: NotNegative = 0.0
    joints: CameraArmJoints

    @model_validator(mode="after")
    def _within_the_closed_form(self) -> CameraArmSpec:
        for name, widest in WIDEST_RAD.items():
            if max(map(abs, self.joints.named()[name].range)) > widest + 1e-4:
                raise ValueError(f"joint '{name}' must stay within ±{widest:.6g} rad; are its limits in degrees?")
        if all(lower == upper for lower, upper in (joint.range for joint in self.joints.named().values())):
            raise ValueError("all six joints are locked: an arm that cannot move holds no camera that follows")
        depth_m = self.joints.insertion.range[0] + self.insertion_offset_m + self.roll_offset_m
        if depth_m <= 0:
            raise ValueError(
                f"where the insertion is least the wrist is {1e3 * -depth_m:.1f} mm above the remote centre; raise its "
                "lower limit, so that it is below"
            )
        return self

    def arm(self) -> CameraArm:
        """The arm that it describes."""
        joints = list(self.joints.named().values())
        (y0, y1), (p0, p1), (i0, i1), (r0, r1), (wp0, wp1), (wy0, wy1) = (joint.range for joint in joints)
        return CameraArm(
            manipulator=Manipulator(
                roll_offset_m=self.roll_offset_m,
                insertion_offset_m=self.insertion_offset_m,
                lower=(y0, p0, i0, r0),
                upper=(y1, p1, i1, r1),
            ),
            wrist_length_m=self.wrist_length_m,
            wrist_lower_rad=(wp0, wy0),
            wrist_upper_rad=(wp1, wy1),
            velocity=tuple(joint.velocity or LOCKED_RATE for joint in joints),
            acceleration=tuple(joint.acceleration or LOCKED_RATE for joint in joints),
            camera_m=self.camera_m,
            name=self.name,
        )


def load_camera_arm(name_or_path: str | Path) -> CameraArmSpec:
    """Load a camera arm.

    Args:
        name_or_path: A built-in name (see ``surgbench list camera_arms``), or the path of a file: any ``Path``, or a
            string with a slash or ending in ``.yaml`` or ``.yml``.

    Raises:
        NotFoundError: No built-in arm has this name.
        ConfigError: The file is missing or wrong; the message names file and key.
    """
    path = locate("camera_arms", "camera arm", name_or_path)
    return parse_model(CameraArmSpec, read_yaml(path, "camera arm"), str(path))


def unless_default(spec: CameraArmSpec | None) -> CameraArmSpec | None:
    """What a dataset says of its camera arm: nothing of the default one, so that such datasets stay what they were."""
    return None if spec is None or spec.arm() == PSM_CLASSIC else spec


def arm_of(spec: CameraArmSpec | None) -> CameraArm:
    """The arm that a dataset means."""
    return PSM_CLASSIC if spec is None else spec.arm()
