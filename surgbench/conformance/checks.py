"""The list of checks, and how one of them ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from surgbench.conformance import answers, inputs, isolation
from surgbench.conformance.answers import Alive, DoubtError
from surgbench.conformance.session import CheckFailedError, Subject
from surgbench.errors import SurgbenchError
from surgbench.registry import find
from surgbench.suite.worker import InvalidAnswerError

Status = Literal["ok", "warning", "refused", "FAILED", "not run"]
Check = Callable[[Subject, Alive], str]

# In this order; each says in its docstring what it is about.
CHECKS: dict[str, Check] = {
    "plain sequence": answers.plain,
    "joint limits": answers.limits,
    "same seed": answers.same_seed,
    "other seed": answers.other_seed,
    "time": answers.budget,
    "no global randomness": isolation.no_global_randomness,
    "input untouched": inputs.untouched,
    "reset starts anew": isolation.resets,
    "another process": isolation.moves_to_another_process,
    "empty masks": inputs.empty_masks,
    "full masks": inputs.full_masks,
    "lost and found": inputs.lost_and_found,
    "no keypoints": inputs.no_keypoints,
    "strange starts": answers.strange_starts,
    "readings": inputs.readings,
    "kinematics": inputs.kinematics,
    "two arms": inputs.two_arms,
    "candidates": answers.candidates,
}
# What a tracker or controller must get through before it is put to the others.
FIRST = ("plain sequence", "plain trial")
# A tracker may say, with a SurgbenchError, that it does not do this.
MAY_REFUSE = ("readings", "kinematics", "two arms")


@dataclass(frozen=True)
class Outcome:
    """How a check ended.

    Attributes:
        check: Its name.
        status: ``ok``; ``warning``: allowed, but look at it; ``refused``: the tracker says that it does not do this;
            ``FAILED``; ``not run``.
        message: One line, may be empty.
        needs_kinematics: It ran with the robot's own readings only.
    """

    check: str
    status: Status
    message: str = ""
    needs_kinematics: bool = False


def checks_of(subject: Subject) -> dict[str, Check]:
    """The checks of its task."""
    if find("tracker", subject.reference).task == "instrument":
        return CHECKS
    from surgbench.conformance.viewpoint import VIEWPOINT_CHECKS

    return VIEWPOINT_CHECKS


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
        if name in FIRST and not subject.kinematics:
            with_kinematics = run_check(name, replace(subject, kinematics=True), alive)
            if with_kinematics.status in ("ok", "warning"):
                return Outcome(name, "refused", f"needs kinematics ({_line(error)})", needs_kinematics=True)
        if name in MAY_REFUSE:
            return Outcome(name, "refused", _line(error))
        return Outcome(name, "FAILED", f"{type(error).__name__}: {_line(error)}")
    except Exception as error:  # whatever it raised is the outcome
        return Outcome(name, "FAILED", f"{type(error).__name__}: {_line(error)}")


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
