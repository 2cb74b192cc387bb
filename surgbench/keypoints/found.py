"""The tips that were found in a view: made when they are first looked at."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

from surgbench.geometry import FloatArray

Tips = tuple[FloatArray | None, ...]
BOTH = 2


class FoundTips:
    """What is known of a view's tips, or how to find out.

    Views that are made of one another share it, so that nothing is looked for twice. Where nobody looks, nothing is
    looked for; who pickles or copies it looks.

    Args:
        tips: Per arm ``(2, 2)`` or ``(1, 2)`` pixels, or ``None``; or what returns that.
    """

    def __init__(self, tips: Tips | Callable[[], Tips]) -> None:
        self._tips = tips

    @cached_property
    def every(self) -> Tips:
        """Per arm ``(n, 2)`` pixels, ``n`` 1 or 2, or ``None``."""
        return tuple(self._tips() if callable(self._tips) else self._tips)

    @cached_property
    def pairs(self) -> Tips:
        """The same, of arms of which both were found; of others ``None``."""
        return tuple(tips if tips is not None and len(tips) == BOTH else None for tips in self.every)

    def __reduce__(self) -> tuple[Any, ...]:
        return FoundTips, (self.every,)
