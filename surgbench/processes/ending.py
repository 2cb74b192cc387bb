"""Processes that end with the one that has started them, however that ends."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from multiprocessing import connection, parent_process
from pathlib import Path

WATCH_INTERVAL_S = 1.0
# In the environment of a process, and of all that it starts: what tells them from others wherever they have gone.
MARK = "SURGBENCH_CHILD"
# Looks for those who start others while they are being ended.
_ROUNDS = 20


def end_with_parent(parent: int) -> None:
    """End this process, and what it has started, when its parent is gone, whatever it is busy with.

    Args:
        parent: Its number, as it was when this process began.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_INTERVAL_S)
        end_all()

    threading.Thread(target=watch, daemon=True).start()


def end_worker_with_parent() -> None:
    """The same for a worker of a pool, which shares its parent's group."""
    parent = parent_process()
    if parent is not None:
        sentinel = parent.sentinel

        def follow() -> None:
            connection.wait([sentinel])
            os._exit(1)

        threading.Thread(target=follow, daemon=True).start()


def end_all() -> None:
    """End this process, and with it what it has started where the group is its own."""
    if os.getpgrp() == os.getpid():
        end_marked(os.environ.get(MARK, ""))
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


def end_marked(mark: str) -> None:
    """End all other processes that have a mark: those too that have left the session or outlived their parents.

    Args:
        mark: What :data:`MARK` is in their environment; nothing is done without.
    """
    wanted = f"{MARK}={mark}".encode()
    for _ in range(_ROUNDS if mark else 0):
        if not sum(_end_if_marked(int(place.name), wanted) for place in Path("/proc").glob("[0-9]*")):
            return


def _end_if_marked(pid: int, wanted: bytes) -> bool:
    """Whether a process had the mark, and was alive; it is no longer."""
    if pid == os.getpid():
        return False
    with contextlib.suppress(OSError):  # it has ended, or is another user's
        handle = os.pidfd_open(pid)  # so that no other process can come by its number meanwhile
        try:
            # Of one that has ended, and of which only its number is left, it is empty.
            if wanted in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0"):
                signal.pidfd_send_signal(handle, signal.SIGKILL)
                return True
        finally:
            os.close(handle)
    return False
