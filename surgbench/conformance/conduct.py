"""All checks of one tracker, in a process that is replaced when a check fails in it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from surgbench.conformance.checks import Outcome, checks_of, task_of
from surgbench.conformance.subject import Subject
from surgbench.processes.child import Child, ChildProblemError

WORKER = "surgbench.conformance.worker"


def conduct(
    subject: Subject,
    timeout_s: float,
    report: Callable[[Outcome], None] = lambda _: None,
    names: Iterable[str] | None = None,
) -> list[Outcome]:
    """Check a tracker.

    What does not get through the first check, a plain sequence or trial, is not put to the others.

    Args:
        subject: The tracker.
        timeout_s: The longest wait for a reset or a step.
        report: Called with each outcome as soon as it is there.
        names: Which checks; all, unless told.

    Returns:
        One outcome per check.
    """
    outcomes: list[Outcome] = []
    first = task_of(subject).first_check
    child: Child | None = None
    try:
        for name in checks_of(subject) if names is None else names:
            if any(outcome.check == first and outcome.status == "FAILED" for outcome in outcomes):
                outcome = Outcome(name, "not run", "for it does not get through the first")
            else:
                child = child or _begin(timeout_s)
                outcome = _ask(child, name, subject)
                if outcome.status == "FAILED":
                    child.stop()
                    child = None
            if outcome.needs is not None:
                subject = replace(subject, aids=subject.aids | {outcome.needs})
            outcomes.append(outcome)
            report(outcome)
    finally:
        if child is not None:
            child.stop()
    return outcomes


def _begin(timeout_s: float) -> Child:
    child = Child(timeout_s, WORKER)
    try:
        child.send("ready")
        child.ready()
    except BaseException:
        child.stop()
        raise
    return child


def _ask(child: Child, name: str, subject: Subject) -> Outcome:
    child.send("check", name, subject)
    try:
        while (message := child.receive())[0] == "alive":
            pass
    except ChildProblemError as problem:
        return Outcome(name, "FAILED", str(problem))
    outcome: Outcome = message[1]
    return outcome
