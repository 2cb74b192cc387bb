"""How the engine's inner loops are compiled."""

from __future__ import annotations

from typing import Any

from numba import njit


def compiled(function: Any = None, *, inline: str = "never") -> Any:
    """The ``njit`` of numba as all inner loops use it.

    Compiled once per machine, without the interpreter's lock, dividing as NumPy does. And without counting references
    (atomic, at every slice), which took 40 % of the time; so that a function that made an array would not compile.
    """
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "inline": inline, "_nrt": False}
    decorator: Any = njit(**options)
    return decorator if function is None else decorator(function)
