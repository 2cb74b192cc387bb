"""The bridge the other way round: a client sends scenes and observations, a controller of ours answers."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable

import numpy as np

from surgbench.geometry import FloatArray, is_rigid, nearest_rotation, rigid_transform
from surgbench.randomness import generator
from surgbench.viewpoint.bridge.hub import HELLO_S, greet
from surgbench.viewpoint.bridge.lines import BridgeError, Lines
from surgbench.viewpoint.bridge.messages import (
    Bye,
    Command,
    ErrorMessage,
    Message,
    MessageError,
    ObservationMessage,
    Ready,
    SceneMessage,
)
from surgbench.viewpoint.bridge.translation import (
    tell_command,
    understand_observation,
    understand_scene,
)
from surgbench.viewpoint.contract import ViewpointObservation, ViewpointScene
from surgbench.viewpoint.receiver import RIGID_TOLERANCE, Received, Receiver
from surgbench.viewpoint.servo import resting_place
from surgbench.viewpoint.simulator import Controller

UNSEEN = "the feature was not measured"


class Service:
    """Answers messages with a controller's commands.

    Whatever goes wrong in a step, the answer is a command that brings the arm to rest, and says why (``held``).

    Args:
        make: A new controller, for each scene.
    """

    def __init__(self, make: Callable[[], Controller]) -> None:
        self._make = make
        self._scene: ViewpointScene | None = None

    def __call__(self, message: Message) -> Message | None:
        """The answer to a message; ``None`` where the client takes its leave."""
        if isinstance(message, Bye):
            return None
        if isinstance(message, SceneMessage):
            return self._begin(message)
        if isinstance(message, ObservationMessage):
            return self._step(message)
        return ErrorMessage(error="a client says 'scene', 'observation' or 'bye'")

    def _begin(self, message: SceneMessage) -> Message:
        self._scene = None
        try:
            scene, joints = understand_scene(message)
            self._warm_up(scene, joints)
            self._controller, self._receive = self._make(), Receiver(scene)
            self._controller.reset(scene, joints, generator(seed=message.seed))
        except MessageError as error:
            return ErrorMessage(id=message.id, error=str(error))
        except Exception as error:  # a plug-in may raise anything
            return ErrorMessage(id=message.id, error=_line(error))
        self._scene = scene
        return Ready(id=message.id)

    def _warm_up(self, scene: ViewpointScene, joints: FloatArray) -> None:
        """Have compiled what another controller of the kind compiles in its first steps: no answer may wait for it."""
        camera = scene.T_world_base @ scene.arm.forward(joints)
        receive = Receiver(scene)
        with contextlib.suppress(Exception):  # what a plug-in raises is told when it is asked in earnest
            controller = self._make()
            controller.reset(scene, joints.copy(), generator(seed=0))
            for index, sign in enumerate((1.0, -1.0)):  # seen from ahead, and from behind
                axes = np.column_stack([camera[:3, 0], -sign * camera[:3, 2], sign * camera[:3, 1]])
                feature = rigid_transform(axes, camera[:3, 3] + scene.distance_m * camera[:3, 2])
                still = ViewpointObservation(
                    index, index * scene.dt_s, feature, joints.copy(), joints.copy(), np.zeros(len(joints))
                )
                receive(controller.step(still), still.joints)

    def _step(self, message: ObservationMessage) -> Message:
        if self._scene is None:
            return ErrorMessage(id=message.id, error="there is no scene yet")
        observation = understand_observation(message)
        try:
            return tell_command(self._ask(observation), message.id)
        except MessageError as error:
            why = str(error)
        except Exception as error:  # a plug-in may raise anything
            why = _line(error)
        return self._hold(self._scene, observation, message, why)

    def _ask(self, observation: ViewpointObservation) -> Received:
        if np.isnan(observation.T_world_feature).any():
            raise MessageError(UNSEEN)
        observation.T_world_feature[:] = _nearest(observation.T_world_feature)
        return self._receive(self._controller.step(observation), observation.joints)

    def _hold(
        self, scene: ViewpointScene, observation: ViewpointObservation, message: ObservationMessage, why: str
    ) -> Command:
        goal = resting_place(scene.arm, observation.setpoint, observation.setpoint_velocity)
        return tell_command(Received(goal, None, False, (), False), message.id, why)


def serve(
    listener: socket.socket, make: Callable[[], Controller], say: Callable[[str], None], clients: int | None = None
) -> None:
    """Answer clients, one after another.

    Args:
        listener: From :func:`surgbench.viewpoint.bridge.hub.listen`.
        make: A new controller.
        say: Told in a line who comes and goes.
        clients: How many; all that come unless told.
    """
    while clients is None or clients > 0:
        clients = None if clients is None else clients - 1
        listener.settimeout(None)
        connection, _ = listener.accept()
        lines = Lines(connection, HELLO_S)
        try:
            say(f"'{greet(lines).name}' is here")
            _answer(lines, Service(make))
            say("it has left")
        except BridgeError as error:
            say(str(error))
        finally:
            lines.close()


def _answer(lines: Lines, service: Service) -> None:
    """Answer one client until it leaves.

    Raises:
        BridgeError: It has hung up, reads nothing, or sent a line that is too long.
    """
    while True:
        answer: Message | None
        try:
            answer = service(lines.receive(None))
        except BridgeError as error:
            answer = ErrorMessage(error=str(error))
            if error.over:
                raise
        if answer is None:
            with contextlib.suppress(BridgeError):
                lines.send(Bye())
            return
        lines.send(answer)


def _nearest(pose: FloatArray) -> FloatArray:
    """A ``(4, 4)`` pose as it is, or the rigid one nearest to it.

    Raises:
        MessageError: It is too far off.
    """
    if is_rigid(pose):
        return pose
    nearest = rigid_transform(nearest_rotation(pose[:3, :3]), pose[:3, 3])
    if np.abs(nearest - pose).max() > RIGID_TOLERANCE:
        raise MessageError("the feature's pose is not a rotation and a translation")
    return nearest


def _line(error: Exception) -> str:
    return " ".join(f"the controller: {type(error).__name__}: {error}".split())[:1000]
