"""One run of a viewpoint controller from its job to its record."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.processes.child import ChildProblemError
from surgbench.randomness import generator
from surgbench.suite.running import Run
from surgbench.suite.settings import Job
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.tasks.viewpoint.pictures import Pictures
from surgbench.tasks.viewpoint.plan import ViewpointSettings
from surgbench.tasks.viewpoint.worker import ViewpointSetup
from surgbench.viewpoint.avoidable import PLACE_RULES, TOLERANCE_M, Of, broken_m, unavoidable
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.disturbance import displace_base, disturb_trial, mislead
from surgbench.viewpoint.placement import CONSTRAINTS
from surgbench.viewpoint.rules import TWINS, depth_name, reported_depths, true_depths
from surgbench.viewpoint.scores import course_errors, naive_violations
from surgbench.viewpoint.simulator import Course, make_scene
from surgbench.viewpoint.trial import Trial
from surgbench.viewpoint.workspace import NoGoZone

WORKER = "surgbench.tasks.viewpoint.worker"
# Decimals of what a record keeps: nanometres and nanoradians, and a billionth of what errors are given in.
JOINT_DECIMALS, ERROR_DECIMALS = 9, 6


def execute(job: Job, dataset: ViewpointDataset, run: Run) -> dict[str, Any]:
    """Run a job in a child process and measure how good the view was; see :meth:`surgbench.task.Task.execute`."""
    settings = cast(ViewpointSettings, job.settings)
    trial = dataset.trial(job.unit.sequence)
    scene = make_scene(trial, registration=settings.registration, missing_face=settings.missing_face)
    world: dict[str, str | int] = {
        "seed": settings.conditions.seed,
        "dataset": job.dataset_name,
        "unit": job.unit.id,
        "repeat": job.repeat,
    }
    axes = {**world, "tracker": settings.tracker.name}
    # Drawn without the controller's name: all are disturbed alike. Errors are those against ``trial``.
    scene = displace_base(scene, settings.disturbance, world)
    shown = replace(disturb_trial(trial, settings.disturbance, world), truth=None)
    told = mislead(scene, settings.disturbance)
    status, error, trace = "ok", None, None
    course: Course | None = None
    try:
        with run.child(WORKER, settings.conditions.timeout_s, settings.conditions.memory) as child:
            child.send(ViewpointSetup(settings.tracker, shown, told, scene.servo_lag_s, job.frames, axes))
            child.ready()
            while course is None or len(course.goals) < job.frames:
                kind, content = child.receive()
                if kind == "progress":
                    run.advance(content)
                elif kind == "held":
                    status, error = content
                else:
                    course = content
    except ChildProblemError as problem:
        status, trace = problem.status, problem.traceback
        error = f"step {0 if course is None else len(course.goals)}: {problem}"
    pictures = Pictures(settings.photographs_hz, generator(**axes, purpose="pictures"))
    return {
        "status": status,
        "error": error,
        "traceback": trace,
        "dt_s": trial.dt_s,
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
        **{
            depth_name(rule, twin): _numbers(depth)
            for twin, depths in zip(TWINS, (reported_depths, true_depths), strict=True)
            for rule, depth in depths(course, trial, rules_of).items()
        },
        "unavoidable": _bits(_unavoidable(course, trial, rules_of)),
        "latency_ms": _numbers(course.latency_ms),
        **pictures.pixels(course, trial, scene),
    }
    errors = {name: _numbers(values) for name, values in course_errors(course, trial, scene).items()}
    return {"frames": frames, "errors": errors}


def _unavoidable(course: Course, trial: Trial, scene: ViewpointScene) -> NDArray[np.bool_]:
    """``(T, 5)`` which rules no motion could have kept after each step.

    Joints and set points are both judged (:func:`surgbench.viewpoint.rules.reported_depths`); each has to be excused
    where it breaks a rule. After the last step the feature is not known anew, and nothing is excused.
    """
    flags = np.zeros((len(course.goals), len(CONSTRAINTS)), dtype=bool)
    features = trial.T_world_feature[: len(course.goals), :3, 3]
    for rule in PLACE_RULES:
        excused, beyond = np.ones(len(flags), dtype=bool), np.zeros(len(flags), dtype=bool)
        for of, joints in (("joints", course.joints), ("setpoints", course.setpoints)):
            place = (scene.T_world_base @ scene.arm.forward(joints[:-1]))[:, :3, 3]
            depth = broken_m(place, features, scene)[rule]
            broken = np.nan_to_num(depth, nan=-1.0) > TOLERANCE_M
            if broken.any():
                excused &= unavoidable(course, trial, scene, rule, of=cast(Of, of)) | ~broken
                beyond |= broken
        # Sample k is after step k - 1.
        flags[:-1, CONSTRAINTS.index(rule)] = (excused & beyond)[1:]
    return flags


def _bits(flags: Any) -> list[int]:
    """``(T, n)`` flags as one number each, the first flag the lowest bit."""
    return (np.asarray(flags) @ (1 << np.arange(np.shape(flags)[1]))).tolist()  # type: ignore[no-any-return]


def _numbers(values: FloatArray) -> list[float | None]:
    """Numbers with ``None`` for NaN, which JSON has not."""
    return [None if np.isnan(value) else round(value, ERROR_DECIMALS) for value in values.tolist()]
