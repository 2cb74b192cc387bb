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

from surgbench.errors import DatasetError, InvalidAnswerError
from surgbench.geometry import FloatArray, inverse_transform, is_rigid, nearest_rotation, rigid_transform
from surgbench.viewpoint.contract import ViewCommand, ViewpointObservation, ViewpointScene
from surgbench.viewpoint.placement import CONSTRAINTS
from surgbench.viewpoint.registration import Method, register, residual_m
from surgbench.viewpoint.servo import JointServo
from surgbench.viewpoint.trial import Trial
from surgbench.viewpoint.workspace import NoGoZone, Workspace

SERVO_LAG_S = 0.015
# A commanded pose may be this far from a rigid transform in any number, as in single or half precision, or as a file
# or a message has it, rounded to three digits; the nearest one is taken then.
RIGID_TOLERANCE = 1e-3
REPORT_EVERY = 200


class InvalidCommandError(InvalidAnswerError):
    """A controller returned something that is no command; one line that says what."""


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


@dataclass(frozen=True, eq=False)
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
        self._arm = scene.arm
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
            target = self._arm.inverse(self._T_base_world @ _rigid(target), joints)
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
            velocity = np.zeros(6) if command.velocity is None else _numbers(command.velocity, "a velocity")
            if velocity.shape != (6,):
                raise InvalidCommandError(f"the controller returned a velocity of shape {velocity.shape}, not (6,)")
        goal = self._arm.clip(target)
        clipped = bool((np.abs(goal - target) > 1e-9).any())
        return Received(goal, velocity, clipped, command.active, bool(command.solver))


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
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidCommandError(f"the controller returned {type(value).__name__}, not {what} of numbers") from None
    if not np.isfinite(numbers).all():
        raise InvalidCommandError(f"the controller returned {what} with NaN or infinity")
    return numbers
