"""A child process that serves its parent over a pipe: what all of them have in common."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from threading import Lock
from typing import Any

from surgbench.errors import InvalidAnswerError
from surgbench.processes.compiling import LISTENERS
from surgbench.processes.ending import end_all, end_with_parent
from surgbench.processes.streams import print_whatever_comes

# What a child says in between, to those who wait for its answer: it compiles, and does not hang.
COMPILING = ("compiling",)
# A message that every child answers, with ("calibrated", milliseconds of each turn of the reference work).
CALIBRATE = ("calibrate",)

Tell = Callable[..., None]
# Takes what to send in between, and a message; returns the answer, a tuple.
Answer = Callable[..., tuple[Any, ...]]


def serve_parent(answer: Answer) -> None:
    """Serve the parent whose pipe's number is the first argument, as long as it lives.

    Args:
        answer: As for :func:`serve`.
    """
    end_with_parent(os.getppid())
    # Ctrl-C is the parent's to handle; what a plug-in prints must not end up in the command's output.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    print_whatever_comes()  # before stdout is another file: the stream may believe that it can seek in it
    os.dup2(2, 1)
    line = int(sys.argv[1])
    os.set_inheritable(line, False)  # a program that a plug-in starts would hold it open
    serve(Connection(line), answer)
    end_all()


def calibrate() -> tuple[Any, ...]:
    """The answer to :data:`CALIBRATE`."""
    from surgbench.processes.reference_work import measure_ms  # compiled code, which not every child has loaded

    return ("calibrated", measure_ms())


def _asks_to_calibrate(message: tuple[Any, ...]) -> bool:
    return len(message) == 1 and isinstance(message[0], str) and message == CALIBRATE


def serve(connection: Connection, answer: Answer) -> None:
    """Answer messages until the other end hangs up, or something goes wrong.

    :data:`CALIBRATE` is answered here, for all.

    Whatever a plug-in raises is the run's result: it is told as ``("problem", status, one line, traceback)``, with the
    status ``invalid`` where it is an :class:`InvalidAnswerError`, else ``failed``.

    Args:
        connection: To the parent.
        answer: Takes a function that sends words in between, and a message's parts; returns the answer's.
    """
    talking = Lock()

    def tell(*words: Any) -> None:
        with talking:
            connection.send(words)

    def tell_of_compilation() -> None:
        with contextlib.suppress(OSError):  # the parent may be gone, which is noticed elsewhere
            tell(*COMPILING)

    LISTENERS.append(tell_of_compilation)
    try:
        _serve(connection, answer, tell)
    finally:
        LISTENERS.remove(tell_of_compilation)


def _serve(connection: Connection, answer: Answer, tell: Tell) -> None:
    while True:
        try:
            message = connection.recv()
        except (EOFError, OSError):  # the latter where the parent was killed before it had read everything
            return
        try:
            tell(*(calibrate() if _asks_to_calibrate(message) else answer(tell, *message)))
        except Exception as error:
            invalid = isinstance(error, InvalidAnswerError)
            line = " ".join((str(error) if invalid else f"{type(error).__name__}: {error}").split())
            with contextlib.suppress(OSError):  # the parent may be gone
                tell("problem", "invalid" if invalid else "failed", line, traceback.format_exc())
            return
