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
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.viewpoint.camera_arm import CameraArm

JOINTS = 6
# Of the limits, for what rounding adds.
_SLACK = 1 + 1e-9
# Ruckig finds no trajectory where a joint must brake exactly as hard as it can; a little less velocity mends that.
_NUDGES = (0.0, 1e-9, 1e-6)


class JointServo:
    """Joints of an arm that are told where to go, once every ``dt_s``.

    Args:
        arm: Its limits.
        start: ``(6,)`` joints at rest, within the limits.
        dt_s: Seconds between commands.
        lag_s: Time constant of the joints behind their set points.

    Attributes:
        setpoint: ``(6,)`` what the joints are told at this moment.
        velocity: ``(6,)`` how fast that moves.
        joints: ``(6,)`` where they are.
    """

    def __init__(self, arm: CameraArm, start: FloatArray, dt_s: float, lag_s: float) -> None:
        self._lower, self._upper, self._dt_s = arm.lower, arm.upper, dt_s
        self._fastest, self._acceleration = np.array(arm.velocity), np.array(arm.acceleration)
        self._lag_s, self._decay = lag_s, float(np.exp(-dt_s / lag_s)) if lag_s > 0 else 0.0
        self._planners = {mode: ruckig.Ruckig(JOINTS, dt_s) for mode in ("move", "servo")}
        self._input, self._output = ruckig.InputParameter(JOINTS), ruckig.OutputParameter(JOINTS)
        self._input.max_velocity, self._input.max_acceleration = arm.velocity, arm.acceleration
        self._input.max_jerk = [np.inf] * JOINTS
        self._input.current_acceleration = [0.0] * JOINTS
        self._synchronization = {"move": ruckig.Synchronization.Time, "servo": ruckig.Synchronization.No}
        self.setpoint = arm.clip(np.array(start, dtype=np.float64))
        self.velocity = np.zeros(JOINTS)
        self.joints = self.setpoint.copy()

    def move(self, goal: FloatArray) -> None:
        """One step towards rest at ``goal`` (``(6,)``, clipped to the limits)."""
        self._follow(*self._plan("move", np.clip(goal, self._lower, self._upper), np.zeros(JOINTS)))

    def servo(self, target: FloatArray, velocity: FloatArray) -> None:
        """Be at ``target`` (``(6,)``, clipped to the limits) after this step, or there with ``velocity`` soon."""
        target = np.clip(target, self._lower, self._upper)
        needed = (target - self.setpoint) / self._dt_s
        possible = (
            (np.abs(needed) <= self._fastest * _SLACK)
            & (np.abs(needed - self.velocity) <= self._acceleration * self._dt_s * _SLACK)
            & self._can_stop(target, needed)
        )
        if not possible.all():
            velocity = np.clip(velocity, -self._fastest, self._fastest)
            velocity = np.where(self._can_stop(target + velocity * self._dt_s, velocity), velocity, 0.0)
            position, speed = self._plan("servo", target, velocity)
            target, needed = np.where(possible, target, position), np.where(possible, needed, speed)
            # To arrive with a velocity may take a run-up, for which there may be no room.
            safe = self._can_stop(target, needed)
            if not safe.all():
                slower = self._slower()
                braked = self.setpoint + (self.velocity + slower) / 2 * self._dt_s
                target, needed = np.where(safe, target, braked), np.where(safe, needed, slower)
        self._follow(target, needed)

    def _can_stop(self, setpoint: FloatArray, velocity: FloatArray) -> NDArray[np.bool_]:
        """Which joints come to rest within the limits."""
        rest = setpoint + velocity * np.abs(velocity) / (2 * self._acceleration)
        return np.asarray((rest <= self._upper) & (rest >= self._lower))

    def hold(self) -> None:
        """Come to rest as soon as the limits allow."""
        self.move(self.setpoint + self.velocity * np.abs(self.velocity) / (2 * self._acceleration))

    def _plan(self, mode: Any, goal: FloatArray, velocity: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Set point and velocity after one step on the way to a goal."""
        given, result = self._input, self._output
        given.synchronization = self._synchronization[mode]
        given.current_position = self.setpoint.tolist()
        given.target_position, given.target_velocity = goal.tolist(), velocity.tolist()
        for nudge in _NUDGES:
            given.current_velocity = (self.velocity * (1 - nudge)).tolist()
            try:
                self._planners[mode].update(given, result)
            except ruckig.RuckigError:
                continue
            return np.array(result.new_position), np.array(result.new_velocity)
        slower = self._slower()
        return self.setpoint + (self.velocity + slower) / 2 * self._dt_s, slower

    def _slower(self) -> FloatArray:
        """Velocity after one step of braking."""
        speed = np.maximum(np.abs(self.velocity) - self._acceleration * self._dt_s, 0.0)
        return np.asarray(np.sign(self.velocity) * speed)

    def _follow(self, setpoint: FloatArray, velocity: FloatArray) -> None:
        """Take the next set point; the joints follow it while it moves there evenly."""
        clipped = np.clip(setpoint, self._lower, self._upper)
        velocity = np.where(clipped == setpoint, velocity, 0.0)
        trail = (clipped - self.setpoint) / self._dt_s * self._lag_s  # how far they are behind in the long run
        self.joints = clipped - trail + (self.joints - self.setpoint + trail) * self._decay
        self.setpoint = clipped
        self.velocity = np.clip(velocity, -self._fastest, self._fastest)
