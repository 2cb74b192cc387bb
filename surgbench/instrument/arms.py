"""Arms as data: the joints of a serial robot that holds an instrument, from a file, and where they put its wrist.

The da Vinci's have closed forms too (:mod:`surgbench.instrument.arm`); what a robot of another make or generation reads
needs no more than its file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from surgbench.config import Finite, Section, locate, parse_model, read_yaml
from surgbench.geometry import FloatArray, is_rigid, rigid_transform

DEFAULT_ARM = "classic_400006"

Row = tuple[Finite, Finite, Finite]


class ArmJoint(Section):
    """One joint: its frame is ``T_before Rx(alpha) Tx(a) Rz(theta) Tz(d)`` (modified Denavit-Hartenberg, Craig).

    Attributes:
        name: Unique.
        kind: ``revolute``: ``theta = q + offset`` and ``d = d_m``; ``prismatic``: ``d = q + offset``, ``theta`` is 0.
        alpha_rad: Of the frame before.
        a_m: Of the frame before.
        d_m: Of a revolute joint.
        offset: Radians, or metres of a prismatic joint.
        limits: The same: least and largest reading.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
    kind: Literal["revolute", "prismatic"]
    alpha_rad: Finite = 0.0
    a_m: Finite = 0.0
    d_m: Finite = 0.0
    offset: Finite = 0.0
    limits: tuple[Finite, Finite]

    @model_validator(mode="after")
    def _sensible(self) -> ArmJoint:
        if not self.limits[0] < self.limits[1]:
            raise ValueError(f"limits of '{self.name}' must be [least, largest]")
        if self.kind == "prismatic" and self.d_m:
            raise ValueError(f"'{self.name}' is prismatic: its d is the reading and 'offset', not 'd_m'")
        return self


class Arm(Section):
    """An arm's file.

    Attributes:
        format: Of the file.
        name: Of the arm.
        title: For people.
        sources: Where the figures are from.
        wrist: The joint whose frame is the wrist-pitch frame of instruments.
        joints: From the base on; those after ``wrist`` are the instrument's own.
        tip_rotation: From the last joint's frame to the one in which the robot gives its tool's pose.
    """

    format: Literal["surgbench-arm-1"]
    name: Annotated[str, Field(pattern=r"^[a-z0-9_]+$")]
    title: str
    sources: tuple[str, ...] = ()
    wrist: str
    joints: Annotated[tuple[ArmJoint, ...], Field(min_length=1)]
    tip_rotation: tuple[Row, Row, Row] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))

    @model_validator(mode="after")
    def _consistent(self) -> Arm:
        names = [joint.name for joint in self.joints]
        if len(set(names)) < len(names):
            raise ValueError("two joints have the same name")
        if self.wrist not in names:
            raise ValueError(f"wrist '{self.wrist}' is none of the joints ({', '.join(names)})")
        if not is_rigid(rigid_transform(np.array(self.tip_rotation), np.zeros(3))):
            raise ValueError("the rows of tip_rotation must be those of a rotation matrix")
        return self

    @property
    def wrist_joints(self) -> int:
        """How many readings place the wrist: the first ones."""
        return [joint.name for joint in self.joints].index(self.wrist) + 1

    def forward(self, readings: FloatArray) -> FloatArray:
        """Where the readings put the wrist-pitch frame.

        Args:
            readings: ``(..., n)`` of the joints in order, radians or metres; ``n`` at least ``wrist_joints``.

        Returns:
            ``(..., 4, 4)`` T_base_wrist; NaN where a reading that it needs is.

        Example:
            The shaft points straight down, 9 cm below the remote centre:

            >>> import numpy as np
            >>> from surgbench.instrument.arms import load_arm
            >>> load_arm("classic_400006").forward(np.array([0.0, 0.0, 0.1056, 0.0]))[:3, 3].round(6)
            array([ 0.  ,  0.  , -0.09])
        """
        return self._chain(readings, self.joints[: self.wrist_joints])

    def forward_tip(self, readings: FloatArray) -> FloatArray:
        """The tool's pose as the robot gives it, ``(..., 4, 4)``, from readings ``(..., n)`` of all joints."""
        tip = self._chain(readings, self.joints)
        tip[..., :3, :3] = tip[..., :3, :3] @ np.array(self.tip_rotation, dtype=np.float64)
        return tip

    def within_limits(self, readings: FloatArray) -> np.ndarray:
        """Which of ``(..., n)`` readings of the first n joints lie within the limits, ``(...)`` bool."""
        limits = np.array([joint.limits for joint in self.joints[: np.shape(readings)[-1]]])
        return np.asarray(((readings >= limits[:, 0]) & (readings <= limits[:, 1])).all(axis=-1))

    @staticmethod
    def _chain(readings: FloatArray, joints: tuple[ArmJoint, ...]) -> FloatArray:
        values = np.asarray(readings, dtype=np.float64)
        pose = np.broadcast_to(np.eye(4), (*values.shape[:-1], 4, 4)).copy()
        for index, joint in enumerate(joints):
            value = values[..., index] + joint.offset
            theta, d = (value, joint.d_m) if joint.kind == "revolute" else (0.0 * value, value)
            pose = pose @ _link(joint, theta, np.broadcast_to(d, value.shape))
        return pose


def load_arm(name_or_path: str | Path) -> Arm:
    """Load an arm.

    Args:
        name_or_path: A built-in name (see ``surgbench list arms``), or the path of an arm file: any ``Path``, or a
            string with a slash or ending in ``.yaml`` or ``.yml``.

    Raises:
        NotFoundError: No built-in arm has this name.
        ConfigError: The file is missing or wrong; the message names file and key.
    """
    path = locate("arms", "arm", name_or_path)
    return parse_model(Arm, read_yaml(path, "arm"), str(path))


def _link(joint: ArmJoint, theta_rad: FloatArray, d_m: FloatArray) -> FloatArray:
    ca, sa, ct, st = np.cos(joint.alpha_rad), np.sin(joint.alpha_rad), np.cos(theta_rad), np.sin(theta_rad)
    zero = np.zeros_like(ct)
    rotation = np.stack(
        [
            np.stack([ct, -st, zero], axis=-1),
            np.stack([st * ca, ct * ca, zero - sa], axis=-1),
            np.stack([st * sa, ct * sa, zero + ca], axis=-1),
        ],
        axis=-2,
    )
    return rigid_transform(rotation, np.stack([zero + joint.a_m, -sa * d_m, ca * d_m], axis=-1))
