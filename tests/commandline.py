"""The command as a user types it, and the records it leaves."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pytest

from surgbench.cli import main

# Trackers of people who never saw the package.
STRANGERS = Path(__file__).with_name("strangers.py")
# And mask sources of such.
MASK_MAKERS = Path(__file__).with_name("mask_makers.py")
# For runs in which it does not matter where the tips come from: without the network a run starts two seconds sooner.
RUN = ("run", "--keypoints", "observed")

# What does its work is waited for as long as this, seconds, on however busy a machine; only what hangs takes longer.
AMPLE_S = 600.0

# The command, which gets no further than to its NUMBER-th file that is called PATTERN: before it puts that in its place
# it ends as by kill -9, or waits to be interrupted. So no clock decides how far it comes.
STOPPED = """
import fnmatch, os, signal, sys, time
how, pattern, number = sys.argv[1], sys.argv[2], int(sys.argv[3])
del sys.argv[1:4]
put, seen = os.replace, 0

def counted(source, target):
    global seen
    seen += fnmatch.fnmatch(os.path.basename(target), pattern)
    if seen == number:
        time.sleep(3600) if how == "wait" else os.kill(os.getpid(), signal.SIGKILL)
    put(source, target)

os.replace = counted
from surgbench.cli import main
main()
"""


def surgbench(*arguments: object, expect: int = 0) -> None:
    """The command as a user types it, in this process."""
    before = sys.argv
    sys.argv = ["surgbench", *map(str, arguments)]
    try:
        with pytest.raises(SystemExit) as ended:
            main()
    finally:
        sys.argv = before
    assert ended.value.code == expect


def records(folder: Path) -> list[dict[str, Any]]:
    """All records below a folder, in the order of their paths."""
    return [json.loads(path.read_text()) for path in sorted(folder.rglob("*-r*.json"))]


def stopped(how: Literal["kill", "wait"], pattern: str, number: int, *arguments: object) -> list[str]:
    """The command line of a command that gets no further than to a file (see ``STOPPED``)."""
    return [sys.executable, "-c", STOPPED, how, pattern, str(number), *map(str, arguments)]


def kill_before(pattern: str, number: int, *arguments: object) -> None:
    """Run a command that is killed before it puts its ``number``-th file of a pattern in its place."""
    assert subprocess.run(stopped("kill", pattern, number, *arguments), check=False).returncode == -signal.SIGKILL


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait as long as it takes."""
    deadline = time.monotonic() + AMPLE_S
    while not condition():
        assert time.monotonic() < deadline, "it hangs"
        time.sleep(0.02)
