"""A run whose answers are there already, from a file or a record: they stand in the place of a tracker's process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, cast

from surgbench.contract import Observation
from surgbench.geometry import FloatArray
from surgbench.processes.child import Child
from surgbench.suite.running import Run
from surgbench.tasks.instrument.records import ANSWER_COLUMNS, SOURCE_COLUMNS


class AnsweredRun(Run):
    """A run whose child process is a function.

    Args:
        run: Is told how far it is.
        initial: ``(9 * arms,)`` the state of the first frame.
        step: Gives what was estimated in a frame: those of a tracker's answers that there are.
    """

    def __init__(self, run: Run, initial: FloatArray, step: Callable[[Observation], dict[str, Any]]) -> None:
        super().__init__(run.advance, run.stage)
        self._initial, self._own_step = initial, step

    @contextmanager
    def child(self, module: str, timeout_s: float, memory: str | None = None) -> Iterator[Child]:
        """What is asked of a child, it can do."""
        yield cast("Child", _Answers(self._initial, self._own_step))


class _Answers:
    """Answers the messages that a tracker's process is sent (:mod:`surgbench.tasks.instrument.worker`)."""

    def __init__(self, initial: FloatArray, step: Callable[[Observation], dict[str, Any]]) -> None:
        self._initial, self._step = initial, step
        self._answer: tuple[Any, ...] = ()

    def send(self, kind: str, *content: Any) -> None:
        if kind == "first":
            self._answer = ("initialised", self._initial, 0.0)
        elif kind == "step":
            unknown = dict.fromkeys((*ANSWER_COLUMNS, *SOURCE_COLUMNS, "confidence_arms", "lost_arms", "seen"))
            self._answer = ("answer", SimpleNamespace(**{**unknown, **self._step(content[0])}))

    def ready(self) -> tuple[Any, ...]:
        return ("ready",)

    def receive(self) -> tuple[Any, ...]:
        return self._answer
