"""What is interpolated: free poses, or the joints of a whole arm about a fixed remote centre."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from surgbench.generators.place import BoolArray, Place
from surgbench.generators.presets import Half, Motion
from surgbench.geometry import (
    FloatArray,
    inverse_transform,
    look_at_angles,
    look_at_rotation,
    rigid_transform,
    wrap_angle,
)
from surgbench.instrument.arm import ARM_JOINTS, CLASSIC_400006, INSERTION, PITCH, ROLL, YAW
from surgbench.state import ANGLES, BETA, JOINTS, POSITION

# The arm that both instruments are mounted on.
ARM = CLASSIC_400006
# The tool's own joints are the last three of all coordinates.
TOOL_JOINTS = slice(-3, None)
# How an arm is set up over its first pose: yaw and pitch, and how far the wrist is below the remote centre.
SET_UP_RAD = 0.4
SET_UP_DEPTH_M = (0.11, 0.19)
# Of the states in the workspace that are drawn to try a set-up, how many it must reach.
SET_UP_TRIES = 40
SET_UP_DRAWS = 256
SET_UP_SHARE = 0.25
# Perturbations stay within this many of their standard deviations, mostly.
MARGIN_SIGMAS = 3.0


class Coordinates(Protocol):
    """Coordinates of one arm in which waypoints are drawn, joined and perturbed.

    Attributes:
        place: Where the arm may be.
        sigma: ``(n,)`` stationary standard deviations of the perturbation.
    """

    place: Place
    sigma: FloatArray

    def states(self, values: FloatArray) -> FloatArray:
        """States ``(..., 9)`` of coordinates ``(..., n)``."""
        ...

    def draw(self, count: int, rng: np.random.Generator) -> FloatArray:
        """``(count, n)`` coordinates anywhere in the workspace, or outside it."""
        ...

    def step(self, start: FloatArray, drawn: FloatArray) -> FloatArray:
        """Moves ``(count, n)`` of at most one step from ``start`` (``(n,)``) towards each of ``drawn``."""
        ...

    def steps(self, start: FloatArray, ends: FloatArray) -> FloatArray:
        """How many of the longest steps it takes from ``(n,)`` to ``(count, n)``, ``(count,)``."""
        ...

    def leads(self, segments: FloatArray) -> BoolArray:
        """Which of the ways ``(samples, count, n)`` to a waypoint (their last sample) are feasible, ``(count,)``."""
        ...

    def allows(self, values: FloatArray) -> bool:
        """Whether all frames ``(frames, n)`` of a finished trajectory are feasible."""
        ...


class FreePose:
    """States themselves, beta unwrapped: the instrument moves as it likes."""

    def __init__(self, place: Place, motion: Motion, half: Half) -> None:
        self.place = place
        step = motion.longest_step(half)
        self._longest_m = step.position_m
        self._bounds = np.array(
            [step.tilt_rad, step.roll_rad, step.tilt_rad, *[np.inf] * 3, step.wrist_rad, step.wrist_rad, step.jaw_rad]
        )
        self.sigma = np.array(
            [*motion.ou_sigma_angles_rad, *[motion.ou_sigma_position_m] * 3, *[motion.ou_sigma_joints_rad] * 3]
        )

    def states(self, values: FloatArray) -> FloatArray:
        """See :class:`Coordinates`."""
        return values

    def draw(self, count: int, rng: np.random.Generator) -> FloatArray:
        """See :class:`Coordinates`."""
        drawn: FloatArray = self.place.draw(count, rng)
        return drawn

    def step(self, start: FloatArray, drawn: FloatArray) -> FloatArray:
        """See :class:`Coordinates`."""
        move = drawn - start
        move[:, BETA] = wrap_angle(move[:, BETA])
        move = np.clip(move, -self._bounds, self._bounds)
        length = np.linalg.norm(move[:, POSITION], axis=1, keepdims=True)
        move[:, POSITION] *= np.minimum(1.0, self._longest_m / np.maximum(length, 1e-12))
        return move

    def steps(self, start: FloatArray, ends: FloatArray) -> FloatArray:
        """See :class:`Coordinates`."""
        move = ends - start
        turns = np.abs(move) / self._bounds
        longest: FloatArray = np.maximum(turns.max(axis=1), np.linalg.norm(move[:, POSITION], axis=1) / self._longest_m)
        return longest

    def leads(self, segments: FloatArray) -> BoolArray:
        """See :class:`Coordinates`. Only the waypoint itself must be in the workspace."""
        seen = self.place.allows(segments, self.place.workspace.waypoint_margin).all(axis=0)
        result: BoolArray = self.place.in_workspace(segments[-1]) & seen
        return result

    def allows(self, values: FloatArray) -> bool:
        """See :class:`Coordinates`."""
        return bool(self.place.allows(values, self.place.workspace.tip_margin).all())


class ArmJoints:
    """Yaw, pitch, insertion and roll of an arm, then q1, q2, q3 of its instrument.

    Args:
        place: Where the arm may be.
        motion: Steps and perturbation.
        half: Of the pairs, whose intervals and steps are taken: ``nominal`` or ``fast``.
        T_cam_base: ``(4, 4)`` where its base is; the origin is the remote centre.
    """

    def __init__(self, place: Place, motion: Motion, half: Half, T_cam_base: FloatArray) -> None:
        self.place = place
        self.arm = ARM
        self.T_cam_base = T_cam_base
        step = motion.longest_step(half)
        self._longest_m = step.position_m
        self._bounds = np.array(
            [step.tilt_rad, step.tilt_rad, np.inf, step.roll_rad, step.wrist_rad, step.wrist_rad, step.jaw_rad]
        )
        alpha, beta, gamma = motion.ou_sigma_angles_rad
        self.sigma = np.array([gamma, alpha, motion.ou_sigma_position_m, beta, *[motion.ou_sigma_joints_rad] * 3])
        self._margin_m = MARGIN_SIGMAS * motion.ou_sigma_position_m
        self._margin_rad = MARGIN_SIGMAS * max(alpha, gamma)

    def states(self, values: FloatArray) -> FloatArray:
        """See :class:`Coordinates`."""
        wrist = self.T_cam_base @ self.arm.forward(values[..., :ARM_JOINTS])
        angles = look_at_angles(wrist[..., :3, :3])
        return np.concatenate([angles, wrist[..., :3, 3], values[..., TOOL_JOINTS]], axis=-1)

    def draw(self, count: int, rng: np.random.Generator) -> FloatArray:
        """See :class:`Coordinates`."""
        drawn = self.place.draw(count, rng)
        base = inverse_transform(self.T_cam_base)
        reached = self.arm.reach(drawn[:, POSITION] @ base[:3, :3].T + base[:3, 3])
        roll = rng.uniform(self.arm.lower[ROLL], self.arm.upper[ROLL], count)
        return np.column_stack([reached, roll, drawn[:, JOINTS]])

    def step(self, start: FloatArray, drawn: FloatArray) -> FloatArray:
        """See :class:`Coordinates`."""
        move: FloatArray = np.clip(drawn - start, -self._bounds, self._bounds)
        jacobian = self.arm.jacobian(start[:ARM_JOINTS])[:3]
        length = np.linalg.norm(move[:, :ARM_JOINTS] @ jacobian.T, axis=1, keepdims=True)
        # The roll does not move the wrist.
        move[:, :ROLL] *= np.minimum(1.0, self._longest_m / np.maximum(length, 1e-12))
        return move

    def steps(self, start: FloatArray, ends: FloatArray) -> FloatArray:
        """See :class:`Coordinates`."""
        turns = np.abs(ends - start) / self._bounds
        wrists = self.arm.forward(np.concatenate([start[None], ends])[:, :ARM_JOINTS])[:, :3, 3]
        ways = np.linalg.norm(wrists[1:] - wrists[0], axis=1)
        longest: FloatArray = np.maximum(turns.max(axis=1), ways / self._longest_m)
        return longest

    def leads(self, segments: FloatArray) -> BoolArray:
        """See :class:`Coordinates`. All of the way must be in the workspace, with room for the perturbation."""
        space = self.place.workspace
        margin = MARGIN_SIGMAS * self.sigma[:ARM_JOINTS]
        arm = segments[..., :ARM_JOINTS]
        states = self.states(segments)
        good = (
            self.arm.within_limits(arm - margin)
            & self.arm.within_limits(arm + margin)
            & self.place.in_workspace(states, self._margin_m, self._margin_rad)
            & self.place.allows(states, space.waypoint_margin)
        )
        result: BoolArray = good.all(axis=0)
        return result

    def allows(self, values: FloatArray) -> bool:
        """See :class:`Coordinates`."""
        states = self.states(values)
        good = (
            self.arm.within_limits(values[:, :ARM_JOINTS])
            & self.place.in_workspace(states)
            & self.place.allows(states, self.place.workspace.tip_margin)
        )
        return bool(good.all())


def set_up_arm(place: Place, motion: Motion, half: Half, rng: np.random.Generator) -> ArmJoints | None:
    """Put an arm where a good part of the workspace is within its reach, its remote centre out of the picture.

    Args:
        place: Where the arm may be.
        motion: Steps and perturbation.
        half: Of the pairs, whose intervals and steps are taken: ``nominal`` or ``fast``.
        rng: The only source of randomness.

    Returns:
        The arm, or ``None`` if no such place was found.
    """
    margin = place.workspace.waypoint_margin
    for _ in range(SET_UP_TRIES):
        drawn = place.draw(SET_UP_DRAWS, rng)
        good = np.flatnonzero(place.in_workspace(drawn) & place.allows(drawn, margin))
        if not len(good):
            continue
        state = drawn[good[0]]
        joints = np.empty(ARM_JOINTS)
        joints[[YAW, PITCH]] = rng.uniform(-SET_UP_RAD, SET_UP_RAD, 2)
        joints[INSERTION] = rng.uniform(*SET_UP_DEPTH_M) - ARM.depth_m(0.0)
        joints[ROLL] = rng.uniform(ARM.lower[ROLL], ARM.upper[ROLL])
        wrist = rigid_transform(look_at_rotation(state[ANGLES]), state[POSITION])
        arm = ArmJoints(place, motion, half, wrist @ inverse_transform(ARM.forward(joints)))
        visible = place.camera.contains(place.camera.project(arm.T_cam_base[:3, 3]))
        if not visible and arm.leads(arm.draw(SET_UP_DRAWS, rng)[None]).mean() >= SET_UP_SHARE:
            return arm
    return None
