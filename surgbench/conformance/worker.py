"""The process that checks run in, so that a tracker that crashes or hangs fails one check and no more."""

from __future__ import annotations

from typing import Any

from surgbench.conformance.checks import run_check
from surgbench.conformance.subject import Subject
from surgbench.processes.service import Tell, serve_parent


def answer(tell: Tell, kind: str, *content: Any) -> tuple[Any, ...]:
    """Answer ``("ready",)`` likewise, and ``("check", name, Subject)`` with ``("outcome", Outcome)``.

    Signs of life, ``("alive",)``, come in between.
    """
    if kind == "ready":  # everything is imported
        return ("ready",)
    name, subject = content
    assert isinstance(subject, Subject)
    return ("outcome", run_check(name, subject, lambda: tell("alive")))


if __name__ == "__main__":
    serve_parent(answer)
