"""The child process of a trial that a simulated hand leads: hand, controller and simulator close their loop in here.

It is given the trial with its truth, for the hand and the wire are in it; the controller is shown none of it.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from typing import Any

from surgbench.processes.service import Tell, serve_parent
from surgbench.randomness import generator
from surgbench.registry import create, find
from surgbench.tasks.viewpoint.asked import WorksFrom
from surgbench.tasks.viewpoint.worker import ViewpointSetup, warm_up
from surgbench.viewpoint.hand.operation import LIMIT_S, Operating
from surgbench.viewpoint.hand.person import Person
from surgbench.viewpoint.optics.teleoperation import TeleoperationSettings


@dataclass(frozen=True)
class HandSetup:
    """What a child is told.

    Attributes:
        view: Controller, trial with its truth, scene.
        works_from: Whose picture the hand works by.
        steady: The tool does not turn where teleoperation takes the view anew.
        person: Who.
        noise: Named axes that seed the errors of hand and eyes.
        steps: No more than so many; ``None``: until the ring is back.
    """

    view: ViewpointSetup
    works_from: WorksFrom
    steady: bool
    person: Person
    noise: dict[str, str | int]
    steps: int | None

    @property
    def longest(self) -> int:
        """Steps after which a trial ends whatever the hand does."""
        longest = round(LIMIT_S / self.view.scene.dt_s)
        return longest if self.steps is None else min(self.steps, longest)


def run(tell: Tell, setup: HandSetup) -> tuple[Any, ...]:
    """How a trial went; tells ``("ready",)``, ``("progress", steps)``, and what was done before a problem."""
    view = setup.view
    found = find("tracker", view.tracker.reference)
    tell("ready")  # everything is imported
    with contextlib.suppress(Exception):  # what is wrong with it will show again
        warm_up(replace(view, trial=replace(view.trial, truth=None)))
    operating = Operating(
        create(found, view.tracker.options),
        view.trial,
        view.scene,
        setup.works_from,
        setup.person,
        generator(**view.axes),
        generator(**setup.noise),
        setup.steps,
        TeleoperationSettings(turns_with_view=not setup.steady),
    )
    try:
        return ("operation", operating.run(lambda steps: tell("progress", steps)))
    except Exception:
        tell("operation", operating.operation)
        raise


if __name__ == "__main__":
    # What crosses to the parent must be of this module's importable self, not of __main__.
    from surgbench.tasks.viewpoint import hand_worker

    serve_parent(hand_worker.run)
