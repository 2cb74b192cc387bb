"""One run in which a simulated hand leads the ring, from its job to its record."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from surgbench.geometry import rotation_vector
from surgbench.processes.child import ChildProblemError
from surgbench.randomness import generator
from surgbench.suite.running import Run
from surgbench.suite.settings import Job
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.tasks.viewpoint.execute import ERROR_DECIMALS, JOINT_DECIMALS, measure
from surgbench.tasks.viewpoint.hand_worker import HandSetup
from surgbench.tasks.viewpoint.pictures import Pictures
from surgbench.tasks.viewpoint.plan import ViewpointSettings
from surgbench.tasks.viewpoint.worker import ViewpointSetup
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.hand.operation import Operation, check_operable
from surgbench.viewpoint.hand.performance import performance
from surgbench.viewpoint.hand.person import People, draw_person
from surgbench.viewpoint.simulator import make_scene

WORKER = "surgbench.tasks.viewpoint.hand_worker"


def execute_with_hand(job: Job, dataset: ViewpointDataset, run: Run) -> dict[str, Any]:
    """Run a job in a child process; see :meth:`surgbench.task.Task.execute`.

    Repeats are people: the same one for all trials, conditions and controllers. What the noise of a trial depends on is
    the person and the trial alone, so that conditions can be compared run by run.
    """
    settings = cast(ViewpointSettings, job.settings)
    assert settings.hand is not None
    trial = dataset.trial(job.unit.sequence)
    check_operable(trial)
    scene = make_scene(trial, registration=settings.registration, missing_face=settings.missing_face)
    people: dict[str, str | int] = {"seed": settings.conditions.seed, "person": job.repeat}
    trials: dict[str, str | int] = {**people, "dataset": job.dataset_name, "unit": job.unit.id}
    axes: dict[str, str | int] = {**trials, "tracker": settings.tracker.name}
    setup = HandSetup(
        ViewpointSetup(settings.tracker, trial, scene, scene.servo_lag_s, job.frames, axes),
        settings.hand,
        settings.steady,
        draw_person(People(), generator(**people, purpose="who")),
        {**trials, "purpose": "hand"},
        None if settings.frames_limit is None else job.frames,
    )
    status, error, trace = "ok", None, None
    operation: Operation | None = None
    try:
        with run.child(WORKER, settings.conditions.timeout_s, settings.conditions.memory) as child:
            child.send(setup)
            child.ready()
            left = float(job.frames)
            while operation is None:
                kind, content = child.receive()
                if kind == "progress":
                    # How long it will take is not known beforehand: no longer than the trial's own hand, for the bar.
                    run.advance(min(left, content))
                    left -= min(left, content)
                else:
                    operation = content
            # A controller that failed says so after what was done until then.
            if operation.ended is None and len(operation.pressed_m) < setup.longest:
                child.receive()
    except ChildProblemError as problem:
        status, trace = problem.status, problem.traceback
        error = f"step {0 if operation is None else len(operation.pressed_m)}: {problem}"
    ended = {"status": status, "error": error, "traceback": trace, "dt_s": trial.dt_s}
    if operation is None:
        return {**ended, "frames": {}, "errors": {}}
    pictures = Pictures(settings.photographs_hz, generator(**axes, purpose="pictures"))
    return {**ended, **measure_hand(operation, scene, pictures)}


def measure_hand(operation: Operation, scene: ViewpointScene, pictures: Pictures) -> dict[str, Any]:
    """What a record keeps: that of the camera, and of the hand's work."""
    truth = operation.trial.truth
    assert truth is not None
    kept = measure(operation.course, operation.trial, scene, pictures)
    poses = truth.T_world_feature
    ring = np.hstack([rotation_vector(poses[:, :3, :3]), poses[:, :3, 3]])
    kept["frames"] |= {
        "ring": np.round(ring, JOINT_DECIMALS).tolist(),
        "contact": (operation.pressed_m >= 0).tolist(),
        "sight": operation.sight.tolist(),
    }
    values = performance(operation, scene.dt_s)
    kept["errors"] |= {name: [None if np.isnan(one) else round(one, ERROR_DECIMALS)] for name, one in values.items()}
    return kept
