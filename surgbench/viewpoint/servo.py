"""What becomes of a command: set points within the limits of velocity and acceleration, and joints that lag behind.

``move`` is the robot's ``move_jp`` and ``move_cp``: an online trajectory in joint space to rest at the goal, all joints
arriving together, velocity and acceleration limited, that starts from the present set point and its velocity; a new
goal takes over (Reflexxes Type II there, Ruckig with unlimited jerk here). ``servo`` is ``servo_jp``: the set point
goes to the joints' controllers as it is, as far as the limits allow. The controllers have no integral part; they
follow with a first-order lag (an assumption, no figure for it is published).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import ruckig

from surgbench.geometry import FloatArray
from surgbench.viewpoint import servo_steps as steps
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.servo_steps import JOINTS

# Ruckig finds no trajectory where a joint must brake exactly as hard as it can; a little less velocity mends that.
_NUDGES = (0.0, 1e-9, 1e-6)
_REST = [0.0] * JOINTS


def servo_limits(arm: CameraArm) -> FloatArray:
    """``(4, 6)`` lower, upper, velocity and acceleration limits, as :mod:`surgbench.viewpoint.servo_steps` has them."""
    return np.array([arm.lower, arm.upper, arm.velocity, arm.acceleration], dtype=np.float64)


def servo_timing(dt_s: float, lag_s: float) -> FloatArray:
    """``(3,)`` period, time constant, and what is left of a lag after a period, as the same has them."""
    return np.array([dt_s, lag_s, np.exp(-dt_s / lag_s) if lag_s > 0 else 0.0])


def resting_place(arm: CameraArm, setpoint: FloatArray, velocity: FloatArray) -> FloatArray:
    """Where joints come to rest if they brake as hard as they can, within their limits.

    Args:
        arm: Its limits.
        setpoint: ``(6,)`` what the joints are told at this moment.
        velocity: ``(6,)`` how fast that moves.

    Returns:
        ``(6,)``: to ``move`` there is to hold.
    """
    goal = np.empty(JOINTS)
    steps.rest(servo_limits(arm), np.array([setpoint, velocity]), goal)
    return goal


class JointServo:
    """Joints of an arm that are told where to go, once every ``dt_s``.

    Args:
        arm: Its limits.
        start: ``(6,)`` joints at rest, within the limits.
        dt_s: Seconds between commands.
        lag_s: Time constant of the joints behind their set points.
    """

    def __init__(self, arm: CameraArm, start: FloatArray, dt_s: float, lag_s: float) -> None:
        self._limits, self._timing = servo_limits(arm), servo_timing(dt_s, lag_s)
        self._moving = _Planner(arm, dt_s, ruckig.Synchronization.Time)
        self._following = _Planner(arm, dt_s, ruckig.Synchronization.No)
        begin = arm.clip(np.array(start, dtype=np.float64))
        self._state = np.array([begin, np.zeros(JOINTS), begin])

    @property
    def setpoint(self) -> FloatArray:
        """``(6,)`` what the joints are told at this moment."""
        setpoint: FloatArray = self._state[0]
        return setpoint

    @property
    def velocity(self) -> FloatArray:
        """``(6,)`` how fast that moves."""
        velocity: FloatArray = self._state[1]
        return velocity

    @property
    def joints(self) -> FloatArray:
        """``(6,)`` where they are."""
        joints: FloatArray = self._state[2]
        return joints

    def move(self, goal: FloatArray) -> None:
        """One step towards rest at ``goal`` (``(6,)``, clipped to the limits)."""
        within = np.empty(JOINTS)
        steps.clip_all(self._limits, goal, within)
        self._move(within)

    def servo(self, target: FloatArray, velocity: FloatArray) -> None:
        """Be at ``target`` (``(6,)``, clipped to the limits) after this step, or there with ``velocity`` soon."""
        limits, timing, state = self._limits, self._timing, self._state
        goal, after = np.empty((2, JOINTS)), np.empty((3, JOINTS))
        if not steps.servo(limits, timing, state, target, velocity, goal, after):
            planned = self._plan(self._following, goal[0], goal[1].tolist())
            steps.servo_planned(limits, timing, state, goal, planned, after)
        self._state = after

    def hold(self) -> None:
        """Come to rest as soon as the limits allow."""
        goal = np.empty(JOINTS)
        steps.rest(self._limits, self._state, goal)
        self._move(goal)

    def _move(self, goal: FloatArray) -> None:
        after = np.empty((3, JOINTS))
        steps.follow_all(self._limits, self._timing, self._state, self._plan(self._moving, goal, _REST), after)
        self._state = after

    def _plan(self, planner: _Planner, goal: FloatArray, velocity: list[float]) -> FloatArray:
        """``(2, 6)`` set point and velocity after one step on the way to a goal."""
        planned = planner(self._state, goal, velocity)
        if planned is None:
            planned = np.empty((2, JOINTS))
            steps.brake_all(self._limits, self._timing, self._state, planned)
        return planned


class _Planner:
    """Trajectories to goals, anew from every set point."""

    def __init__(self, arm: CameraArm, dt_s: float, synchronization: Any) -> None:
        self._ruckig = ruckig.Ruckig(JOINTS, dt_s)
        self._input, self._output = ruckig.InputParameter(JOINTS), ruckig.OutputParameter(JOINTS)
        self._input.max_velocity, self._input.max_acceleration = arm.velocity, arm.acceleration
        self._input.max_jerk = [np.inf] * JOINTS
        self._input.current_acceleration = _REST
        self._input.synchronization = synchronization

    def __call__(self, state: FloatArray, goal: FloatArray, velocity: list[float]) -> FloatArray | None:
        """``(2, 6)`` set point and velocity after one step; ``None`` where no trajectory is found."""
        given, result = self._input, self._output
        given.current_position, speed = state[:2].tolist()
        given.target_position, given.target_velocity = goal.tolist(), velocity
        for nudge in _NUDGES:
            given.current_velocity = [(1 - nudge) * one for one in speed]
            try:
                self._ruckig.update(given, result)
            except ruckig.RuckigError:
                continue
            return np.array((result.new_position, result.new_velocity))
        return None
