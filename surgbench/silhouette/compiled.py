"""How the engine's inner loops are compiled."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit


@cache
def _sources() -> str:
    """Hash of all modules of this package."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"\0".join(file.read_bytes() for file in files)).hexdigest()


def compiled(function: Any = None, *, inline: str = "never") -> Any:
    """The ``njit`` of numba as all inner loops use it.

    Compiled once per machine, without the interpreter's lock, dividing as NumPy does. And without counting references
    (atomic, at every slice), which took 40 % of the time; so that a function that made an array would not compile.
    """
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "inline": inline, "_nrt": False}
    decorator: Any = njit(**options)

    def decorate(function: Any) -> Any:
        dispatcher = decorator(function)
        # numba keeps compiled code as long as the function's own file stays the same, even where a function of another
        # file that it calls, and has swallowed, has changed. Here it is the whole package that has to stay the same.
        dispatcher._cache._cache_file._source_stamp = _sources()
        return dispatcher

    return decorate if function is None else decorate(function)
