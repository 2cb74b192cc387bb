"""Takes a controller's answers in: checked, and turned into joints as the robot does."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from surgbench.compiled import compiled
from surgbench.errors import InvalidAnswerError
from surgbench.geometry import FloatArray, inverse_transform, is_rigid, nearest_rotation, rigid_transform
from surgbench.viewpoint.contract import ViewCommand, ViewpointScene
from surgbench.viewpoint.kinematics import inverse
from surgbench.viewpoint.placement import CONSTRAINTS
from surgbench.viewpoint.servo import servo_limits
from surgbench.viewpoint.servo_steps import clip_all

# A commanded pose may be this far from a rigid transform in any number, as in single or half precision, or as a file
# or a message has it, rounded to three digits; the nearest one is taken then.
RIGID_TOLERANCE = 1e-3
# Joints that are clipped by less than this are so by rounding.
CLIPPED_BEYOND = 1e-9
# As of :func:`surgbench.geometry.is_rigid`.
_ORTHOGONAL = 1e-6
_REST = np.zeros(6)


class InvalidCommandError(InvalidAnswerError):
    """A controller returned something that is no command; one line that says what."""


@dataclass(eq=False)
class Received:
    """A command as the arm takes it: joints within the limits; with a velocity where it is to be followed at once."""

    goal: FloatArray
    velocity: FloatArray | None
    clipped: bool
    active: tuple[str, ...]
    solver: bool


class Receiver:
    """Checks answers, and turns poses into joints as the robot does (``move_cp``: from the measured joints, clipped).

    Args:
        scene: The trial's constants.
    """

    def __init__(self, scene: ViewpointScene) -> None:
        self._arm, self._reach_m = scene.arm.packed, scene.arm.camera_m
        self._limits = servo_limits(scene.arm)
        self._T_base_world = inverse_transform(scene.T_world_base)

    def __call__(self, answer: Any, joints: FloatArray) -> Received:
        """Take an answer in.

        Args:
            answer: What ``step`` returned.
            joints: ``(6,)`` measured.

        Raises:
            InvalidCommandError: It is no command.
        """
        command = answer if isinstance(answer, ViewCommand) else ViewCommand(answer)
        target = _numbers(command.target, "a command")
        if target.shape == (4, 4):
            pose, target = target if _keeps_lengths(target) else _rigid(target), np.empty(6)
            _reach(self._arm, self._reach_m, self._T_base_world @ pose, joints, target)
        elif target.shape != (6,):
            raise InvalidCommandError(f"the controller returned shape {target.shape}, not (6,) joints or a (4, 4) pose")
        if command.mode not in ("move", "servo"):
            raise InvalidCommandError(f"the controller returned mode {command.mode!r}, not 'move' or 'servo'")
        unknown = [name for name in command.active if name not in CONSTRAINTS]
        if unknown:
            raise InvalidCommandError(
                f"the controller names an unknown rule {unknown[0]!r} (known: {', '.join(CONSTRAINTS)})"
            )
        velocity = None
        if command.mode == "servo":
            velocity = _REST if command.velocity is None else _numbers(command.velocity, "a velocity")
            if velocity.shape != (6,):
                raise InvalidCommandError(f"the controller returned a velocity of shape {velocity.shape}, not (6,)")
        goal = np.empty(6)
        clipped = clip_all(self._limits, target, goal) > CLIPPED_BEYOND
        return Received(goal, velocity, clipped, command.active, bool(command.solver))


@compiled
def _are_finite(numbers: FloatArray) -> bool:
    """Whether ``(n,)`` numbers are."""
    for one in numbers:  # noqa: SIM110 (all() does not compile)
        if not math.isfinite(one):
            return False
    return True


@compiled
def _keeps_lengths(pose: FloatArray) -> bool:
    """:func:`surgbench.geometry.is_rigid` of a ``(4, 4)`` pose, as far as it says yes."""
    for row in range(3):
        for other in range(row + 1):
            product = -1.0 if row == other else 0.0
            for k in range(3):
                product += pose[row, k] * pose[other, k]
            if not abs(product) < 0.5 * _ORTHOGONAL:
                return False
    volume = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        volume += pose[0, k] * (pose[1, i] * pose[2, j] - pose[1, j] * pose[2, i])
    return bool(volume > 0.0 and pose[3, 0] == 0.0 and pose[3, 1] == 0.0 and pose[3, 2] == 0.0 and pose[3, 3] == 1.0)


@compiled(makes_arrays=True)
def _reach(arm: FloatArray, reach_m: float, pose: FloatArray, near: FloatArray, joints: FloatArray) -> None:
    """:meth:`surgbench.viewpoint.camera_arm.CameraArm.inverse` of a ``(4, 4)`` pose, which is overwritten."""
    for k in range(3):
        pose[k, 3] -= reach_m * pose[k, 2]
    inverse(arm, pose, near, joints)


def _rigid(pose: FloatArray) -> FloatArray:
    """A ``(4, 4)`` pose as it is, or the nearest rigid one.

    Raises:
        InvalidCommandError: That is too far.
    """
    if is_rigid(pose):
        return pose
    nearest = rigid_transform(nearest_rotation(pose[:3, :3]), pose[:3, 3])
    if (off := float(np.abs(pose[3] - nearest[3]).max())) > RIGID_TOLERANCE:
        raise InvalidCommandError(
            f"the controller returned a pose whose last row is {off:.2g} off 0, 0, 0, 1 "
            f"(tolerance {RIGID_TOLERANCE:g}); is it transposed?"
        )
    if (off := float(np.abs(pose - nearest).max())) > RIGID_TOLERANCE:
        kind = "a mirror image, " if np.linalg.det(pose[:3, :3]) < 0 else ""
        raise InvalidCommandError(
            f"the controller returned a pose whose rotation is no rotation: {kind}{off:.2g} off the nearest "
            f"(tolerance {RIGID_TOLERANCE:g}, of its numbers)"
        )
    return nearest


def _numbers(value: Any, what: str) -> FloatArray:
    if value is None:
        raise InvalidCommandError(f"the controller returned nothing (None), not {what}")
    try:
        numbers = np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError):
        raise InvalidCommandError(f"the controller returned {type(value).__name__}, not {what} of numbers") from None
    if not _are_finite(numbers.reshape(-1)):
        raise InvalidCommandError(f"the controller returned {what} with NaN or infinity")
    return numbers
