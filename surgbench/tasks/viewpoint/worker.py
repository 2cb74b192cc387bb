"""The child process of a trial: controller and simulator close their loop in here.

It is given the trial without its truth, and answers with the course.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from surgbench.processes.service import Tell, serve_parent
from surgbench.randomness import generator
from surgbench.registry import create, find
from surgbench.suite.settings import Plug
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.simulator import Controller, Simulation
from surgbench.viewpoint.trial import Trial

# Steps that a throw-away controller takes, spread over the trial, so that compilation belongs to nobody's latency.
WARM_STEPS = 40


@dataclass(frozen=True)
class ViewpointSetup:
    """What a child is told.

    Attributes:
        tracker: The controller with its options.
        trial: Without truth.
        scene: Its constants, as the controller is told them.
        servo_lag_s: Time constant that the joints really have.
        steps: How many of the trial's are run.
        axes: Named axes that seed the controller's generator.
    """

    tracker: Plug
    trial: Trial
    scene: ViewpointScene
    servo_lag_s: float
    steps: int
    axes: dict[str, str | int]


def warm_up(setup: ViewpointSetup) -> None:
    """Run a throw-away controller over a few samples from all over the trial."""
    trial, count = setup.trial, len(setup.trial.timestamps_s)
    chosen = np.unique(np.linspace(0, count - 1, min(WARM_STEPS, count)).astype(int))
    short = Trial(
        trial.id, trial.dt_s, trial.timestamps_s[: len(chosen)], trial.T_world_feature[chosen], trial.T_world_base,
        trial.touches, trial.zone_m, trial.start,
    )  # fmt: skip
    Simulation(_controller(setup), short, setup.scene, generator(**setup.axes)).run()


def _controller(setup: ViewpointSetup) -> Controller:
    controller: Controller = create(find("tracker", setup.tracker.reference), setup.tracker.options)
    return controller


def run(tell: Tell, setup: ViewpointSetup) -> tuple[Any, ...]:
    """The course of a trial.

    Tells ``("ready",)``, ``("progress", steps)``, what was done before a problem, and ``("held", (status, line))``
    where the arm came to rest for want of commands.
    """
    found = find("tracker", setup.tracker.reference)
    tell("ready")  # everything is imported
    if not getattr(found.cls, "elsewhere", False):
        with contextlib.suppress(Exception):  # what is wrong with it will show again
            warm_up(setup)
    controller, axes = _controller(setup), generator(**setup.axes)
    simulation = Simulation(controller, setup.trial, setup.scene, axes, setup.steps, setup.servo_lag_s)
    try:
        course = simulation.run(lambda steps: tell("progress", steps))
    except Exception:
        tell("course", simulation.course)
        raise
    held = getattr(controller, "held", None)
    if held is not None:
        tell("held", held)
    return ("course", course)


if __name__ == "__main__":
    # What crosses to the parent must be of this module's importable self, not of __main__.
    from surgbench.tasks.viewpoint import worker

    serve_parent(worker.run)
