"""A worker's process that does tasks: prepared once, it does one after the other."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

from surgbench.processes.service import Tell, serve_parent

# What it works with stays between messages.
_do: Callable[[Any], int] | None = None


def _answer(tell: Tell, kind: str, *content: Any) -> tuple[Any, ...]:
    """``("start", start, arguments, do)`` or ``("task", task)``; what is raised goes back as it is."""
    global _do
    try:
        if kind == "start":
            start, arguments, _do = content
            start(*arguments, ctypes.c_bool(False))
            return ("done", 0)
        assert _do is not None
        return ("done", _do(*content))
    except Exception as error:
        return ("raised", error)


if __name__ == "__main__":
    serve_parent(_answer)
