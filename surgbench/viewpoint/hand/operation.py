"""The loop of hand and camera over one trial: the hand leads the ring by the picture, the controller the camera.

Per step: the controller sees the ring as it is measured and moves the camera arm; the hand sees the ring, a delay ago,
in the picture of the camera that it works from; teleoperation turns its movement into the tool's; the wire lets the
ring go there or not. The trial gives the wire, the no-go zone, the arm and its registration, and the errors with which
the ring is measured; its own hand's way is not used, but for how the tool is held at each place of the wire.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray, inverse_transform, rigid_transform, rotation_from_vector
from surgbench.viewpoint.contract import ViewpointObservation, ViewpointScene
from surgbench.viewpoint.hand.contact import RingOnWire, nearest_place, settle
from surgbench.viewpoint.hand.person import Hand, Person, Seen, Wandering
from surgbench.viewpoint.hand.set_up import set_up_joints
from surgbench.viewpoint.hand.sight import AUXILIARY, ENDOSCOPE, Sight, endoscope_pose
from surgbench.viewpoint.hand.turns import turn_between
from surgbench.viewpoint.optics.teleoperation import Teleoperation, TeleoperationSettings
from surgbench.viewpoint.placement import CONSTRAINTS
from surgbench.viewpoint.receiver import Receiver
from surgbench.viewpoint.servo import JointServo
from surgbench.viewpoint.simulator import REPORT_EVERY, Controller, Course
from surgbench.viewpoint.trial import Trial, TrialTruth

WorksFrom = Literal["endoscope", "auxiliary"]
# The tool's origin is this far behind the ring's centre, along its z (the published code).
TOOL_TO_RING_M = 0.033
# The hand waits this long, so that the camera has come to the ring; the clock starts then.
SETTLE_S = 3.0
# A trial that is not done by then is broken off: the article's slowest condition takes 80 s, with a deviation of 30 s.
LIMIT_S = 180.0
# The ends of the wire are where the ring is this near to them.
END_M = 0.005
# Codes of what the hand saw the ring in.
NOTHING, IN_AUXILIARY, IN_ENDOSCOPE, BEHIND_TOOL = 0, 1, 2, 3


class OperationError(SurgbenchError):
    """A trial in which no hand can lead a ring; one line."""


@dataclass(frozen=True, eq=False)
class Operation:
    """How a trial went; T steps.

    Attributes:
        course: Of the camera arm.
        trial: With the ring's way as the hand led it, measured and true.
        pressed_m: ``(T,)`` how far beyond the wire the hand would have had the ring; the gap where below 0.
        sight: ``(T,)`` in which view the hand saw the ring: :data:`NOTHING`, :data:`IN_AUXILIARY`,
            :data:`IN_ENDOSCOPE`, or :data:`BEHIND_TOOL`.
        clutch: ``(T,)`` whether it was pressed.
        retaken: ``(T,)`` whether teleoperation took the view anew.
        begun: Step at which the clock started.
        ended: Step at which it stopped; ``None`` where the ring did not come back.
    """

    course: Course
    trial: Trial
    pressed_m: FloatArray
    sight: NDArray[np.int_]
    clutch: NDArray[np.bool_]
    retaken: NDArray[np.bool_]
    begun: int
    ended: int | None


def check_operable(trial: Trial) -> None:
    """See that a hand can lead a ring in a trial.

    Raises:
        OperationError: It is not known where the wire is, or there is too little of it.
    """
    if trial.truth is None or trial.truth.wire is None:
        raise OperationError(f"trial '{trial.id}': a hand needs a wire, and nothing is known of one here")
    if RingOnWire.of(trial.truth.wire).along_m[-1] <= 2 * END_M:
        raise OperationError(f"trial '{trial.id}': a hand needs more than {2e3 * END_M:g} mm of wire")


class Operating:
    """One hand, one controller, one trial.

    Args:
        controller: Of the camera arm; is reset here.
        trial: With its wire.
        scene: As the controller is told of it.
        works_from: Whose picture the hand works by and is aligned to. With ``auxiliary`` the endoscope's picture is
            there as well, and is looked at where the other does not show the ring.
        person: Who.
        rng: The controller's.
        noise: The hand's and the eyes'.
        steps: No more than so many; until the ring is back, or :data:`LIMIT_S`, unless told.
        teleoperation: How the tool follows the hand.

    Raises:
        OperationError: The trial has no wire, or no place where a camera could be set up.
    """

    def __init__(
        self,
        controller: Controller,
        trial: Trial,
        scene: ViewpointScene,
        works_from: WorksFrom,
        person: Person,
        rng: np.random.Generator,
        noise: np.random.Generator,
        steps: int | None = None,
        teleoperation: TeleoperationSettings | None = None,
    ) -> None:
        check_operable(trial)
        assert trial.truth is not None
        assert trial.truth.wire is not None
        self._controller, self._trial, self._scene, self._person = controller, trial, scene, person
        self._truth, self._works_from = trial.truth, works_from
        self._wire = RingOnWire.of(trial.truth.wire)
        self._limit = min(steps or round(LIMIT_S / scene.dt_s), round(LIMIT_S / scene.dt_s))
        self._grip = _Grip(trial.truth, self._wire)
        self._errors = inverse_transform(trial.truth.T_world_feature) @ trial.T_world_feature
        joints = set_up_joints(scene, self._truth.T_world_base, self._wire.points_m, self._grip.normal_m)
        self._servo = JointServo(scene.arm, joints, scene.dt_s, scene.servo_lag_s)
        self._receive = Receiver(scene)
        self._endoscope = endoscope_pose(self._wire.points_m.mean(axis=0))
        people = person.people
        self._sights = {
            code: Sight(view, self._wire.radius_m, person.noise_px, people.one_eye_m)
            for code, view in ((IN_AUXILIARY, AUXILIARY), (IN_ENDOSCOPE, ENDOSCOPE))
        }
        self._blur = Wandering(6, people.seeing_s, scene.dt_s, noise)
        self._mind = rotation_from_vector(people.other_view_rad * noise.standard_normal(3))
        self._teleoperation = Teleoperation(teleoperation)
        self._hand = Hand(person, self._wire.clearance_m, self._teleoperation.settings.scale, scene.dt_s, noise)
        self._ring = self._grip.at(END_M)
        self._along_m, self._onwards = END_M, 1.0
        self._begun, self._ended = round(SETTLE_S / scene.dt_s), -1
        self._log = _Log()
        self._log.joints.append(self._servo.joints)
        self._log.setpoints.append(self._servo.setpoint)
        controller.reset(scene, self._servo.joints.copy(), rng)

    def run(self, progress: Callable[[int], None] = lambda _: None) -> Operation:
        """Until the ring is back.

        Args:
            progress: Called with the steps done since the last call, now and then.

        Raises:
            InvalidCommandError: An answer of the controller is no command. What was done is :attr:`operation`.
        """
        done = 0
        while done < self._limit and self._ended < 0:
            self._step(done)
            done += 1
            if done % REPORT_EVERY == 0:
                progress(REPORT_EVERY)
        progress(done % REPORT_EVERY)
        return self.operation

    @property
    def operation(self) -> Operation:
        """What has been done so far."""
        log, truth = self._log, self._truth
        count = len(log.goals)
        ring = np.array(log.ring[:count]).reshape(-1, 4, 4)
        asked = np.ones(count, dtype=bool)
        measured = np.array(log.measured[:count]).reshape(-1, 4, 4)
        asked[np.isnan(measured).any(axis=(1, 2))] = False
        course = Course(
            joints=np.array(log.joints[: count + 1]),
            setpoints=np.array(log.setpoints[: count + 1]),
            goals=np.array(log.goals).reshape(-1, 6),
            clipped=np.array(log.clipped, dtype=bool),
            asked=asked,
            active=np.array(log.active, dtype=bool).reshape(-1, len(CONSTRAINTS)),
            solver=np.array(log.solver, dtype=bool),
            latency_ms=np.array(log.latency_ms, dtype=np.float64),
        )
        pressed = np.array(log.pressed_m[:count], dtype=np.float64)
        trial = replace(
            self._trial,
            timestamps_s=self._scene.dt_s * np.arange(count, dtype=np.float64),
            T_world_feature=measured,
            start=self._log.joints[0],
            truth=TrialTruth(ring, truth.T_world_base, pressed >= 0, truth.wire),
        )
        return Operation(
            course,
            trial,
            pressed,
            np.array(log.sight[:count], dtype=int),
            np.array(log.clutch[:count], dtype=bool),
            np.array(log.retaken[:count], dtype=bool),
            self._begun,
            None if self._ended < 0 else self._ended,
        )

    def _step(self, index: int) -> None:
        log = self._log
        measured = self._ring @ self._errors[index % len(self._errors)]
        log.ring.append(self._ring)
        log.measured.append(measured)
        reported = self._scene.T_world_base @ self._scene.arm.forward(self._servo.joints)
        true = self._truth.T_world_base @ self._scene.arm.forward(self._servo.joints)
        self._move_camera(index, measured)
        if self._works_from == "endoscope":
            display, aligned = self._endoscope, self._endoscope
        else:
            display, aligned = true, reported
        seen, code = self._look(display, true)
        if index == self._begun:
            self._teleoperation.reset(self._hand.master, aligned, self._tool)
        retaken = False
        if index < self._begun:
            pressed = -self._wire.gap_m(self._ring)
        else:
            self._hand.step(seen)
            view = self._teleoperation.view
            tool = self._teleoperation.step(self._hand.master, aligned, self._hand.clutch)
            retaken = self._teleoperation.view is not view
            pressed = self._lead(tool)
        log.pressed_m.append(pressed)
        log.sight.append(code)
        log.clutch.append(self._hand.clutch)
        log.retaken.append(retaken)
        if index >= self._begun:
            self._follow_wire(index)

    @property
    def _tool(self) -> FloatArray:
        """T_world_tool of the ring as it is."""
        tool = self._ring.copy()
        tool[:3, 3] -= TOOL_TO_RING_M * tool[:3, 2]
        return tool

    def _move_camera(self, index: int, T_world_feature: FloatArray) -> None:
        """One step of the camera arm; nobody is asked where the ring was not measured."""
        servo, log = self._servo, self._log
        active = np.zeros(len(CONSTRAINTS), dtype=bool)
        goal, clipped, solver, latency_ms = servo.setpoint, False, False, np.nan
        if np.isfinite(T_world_feature).all():
            observation = ViewpointObservation(
                index,
                index * self._scene.dt_s,
                T_world_feature.copy(),
                servo.joints.copy(),
                servo.setpoint.copy(),
                servo.velocity.copy(),
            )
            begin = time.perf_counter()
            answer = self._controller.step(observation)
            latency_ms = 1e3 * (time.perf_counter() - begin)
            command = self._receive(answer, servo.joints)
            goal, clipped, solver = command.goal, command.clipped, command.solver
            for name in command.active:
                active[CONSTRAINTS.index(name)] = True
            if command.velocity is None:
                servo.move(goal)
            else:
                servo.servo(goal, command.velocity)
        else:
            servo.hold()
        log.goals.append(goal)
        log.clipped.append(clipped)
        log.solver.append(solver)
        log.active.append(active)
        log.latency_ms.append(latency_ms)
        log.joints.append(servo.joints)
        log.setpoints.append(servo.setpoint)

    def _look(self, display: FloatArray, auxiliary: FloatArray) -> tuple[Seen | None, int]:
        """What the hand sees of the ring, in the axes of the display that it works before, and in which view."""
        blur = self._blur.step()
        poses = {IN_ENDOSCOPE: self._endoscope}
        if self._works_from == "auxiliary":
            poses = {IN_AUXILIARY: auxiliary, **poses}
        eyes: dict[int, tuple[int, int]] = {}
        for code, pose in poses.items():
            eyes[code] = self._sights[code].eyes(pose, self._ring)
            if eyes[code][1] == 2:  # no view shows more
                break
        # Two eyes are better than one, one is better than a ring behind the tool; else the view that it works from.
        code = max(eyes, key=lambda one: (eyes[one][1], eyes[one][0] > 0, one == next(iter(poses))))
        inside, free = eyes[code]
        if not inside:
            return None, NOTHING
        camera, people = poses[code], self._person.people
        depth = float(camera[:3, 2] @ (self._ring[:3, 3] - camera[:3, 3]))
        place_m, turn_rad = self._sights[code].uncertainty(max(depth, 1e-3), free or inside)
        pace = 1.0
        if not free:
            place_m, turn_rad, pace = people.hidden * place_m, people.hidden * turn_rad, people.hidden_pace
        inwards = camera[:3, :3].T
        to_wire, ahead, turn = (inwards @ one for one in self._what_is_wrong())
        to_wire = to_wire + place_m * blur[:3]
        turn = turn + np.minimum(turn_rad, people.widest_rad) * blur[3:]
        lever = inwards @ (TOOL_TO_RING_M * self._ring[:3, 2])
        if code != next(iter(poses)):
            across = self._mind @ display[:3, :3].T @ camera[:3, :3]
            to_wire, ahead, turn, lever = (across @ one for one in (to_wire, ahead, turn, lever))
            pace *= people.other_view_pace
        return Seen(to_wire, ahead, turn, lever, pace), code if free else BEHIND_TOOL

    def _what_is_wrong(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """In the world: from ring to wire, where the wire goes on, and the turn that the ring lacks."""
        place = np.empty(7)
        low, high = self._wire.near(self._along_m)
        nearest_place(self._wire.points_m, low, high, self._ring[:3, 3], place)
        preview = self._along_m + self._onwards * self._hand.speed_m_s * self._person.delay_s
        wanted = self._grip.at(float(np.clip(preview, 0.0, self._wire.along_m[-1])))
        ahead = self._onwards * self._grip.side * wanted[:3, 1]
        turn = turn_between(self._ring[:3, :3], wanted[:3, :3])
        return place[:3] - self._ring[:3, 3], ahead, turn

    def _lead(self, T_world_tool: FloatArray) -> float:
        """Where the wire lets the ring be that the tool holds; how far beyond the wire it would be."""
        centre = T_world_tool[:3, 3] + TOOL_TO_RING_M * T_world_tool[:3, 2]
        normal = np.ascontiguousarray(T_world_tool[:3, 1])
        wire = self._wire
        low, high = wire.near(self._along_m)
        pressed = float(settle(wire.points_m, low, high, normal, wire.radius_m, wire.thickness_m, centre))
        self._ring = rigid_transform(T_world_tool[:3, :3], centre)
        return pressed

    def _follow_wire(self, index: int) -> None:
        """See where along the wire the ring is now: at its end it turns back, and back at its beginning it is done."""
        place, wire = np.empty(7), self._wire
        low, high = wire.near(self._along_m)
        segment = nearest_place(wire.points_m, low, high, self._ring[:3, 3], place)
        length = wire.along_m[segment + 1] - wire.along_m[segment]
        self._along_m = float(wire.along_m[segment] + place[6] * length)
        if self._onwards > 0 and self._along_m >= wire.along_m[-1] - END_M:
            self._onwards = -1.0
        elif self._onwards < 0 and self._along_m <= END_M:
            self._ended = index


class _Log:
    """What is kept of every step."""

    def __init__(self) -> None:
        self.joints: list[FloatArray] = []
        self.setpoints: list[FloatArray] = []
        self.goals: list[FloatArray] = []
        self.clipped: list[bool] = []
        self.solver: list[bool] = []
        self.active: list[NDArray[np.bool_]] = []
        self.latency_ms: list[float] = []
        self.ring: list[FloatArray] = []
        self.measured: list[FloatArray] = []
        self.pressed_m: list[float] = []
        self.sight: list[int] = []
        self.clutch: list[bool] = []
        self.retaken: list[bool] = []


class _Grip:
    """How the ring should be held at each place of the wire: its normal along it, the tool as the trial's hand had it.

    Args:
        truth: Of a trial, with its wire.
        wire: The same.

    Attributes:
        side: 1 where the normal goes along the wire, -1 where it goes back along it.
        normal_m: ``(3,)`` unit vector: the mean normal over the wire.
    """

    def __init__(self, truth: TrialTruth, wire: RingOnWire) -> None:
        tangent = np.gradient(wire.points_m, wire.along_m, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        poses = truth.T_world_feature[:: max(1, len(truth.T_world_feature) // 2000)]
        gaps = np.linalg.norm(poses[:, None, :3, 3] - wire.points_m[None, ::4], axis=2)
        nearest = 4 * gaps.argmin(axis=1)
        agree = (poses[:, :3, 1] * tangent[nearest]).sum(axis=1).mean()
        self.side = 1.0 if agree >= 0 else -1.0
        order = np.argsort(nearest, kind="stable")
        along = wire.along_m[nearest[order]]
        tool = np.stack([np.interp(wire.along_m, along, poses[order, k, 2]) for k in range(3)], axis=1)
        # The hand's own wobble is not what is wanted: over a centimetre, it has gone.
        width = max(1, round(0.01 / float(np.diff(wire.along_m).mean())))
        kernel = np.ones(width) / width
        padded = np.pad(tool, ((width // 2, width - 1 - width // 2), (0, 0)), mode="edge")
        tool = np.stack([np.convolve(padded[:, k], kernel, mode="valid") for k in range(3)], axis=1)
        y = self.side * tangent
        z = tool - (tool * y).sum(axis=1, keepdims=True) * y
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        self._poses = rigid_transform(np.stack([np.cross(y, z), y, z], axis=-1), wire.points_m)
        self._along_m = wire.along_m
        mean = y.mean(axis=0)
        length = float(np.linalg.norm(mean))
        self.normal_m = mean / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])

    def at(self, along_m: float) -> FloatArray:
        """T_world_ring ``(4, 4)`` in the middle of the wire at a place, that of the polyline's nearest point."""
        place = int(np.searchsorted(self._along_m, along_m))
        return np.asarray(self._poses[min(place, len(self._poses) - 1)])
