"""One run of a viewpoint controller from its job to its record."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.randomness import generator
from surgbench.suite.child import Child, ChildProblemError
from surgbench.suite.head import head
from surgbench.suite.plan import Job
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.pictures import Pictures
from surgbench.viewpoint.plan import ViewpointSettings
from surgbench.viewpoint.scores import course_errors, depths, naive_violations
from surgbench.viewpoint.simulator import Course, make_scene
from surgbench.viewpoint.trial import Trial
from surgbench.viewpoint.worker import ViewpointSetup
from surgbench.viewpoint.workspace import NoGoZone

if TYPE_CHECKING:
    from surgbench.dataset.open import AnyDataset
    from surgbench.viewpoint.dataset import ViewpointDataset

WORKER = "surgbench.viewpoint.worker"
# Decimals of what a record keeps: nanometres and nanoradians, and a billionth of what errors are given in.
JOINT_DECIMALS, ERROR_DECIMALS = 9, 6


def execute_viewpoint(
    job: Job,
    dataset: AnyDataset,
    environment: dict[str, Any],
    advance: Callable[[float], None],
    children: set[Child],
    stopping: threading.Event,
) -> dict[str, Any]:
    """Run a job in a child process and measure how good the view was.

    Args:
        job: What to run.
        dataset: The dataset it is about.
        environment: Where it runs, for the record.
        advance: Called with the steps done since the last call.
        children: Holds the child while it lives, so that it can be stopped from outside.
        stopping: Set when the run is to end; then nothing new is begun.

    Returns:
        The record, whatever became of the run.

    Raises:
        DatasetError: The dataset itself is at fault.
    """
    settings = cast(ViewpointSettings, job.settings)
    trial = cast("ViewpointDataset", dataset).trial(job.unit.sequence)
    scene = make_scene(trial, registration=settings.registration, missing_face=settings.missing_face)
    axes: dict[str, str | int] = {
        "seed": settings.protocol.seed,
        "dataset": job.dataset_name,
        "unit": job.unit.id,
        "repeat": job.repeat,
        "tracker": settings.tracker.name,
    }
    status, error, trace = "ok", None, None
    course: Course | None = None
    child = Child(settings.protocol.timeout_s, WORKER)
    children.add(child)
    try:
        if stopping.is_set():
            raise ChildProblemError("failed", "stopped before it began")
        child.send("run", ViewpointSetup(settings.tracker, replace(trial, truth=None), scene, job.frames, axes))
        while course is None or len(course.goals) < job.frames:
            kind, content = child.receive()
            if kind == "progress":
                advance(content)
            else:
                course = content
    except ChildProblemError as problem:
        status, trace = problem.status, problem.traceback
        error = f"step {0 if course is None else len(course.goals)}: {problem}"
    finally:
        children.discard(child)
        child.stop()
    pictures = Pictures(settings.photographs_hz, generator(**axes, purpose="pictures"))
    return {
        **head(job, dataset, environment),
        "status": status,
        "error": error,
        "traceback": trace,
        **({"frames": {}, "errors": {}} if course is None else measure(course, trial, scene, pictures)),
    }


def measure(course: Course, trial: Trial, scene: ViewpointScene, pictures: Pictures) -> dict[str, Any]:
    """What a record keeps of a course: ``frames``, ``errors``."""
    count = len(course.goals)
    # With the whole zone, whatever the controller was told of it.
    zone = NoGoZone(scene.workspace.zone.points)
    rules_of = replace(scene, workspace=replace(scene.workspace, zone=zone))
    rules = naive_violations(trial, rules_of, count).stacked()
    frames = {
        "index": list(range(count)),
        "joints": np.round(course.joints[1:], JOINT_DECIMALS).tolist(),
        "setpoint": np.round(course.setpoints[1:], JOINT_DECIMALS).tolist(),
        "asked": course.asked.tolist(),
        "clipped": course.clipped.tolist(),
        "solver": course.solver.tolist(),
        "active": _bits(course.active),
        "rules": _bits(rules),
        "limit_violation": (~scene.arm.within_limits(course.setpoints[1:], 1e-9)).tolist(),
        **{name: np.round(one, JOINT_DECIMALS).tolist() for name, one in depths(course, trial, rules_of).items()},
        "latency_ms": _numbers(course.latency_ms),
        **pictures.pixels(course, trial, scene),
    }
    errors = {name: _numbers(values) for name, values in course_errors(course, trial, scene).items()}
    return {"frames": frames, "errors": errors}


def _bits(flags: Any) -> list[int]:
    """``(T, n)`` flags as one number each, the first flag the lowest bit."""
    return (np.asarray(flags) @ (1 << np.arange(np.shape(flags)[1]))).tolist()  # type: ignore[no-any-return]


def _numbers(values: FloatArray) -> list[float | None]:
    """Numbers with ``None`` for NaN, which JSON has not."""
    return [None if np.isnan(value) else round(value, ERROR_DECIMALS) for value in values.tolist()]
