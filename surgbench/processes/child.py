"""The parent's end of a tracker's child process: start it, talk to it, give up on it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from multiprocessing.connection import Pipe
from secrets import token_hex
from threading import Lock
from typing import Any

from surgbench.processes.ending import MARK, end_marked
from surgbench.processes.memory import LOOK_INTERVAL_S, MemoryLimit
from surgbench.processes.printed import Printed
from surgbench.processes.service import CALIBRATE, COMPILING, LINE_CLOSED
from surgbench.processes.threads import THREADS

# The reference work may have to be compiled first, on a busy machine.
CALIBRATION_TIMEOUT_S = 300.0

# The longest wait for a child that loads what it works with, where no longer one is asked for: imports take seconds,
# and on a busy machine more.
START_TIMEOUT_S = 120.0

# Between two looks at whether it is there at all, while it says nothing.
_LOOK_INTERVAL_S = 1.0

# Who hangs up is about to end; who is still there after this has closed the line and goes on.
_PARTING_S = 5.0


_CLOSED = "closed the line on which it answers"


class ChildProblemError(Exception):
    """A run cannot go on.

    Attributes:
        status: ``failed`` (raised), ``invalid`` (no state), ``timeout``, ``exited`` or ``memory`` (used too much).
        traceback: The child's, where there is one.
    """

    def __init__(self, status: str, message: str, traceback: str | None = None) -> None:
        super().__init__(message)
        self.status = status
        self.traceback = traceback


class Child:
    """A tracker's process. Use it as a context manager: it is gone afterwards, whatever happened.

    So is what it has started: it has a session and a group of its own, which are ended with it, and a mark in its
    environment, by which those are found that have left both. Else the helpers of a tracker would go on working, and
    whoever reads the output of this command would wait for them. What any of them prints goes to standard error, up to
    a bound (:mod:`surgbench.processes.printed`).

    Args:
        timeout_s: The longest silence that is waited for, once it has said that it is ready. While a function is
            compiled, it begins anew with each.
        module: What it runs.
        environment: What its environment has besides, or otherwise than, this process's.
        arguments: What the module is told besides.
        memory: How much it and what it starts may use, as ``"2 GB"``; whatever there is unless told.
        folder: Its working directory; ``None``: this process's.

    Attributes:
        timeout_s: May be changed between messages.
    """

    def __init__(
        self,
        timeout_s: float,
        module: str,
        environment: Mapping[str, str] = THREADS,
        arguments: tuple[str, ...] = (),
        memory: str | None = None,
        folder: str | None = None,
    ) -> None:
        self.timeout_s = timeout_s
        self._memory = None if memory is None else MemoryLimit(memory)
        self._connection, theirs = Pipe()
        self._mark = token_hex(16)
        self._printed = Printed()
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, str(theirs.fileno()), *arguments],
            pass_fds=[theirs.fileno()],
            env={**os.environ, **environment, MARK: self._mark},
            stdout=self._printed.theirs,
            stderr=self._printed.theirs,
            start_new_session=True,
            cwd=folder,
        )
        self._printed.begin()
        self._ending = Lock()
        theirs.close()

    def __enter__(self) -> Child:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def pid(self) -> int:
        """The process's number."""
        return self._process.pid

    def kill(self) -> None:
        """End the process and what it has started at once; another thread that waits for it is told."""
        with self._ending:
            if self._process.returncode is None:  # else its number may be another's
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self.pid, signal.SIGKILL)

    def stop(self) -> None:
        """End the process and hang up."""
        self.kill()
        self._wait()
        end_marked(self._mark)
        self._connection.close()
        self._printed.end()

    def _wait(self) -> int:
        """Its exit code, once it has ended; what it has started ends then."""
        with contextlib.suppress(ChildProcessError):  # waited for already
            os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT)
        self.kill()  # before its number is given back
        with self._ending:
            return self._process.wait()

    def send(self, *message: Any) -> None:
        """Tell the child something; a dead child is noticed at the next :meth:`receive`."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # receive() says how it died
            self._connection.send(message)

    def receive(self) -> tuple[Any, ...]:
        """The child's next message.

        Raises:
            ChildProblemError: It reports a problem, ended, or said nothing for too long.
        """
        return self._receive(self.timeout_s)

    def ready(self) -> tuple[Any, ...]:
        """The same, of a message that comes once the child has loaded what it works with.

        Raises:
            ChildProblemError: As in :meth:`receive`.
        """
        return self._receive(max(self.timeout_s, START_TIMEOUT_S))

    def _receive(self, patience_s: float) -> tuple[Any, ...]:
        message: tuple[Any, ...] = COMPILING
        try:
            while message == COMPILING:  # the wait begins anew
                if not self._answers(patience_s):
                    raise ChildProblemError("timeout", f"no answer within {patience_s:g} s")
                message = self._connection.recv()
        except (EOFError, OSError):
            raise ChildProblemError("exited", f"the tracker's process {self._how_it_ended()}") from None
        if message[0] == "problem":
            raise ChildProblemError(*message[1:])
        return message

    def _answers(self, patience_s: float) -> bool:
        """Wait for something to receive.

        Raises:
            EOFError: It has ended, and only what it has started holds the line.
            ChildProblemError: They use more memory than they may.
        """
        deadline = time.monotonic() + patience_s
        interval_s = _LOOK_INTERVAL_S if self._memory is None else LOOK_INTERVAL_S
        self._check_memory()  # also of one that never makes anybody wait
        while not self._connection.poll(max(0.0, min(interval_s, deadline - time.monotonic()))):
            self._check_memory()
            if self._has_ended() and not self._connection.poll(0):
                raise EOFError
            if time.monotonic() >= deadline:
                return False
        return True

    def _check_memory(self) -> None:
        if self._memory is not None and self._memory.exceeded(self.pid):
            raise ChildProblemError("memory", f"used more than {self._memory.size} of memory")

    def _how_it_ended(self) -> str:
        """In a few words, of one who has hung up."""
        deadline = time.monotonic() + _PARTING_S
        while not self._has_ended():
            if time.monotonic() > deadline:
                return _CLOSED
            time.sleep(0.01)
        code = self._wait()
        if code == -signal.SIGKILL:
            return "was killed (signal 9), as the system does when memory is used up"
        if code < 0:
            return f"was killed by signal {-code} ({signal.strsignal(-code) or 'unknown'})"
        return _CLOSED if code == LINE_CLOSED else f"exited with code {code}"

    def _has_ended(self) -> bool:
        try:
            return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None
        except ChildProcessError:  # waited for already
            return True

    def calibrate(self) -> list[float]:
        """Have the reference work timed in there, between messages; milliseconds of each turn.

        Raises:
            ChildProblemError: As in :meth:`receive`; what the child was to do itself cannot be told any more.
        """
        self.send(*CALIBRATE)
        times: list[float] = self._receive(CALIBRATION_TIMEOUT_S)[1]
        return times
