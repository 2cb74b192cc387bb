"""Who wants to know that something is being compiled: on a busy machine that takes minutes, in which nothing hangs."""

from __future__ import annotations

from collections.abc import Callable

# Called without arguments whenever the compilation of a function begins or is done, in whatever thread that happens.
LISTENERS: list[Callable[[], None]] = []


def announce_compilation() -> None:
    """Tell all of them."""
    for listener in LISTENERS:
        listener()
