"""A child process that serves its parent over a pipe: what all of them begin with."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

WATCH_INTERVAL_S = 1.0


def end_with_parent(parent: int) -> None:
    """End this process when its parent is gone, whatever it is busy with."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_INTERVAL_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def serve_parent(serve: Callable[[Connection], None]) -> None:
    """Serve the parent whose pipe's number is the first argument, as long as it lives."""
    end_with_parent(os.getppid())
    # Ctrl-C is the parent's to handle; what a plug-in prints must not end up in the command's output.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.dup2(2, 1)
    serve(Connection(int(sys.argv[1])))
