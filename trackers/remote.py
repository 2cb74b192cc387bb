"""A controller in another process, or another language: its commands come over the bridge."""

from __future__ import annotations

import contextlib
import os
from typing import Annotated, ClassVar, TypeVar

import numpy as np
from pydantic import Field

from surgbench.config import Positive, Section
from surgbench.geometry import FloatArray
from surgbench.viewpoint.bridge.hub import PLACE, take_over
from surgbench.viewpoint.bridge.lines import BridgeError
from surgbench.viewpoint.bridge.messages import Command, ErrorMessage, Message, Ready
from surgbench.viewpoint.bridge.translation import tell_observation, tell_scene, understand_command
from surgbench.viewpoint.contract import ViewCommand, ViewpointObservation, ViewpointScene, ViewpointTracker
from surgbench.viewpoint.receiver import InvalidCommandError, Receiver
from surgbench.viewpoint.servo import resting_place

Answer = TypeVar("Answer", Command, Ready)
SEEDS = 2**31


class RemoteConfig(Section):
    """Options; `surgbench serve-viewpoint` sets them."""

    client: Annotated[str, Field(description="what the controller calls itself")] = "remote"
    version: Annotated[str, Field(description="of the controller: records of another one are other records")] = ""
    patience_s: Annotated[Positive, Field(description="longest wait for an answer; then the arm is held")] = 5.0


class Remote(ViewpointTracker):
    """Asks a client of the bridge (``docs/viewpoint-bridge.md``).

    As soon as the client hangs up, does not answer in time or says what is no command, the arm comes to rest and stays
    so to the trial's end; :attr:`held` says why.
    """

    name: ClassVar[str] = "remote"
    summary: ClassVar[str] = "a controller of another process or language, over `surgbench serve-viewpoint`"
    elsewhere: ClassVar[bool] = True
    Config = RemoteConfig

    def __init__(self, config: RemoteConfig) -> None:
        self._patience_s = config.patience_s

    @classmethod
    def unavailable(cls) -> str | None:
        """It needs a client."""
        return None if PLACE in os.environ else "it has no client; `surgbench serve-viewpoint --dataset DIR` brings one"

    def reset(self, scene: ViewpointScene, joints: FloatArray, rng: np.random.Generator) -> None:
        """Tell the client of the scene, and wait until it is ready."""
        self.held = None
        self._arm, self._receive = scene.arm, Receiver(scene)
        self._lines, self._prefix = take_over(self._patience_s)
        self._asked = 0
        try:
            self._ask(tell_scene(scene, joints, f"{self._prefix}-0", int(rng.integers(SEEDS))), Ready)
        except BridgeError as error:
            self._give_up(error, "before the first step")

    def step(self, observation: ViewpointObservation) -> ViewCommand:
        """What the client commands."""
        if self.held is None:
            self._asked += 1
            try:
                message = tell_observation(observation, f"{self._prefix}-{self._asked}")
                command = understand_command(self._ask(message, Command))
                self._receive(command, observation.joints)
                return command
            except InvalidCommandError as error:
                self._give_up(BridgeError("invalid", str(error)), f"step {observation.index}")
            except BridgeError as error:
                self._give_up(error, f"step {observation.index}")
        return ViewCommand(resting_place(self._arm, observation.setpoint, observation.setpoint_velocity))

    def close(self) -> None:
        """Let go of the client, who stays connected to whoever handed the connection out."""
        self._lines.socket.close()

    def _ask(self, question: Message, kind: type[Answer]) -> Answer:
        """The answer to a question; late ones to earlier questions are passed over.

        Raises:
            BridgeError: There is none.
        """
        self._lines.send(question)
        deadline = self._lines.deadline()
        while True:
            answer = self._lines.receive(deadline)
            if isinstance(answer, ErrorMessage):
                raise BridgeError("failed", f"the client says: {' '.join(answer.error.split())}")
            if getattr(answer, "id", None) != question.id:  # type: ignore[attr-defined]
                continue
            if isinstance(answer, kind):
                return answer
            raise BridgeError("invalid", f"the client answered with another message than '{kind.__name__.lower()}'")

    def _give_up(self, error: BridgeError, when: str) -> None:
        line = f"{when}: {str(error)[:1000]}; the arm came to rest and stayed"
        self.held = error.status, line
        if not error.over:
            with contextlib.suppress(BridgeError):
                self._lines.send(ErrorMessage(error=line))
