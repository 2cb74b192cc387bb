"""Plug-ins of a row, looked up, with their effective options."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from surgbench.errors import ConfigError
from surgbench.registry import configure, find
from surgbench.suite.settings import Plug


def plug(kind: str, reference: str, options: dict[str, dict[str, Any]], task: str) -> Plug:
    """A plug-in with its options.

    Raises:
        NotFoundError: No such plug-in.
        ConfigError: A wrong option, or it is for another task.
    """
    found = find(kind, reference)
    if found.task != task and not hasattr(found.cls, "task") and kind == "tracker":
        raise ConfigError(
            f"tracker '{found.name}' is for the {found.task} task, as its class has no 'task'; this dataset is of the "
            f'{task} task, whose controllers have task = "{task}"'
        )
    if found.task != task:
        raise ConfigError(f"{kind} '{found.name}' is for the {found.task} task; this dataset is of the {task} task")
    given = options.get(found.name, {})
    config = configure(found, given)
    effective = {} if config is None else config.model_dump(mode="json")
    # What an option finds out for itself is no change that somebody asked for.
    changed = {} if config is None else config.model_dump(mode="json", exclude_defaults=True, exclude_unset=True)
    needs_truth = bool(getattr(found.cls, "needs_truth", False))
    source = f"{found.source}@{found.hash}"
    return Plug(kind, reference, found.name, source, effective, changed, needs_truth, found.unavailable)


def edited(plugs: Iterable[Plug]) -> str | None:
    """One line on a plug-in whose text is another one now than when it was looked up; ``None`` where none is."""
    for one in plugs:
        found = find(one.kind, one.reference)
        if one.source != f"{found.source}@{found.hash}":
            return f"the source of {one.kind} '{one.name}' was edited during the run; run it again"
    return None
