"""A child process that serves its parent over a pipe: what all of them have in common."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import signal
import sys
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
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
# How a child ends that finds the line closed, as by a plug-in that closes all descriptors.
LINE_CLOSED = 97
# Characters of what a plug-in raises that are told: of its words the first, of its traceback the last.
MOST_WORDS, MOST_TRACEBACK = 2000, 20_000

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
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)  # it may end before it writes what it holds back
    _be_ended_first()
    line = int(sys.argv[1])
    os.set_inheritable(line, False)  # a program that a plug-in starts would hold it open
    os.register_at_fork(after_in_child=lambda: _take_away(line))
    try:
        serve(Connection(line), answer)
    except OSError as error:
        if error.errno == errno.EBADF:
            os._exit(LINE_CLOSED)
        raise
    finally:
        end_all()


def _take_away(line: int) -> None:
    """Give a copy of this process, which a plug-in has made, another end of the line: it answers nobody, and ends."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, line, inheritable=False)
    os.close(nowhere)


def _be_ended_first() -> None:
    """Have the system end this process, and not the command that waits for it, when memory is used up."""
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("500")


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
        except (EOFError, ConnectionResetError):  # the latter where the parent was killed before it had read everything
            return
        try:
            answered = calibrate() if _asks_to_calibrate(message) else answer(tell, *message)
        except BaseException as error:  # also of sys.exit, after which threads of a plug-in would be waited for
            answered = _problem(error)
        try:
            tell(*answered)
        except (BrokenPipeError, ConnectionResetError):  # the parent is gone
            return
        if answered[0] == "problem":
            return


def _problem(error: BaseException) -> tuple[Any, ...]:
    """What is told of what a plug-in has raised."""
    try:
        words = " ".join(str(error).split())[:MOST_WORDS]
        trace = traceback.format_exc()[-MOST_TRACEBACK:]
    except Exception:  # raised by the error itself
        words, trace = "which cannot be put in words", ""
    if isinstance(error, SystemExit):
        code = error.code if isinstance(error.code, int) else int(error.code is not None)
        return ("problem", "exited", f"the tracker's process exited with code {code}", trace)
    if isinstance(error, InvalidAnswerError):
        return ("problem", "invalid", words, trace)
    return ("problem", "failed", f"{type(error).__name__}: {words}", trace)
