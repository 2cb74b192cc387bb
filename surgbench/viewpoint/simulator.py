"""Closes the loop between a controller and the simulated arm over one trial.

Per step: the feature and the arm are measured, the controller answers, the arm is told, and moves for one period.
Where the feature is not measured the controller is not asked, and the arm comes to rest. Commands outside the joints'
limits are clipped to them, as the robot does, and counted.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray
from surgbench.viewpoint.contract import ViewpointObservation, ViewpointScene
from surgbench.viewpoint.placement import CONSTRAINTS
from surgbench.viewpoint.receiver import Receiver
from surgbench.viewpoint.registration import Method, register, residual_m
from surgbench.viewpoint.servo import JointServo
from surgbench.viewpoint.trial import Trial
from surgbench.viewpoint.workspace import NoGoZone, Workspace

SERVO_LAG_S = 0.015
REPORT_EVERY = 200


class Controller(Protocol):
    """What the simulator asks of a controller (:class:`surgbench.viewpoint.contract.ViewpointTracker`)."""

    def reset(self, scene: ViewpointScene, joints: FloatArray, rng: np.random.Generator) -> None:
        """Start a trial."""
        ...

    def step(self, observation: ViewpointObservation) -> Any:
        """Answer an observation."""
        ...


@dataclass(frozen=True, eq=False)
class Course:
    """How a trial went; T steps.

    Attributes:
        joints: ``(T + 1, 6)`` of the camera arm, before each step and after the last.
        setpoints: ``(T + 1, 6)`` what they were told, limits of velocity and acceleration obeyed.
        goals: ``(T, 6)`` the controller's commands, within the limits; where it was not asked, the set point.
        clipped: ``(T,)`` whether a command lay outside the limits.
        asked: ``(T,)`` whether the controller was asked.
        active: ``(T, 5)`` the rules active in the controller's own view, in the order of
            :data:`surgbench.viewpoint.placement.CONSTRAINTS`.
        solver: ``(T,)`` whether it optimised.
        latency_ms: ``(T,)`` what a step took; NaN where it was not asked.
    """

    joints: FloatArray
    setpoints: FloatArray
    goals: FloatArray
    clipped: NDArray[np.bool_]
    asked: NDArray[np.bool_]
    active: NDArray[np.bool_]
    solver: NDArray[np.bool_]
    latency_ms: FloatArray


def make_scene(
    trial: Trial,
    *,
    registration: Method = "translation",
    missing_face: bool = False,
    servo_lag_s: float = SERVO_LAG_S,
    distance_m: float | None = None,
) -> ViewpointScene:
    """What a controller is told of a trial.

    Args:
        trial: The trial.
        registration: How its touched points correct the camera arm's base.
        missing_face: The no-go zone as in the published code, which never tests one of its sides.
        servo_lag_s: Time constant of the joints.
        distance_m: d_t; the trial's own unless told.

    Raises:
        WorkspaceError: The no-go zone's points span no box.
        RegistrationError: The touched points register nothing.
        DatasetError: The camera arm starts outside its limits.
    """
    arm = trial.arm
    zone = NoGoZone(trial.zone_m, missing_face)
    workspace = Workspace(zone, trial.floor_m, trial.proximity_m, trial.preferred_side)
    base = register(trial.T_world_base, trial.touches, registration)
    if not (np.isfinite(trial.start).all() and arm.within_limits(trial.start, 1e-9)):
        raise DatasetError(f"trial '{trial.id}': the camera arm starts outside its joint limits")
    wanted = trial.distance_m if distance_m is None else distance_m
    stated = residual_m(base, trial.touches) if len(trial.touches.base_m) else 0.0
    return ViewpointScene(arm, base, workspace, wanted, trial.dt_s, servo_lag_s, stated)


class Simulation:
    """One controller on one trial.

    Args:
        controller: Is reset here.
        trial: What happens.
        scene: From :func:`make_scene`.
        rng: The controller's.
        steps: Only so many; all of the trial's unless told.
        servo_lag_s: Time constant that the joints really have; what the scene tells of it unless told.
    """

    def __init__(
        self,
        controller: Controller,
        trial: Trial,
        scene: ViewpointScene,
        rng: np.random.Generator,
        steps: int | None = None,
        servo_lag_s: float | None = None,
    ) -> None:
        self._controller, self._trial, self._scene = controller, trial, scene
        count = len(trial.timestamps_s) if steps is None else min(steps, len(trial.timestamps_s))
        lag_s = scene.servo_lag_s if servo_lag_s is None else servo_lag_s
        self._servo = JointServo(scene.arm, trial.start, scene.dt_s, lag_s)
        self._receive = Receiver(scene)
        self._measured = trial.measured[:count]
        self._joints, self._setpoints, self._goals = (
            np.empty((count + 1, 6)),
            np.empty((count + 1, 6)),
            np.empty((count, 6)),
        )
        self._clipped, self._solver = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        self._active = np.zeros((count, len(CONSTRAINTS)), dtype=bool)
        self._latency_ms = np.full(count, np.nan)
        self._joints[0], self._setpoints[0] = self._servo.joints, self._servo.setpoint
        self._done = 0
        if getattr(controller, "foresees", False):
            scene = replace(scene, future=trial.T_world_feature[:count].copy())
        controller.reset(scene, self._servo.joints.copy(), rng)

    def run(self, progress: Callable[[int], None] = lambda _: None) -> Course:
        """All steps.

        Args:
            progress: Called with the steps done since the last call, now and then.

        Raises:
            InvalidCommandError: An answer is no command. What was done until then is :attr:`course`.
        """
        for index in range(len(self._goals)):
            self._step(index)
            self._done += 1
            if self._done % REPORT_EVERY == 0:
                progress(REPORT_EVERY)
        progress(self._done % REPORT_EVERY)
        return self.course

    @property
    def course(self) -> Course:
        """What has been done so far."""
        done = self._done
        return Course(
            joints=self._joints[: done + 1],
            setpoints=self._setpoints[: done + 1],
            goals=self._goals[:done],
            clipped=self._clipped[:done],
            asked=self._measured[:done],
            active=self._active[:done],
            solver=self._solver[:done],
            latency_ms=self._latency_ms[:done],
        )

    def _step(self, index: int) -> None:
        servo, trial = self._servo, self._trial
        if self._measured[index]:
            observation = ViewpointObservation(
                index,
                float(trial.timestamps_s[index]),
                trial.T_world_feature[index].copy(),
                servo.joints.copy(),
                servo.setpoint.copy(),
                servo.velocity.copy(),
            )
            begin = time.perf_counter()
            answer = self._controller.step(observation)
            self._latency_ms[index] = 1e3 * (time.perf_counter() - begin)
            command = self._receive(answer, servo.joints)
            self._goals[index], self._clipped[index] = command.goal, command.clipped
            self._solver[index] = command.solver
            for name in command.active:
                self._active[index, CONSTRAINTS.index(name)] = True
            if command.velocity is None:
                servo.move(command.goal)
            else:
                servo.servo(command.goal, command.velocity)
        else:
            self._goals[index] = servo.setpoint
            servo.hold()
        self._joints[index + 1], self._setpoints[index + 1] = servo.joints, servo.setpoint
