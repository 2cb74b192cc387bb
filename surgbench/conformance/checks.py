"""The list of checks, and how one of them ends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from surgbench.conformance.subject import Alive, Check, CheckFailedError, DoubtError, Subject
from surgbench.errors import InvalidAnswerError, SurgbenchError
from surgbench.registry import find
from surgbench.task import Task, find_task

Status = Literal["ok", "warning", "refused", "FAILED", "not run"]


@dataclass(frozen=True)
class Outcome:
    """How a check ended.

    Attributes:
        check: Its name.
        status: ``ok``; ``warning``: allowed, but look at it; ``refused``: the tracker says that it does not do this;
            ``FAILED``; ``not run``.
        message: One line, may be empty.
        needs: It ran only when it was given this (:attr:`surgbench.task.Task.aids`).
    """

    check: str
    status: Status
    message: str = ""
    needs: str | None = None


def task_of(subject: Subject) -> Task:
    """What it works on."""
    return find_task(find("tracker", subject.reference).task)


def checks_of(subject: Subject) -> Mapping[str, Check]:
    """The checks of its task."""
    return task_of(subject).checks()


def run_check(name: str, subject: Subject, alive: Alive = lambda: None) -> Outcome:
    """Run one check in this process, whatever the tracker raises.

    Args:
        name: A key of :func:`checks_of`.
        subject: The tracker.
        alive: Called after every reset and step.
    """
    try:
        return Outcome(name, "ok", checks_of(subject)[name](subject, alive))
    except DoubtError as doubt:
        return Outcome(name, "warning", str(doubt))
    except (CheckFailedError, InvalidAnswerError) as error:
        return Outcome(name, "FAILED", _line(error))
    except SurgbenchError as error:
        task = task_of(subject)
        for aid in task.aids if name == task.first_check and not subject.aids else ():
            if run_check(name, replace(subject, aids=frozenset({aid})), alive).status in ("ok", "warning"):
                return Outcome(name, "refused", f"needs {aid} ({_line(error)})", needs=aid)
        if name in task.may_refuse:
            return Outcome(name, "refused", _line(error))
        return Outcome(name, "FAILED", f"{type(error).__name__}: {_line(error)}")
    except Exception as error:  # whatever it raised is the outcome
        return Outcome(name, "FAILED", f"{type(error).__name__}: {_line(error)}")


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
