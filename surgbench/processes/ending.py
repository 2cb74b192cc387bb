"""Processes that end with the one that has started them, however that ends."""

from __future__ import annotations

import os
import signal
import threading
import time
from multiprocessing import connection, parent_process

WATCH_INTERVAL_S = 1.0


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
        os.killpg(0, signal.SIGKILL)
    os._exit(1)
