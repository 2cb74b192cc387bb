"""What is checked, and how a check speaks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from surgbench.registry import create, find

# Called after everything that may take long.
Alive = Callable[[], None]


@dataclass(frozen=True)
class Subject:
    """Which tracker is checked, and how.

    Attributes:
        reference: Registered name, or ``FILE.py:Class``.
        options: Those of its ``Config``.
        budget_s: The longest that a step may take after warm-up.
        aids: What it refuses to run without, so that it is given that in all checks
            (:attr:`surgbench.task.Task.aids`).
    """

    reference: str
    options: dict[str, Any] = field(default_factory=dict)
    budget_s: float = 10.0
    aids: frozenset[str] = frozenset()

    def make(self) -> Any:
        """A fresh instance."""
        return create(find("tracker", self.reference), self.options)


# Raises what is wrong, or returns what there is to say: one line, which may be empty.
Check = Callable[[Subject, Alive], str]


class CheckFailedError(Exception):
    """A tracker breaks a rule; the message is one line for its author."""


class DoubtError(Exception):
    """Something that a tracker is free to do and should not."""
