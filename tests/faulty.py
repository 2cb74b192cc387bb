"""Trackers that do what a process can do wrong, each in a way of its own; see ``tests/engine/test_faults.py``."""

from __future__ import annotations

import ctypes
import os
import random
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

GIGABYTE, MEGABYTE = 10**9, 10**6
# Where processes that are left behind are noted.
NOTED = "SURGBENCH_TEST_NOTED"


class Sound:
    """The one beside all others."""

    name = "sound"

    def reset(self, scene: Any, state: Any, rng: Any) -> None:
        self.state = state

    def step(self, observation: Any) -> Any:
        return observation.start


class RaisesInInit(Sound):
    name = "raises-in-init"

    def __init__(self) -> None:
        raise RuntimeError("no licence")


class RaisesInReset(Sound):
    name = "raises-in-reset"

    def reset(self, scene: Any, state: Any, rng: Any) -> None:
        raise KeyError("left")


class Later(Sound):
    """Does it at frame 2, when the warm-up is over."""

    def step(self, observation: Any) -> Any:
        return self.fail(observation) if observation.index == 2 else observation.start

    def fail(self, observation: Any) -> Any:
        raise NotImplementedError


class Raises(Later):
    name = "raises"

    def fail(self, observation: Any) -> Any:
        raise RuntimeError("no\ninstrument")


class RaisesTheUnspeakable(Later):
    name = "raises-the-unspeakable"

    def fail(self, observation: Any) -> Any:
        class UnspeakableError(Exception):
            def __str__(self) -> str:
                raise ValueError

        raise UnspeakableError


class RaisesAnEssay(Later):
    name = "raises-an-essay"

    def fail(self, observation: Any) -> Any:
        raise RuntimeError("x" * 100 * MEGABYTE)


class Recurses(Later):
    name = "recurses"

    def fail(self, observation: Any) -> Any:
        return self.fail(observation)


class Hangs(Later):
    """And does not end when it is asked to."""

    name = "hangs"

    def fail(self, observation: Any) -> Any:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        while True:
            time.sleep(3600)


class SysExits(Later):
    """Beside a thread that would be waited for."""

    name = "sys-exits"

    def fail(self, observation: Any) -> Any:
        threading.Thread(target=time.sleep, args=(3600,)).start()
        sys.exit(4)


class OsExits(Later):
    name = "os-exits"

    def fail(self, observation: Any) -> Any:
        os._exit(5)


class IsKilled(Later):
    name = "is-killed"

    def fail(self, observation: Any) -> Any:
        os.kill(os.getpid(), signal.SIGKILL)


class Segfaults(Later):
    name = "segfaults"

    def fail(self, observation: Any) -> Any:
        ctypes.string_at(0)


class TakesMemory(Later):
    name = "takes-memory"

    def fail(self, observation: Any) -> Any:
        kept = []
        for _ in range(30):
            kept.append(np.ones(50 * MEGABYTE // 8))
            time.sleep(0.05)
        time.sleep(3600)


class ChildrenTakeMemory(Later):
    """Each of them less than it may."""

    name = "children-take-memory"

    def fail(self, observation: Any) -> Any:
        for _ in range(4):
            if os.fork() == 0:
                kept = np.ones(300 * MEGABYTE // 8)
                time.sleep(3600)
                del kept
        time.sleep(3600)


class SharesMemory(Later):
    """Forks share what was there before; and memory that nobody writes to is none."""

    name = "shares-memory"

    def fail(self, observation: Any) -> Any:
        self.reserved = np.empty(8 * GIGABYTE // 8)
        self.kept = np.ones(200 * MEGABYTE // 8)
        for _ in range(6):
            if os.fork() == 0:
                time.sleep(3600)
        time.sleep(1)
        return observation.start


class ReturnsNan(Later):
    name = "returns-nan"

    def fail(self, observation: Any) -> Any:
        return np.full(9, np.nan)


class ReturnsShape(Later):
    name = "returns-shape"

    def fail(self, observation: Any) -> Any:
        return np.zeros((9, 1))


class Far(Later):
    name = "far"

    def fail(self, observation: Any) -> Any:
        return np.full(9, 1e300)


class BentTooFar(Later):
    name = "bent-too-far"

    def fail(self, observation: Any) -> Any:
        return [*observation.start[:8], 5.0]


class PrintsAGigabyte(Later):
    name = "prints-a-gigabyte"

    def fail(self, observation: Any) -> Any:
        for _ in range(GIGABYTE // MEGABYTE // 2):
            os.write(1, b"x" * MEGABYTE)
            os.write(2, b"y" * MEGABYTE)
        return observation.start


class GoesOnTwice(Later):
    """As two processes, which both answer."""

    name = "goes-on-twice"

    def fail(self, observation: Any) -> Any:
        if os.fork() == 0:
            return observation.start + 1e-3
        time.sleep(0.5)
        return observation.start


class LeavesProcesses(Later):
    """One of its session and one that has left it, with parents that have ended."""

    name = "leaves-processes"

    def fail(self, observation: Any) -> Any:
        for leaves in (False, True):
            if os.fork() == 0:
                if leaves:
                    os.setsid()
                if os.fork() == 0:
                    with open(os.environ[NOTED], "a") as file:  # noqa: PTH123
                        file.write(f"{os.getpid()}\n")
                    time.sleep(3600)
                os._exit(0)
        while len(Path(os.environ[NOTED]).read_text().split() if Path(os.environ[NOTED]).exists() else ()) < 2:
            time.sleep(0.01)
        return observation.start


class ClosesEverything(Later):
    name = "closes-everything"

    def fail(self, observation: Any) -> Any:
        os.closerange(0, 1000)
        return observation.start


class ClosesEverythingAndStays(Later):
    name = "closes-everything-and-stays"

    def fail(self, observation: Any) -> Any:
        os.closerange(0, 1000)
        time.sleep(3600)


class Wanders(Later):
    """Changes what belongs to the process: folder, seeds, environment, threads."""

    name = "wanders"

    def fail(self, observation: Any) -> Any:
        os.chdir("/")
        os.umask(0o777)
        random.seed(0)
        np.random.seed(0)  # noqa: NPY002
        os.environ.clear()
        sys.path.clear()
        for _ in range(3):
            threading.Thread(target=time.sleep, args=(3600,)).start()
        return observation.start


class Alters(Later):
    """Writes to a mask of the dataset, which is not its to do."""

    name = "alters"

    def fail(self, observation: Any) -> Any:
        for path in Path(os.environ[NOTED]).rglob("observed/*/000003.png"):
            path.write_bytes(path.read_bytes() + b"\n")
        return observation.start
