"""What is wrong with a recorded course of the camera, measured once more, and the job that a record describes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray
from surgbench.randomness import generator
from surgbench.suite.asked import Conditions
from surgbench.suite.plan import complete
from surgbench.suite.running import Run
from surgbench.suite.settings import Job
from surgbench.tasks.viewpoint.asked import ViewpointRow
from surgbench.tasks.viewpoint.dataset import TrialUnit, ViewpointDataset
from surgbench.tasks.viewpoint.execute import measure
from surgbench.tasks.viewpoint.pictures import Pictures
from surgbench.viewpoint.disturbance import Disturbance, displace_base
from surgbench.viewpoint.placement import CONSTRAINTS
from surgbench.viewpoint.simulator import Course, make_scene


def recorded_job(record: dict[str, Any], dataset: ViewpointDataset) -> Job:
    """The job that a record's specification describes; see :meth:`surgbench.task.Task.recorded_job`."""
    spec = record["spec"]
    row = ViewpointRow(
        tracker=record["references"]["tracker"],
        row_id=spec["row_id"],
        options={spec["tracker"]["name"]: spec["tracker"]["options"]} if spec["tracker"]["options"] else {},
        frames=spec.get("frames_limit"),
        registration=spec["registration"],
        missing_face=spec["missing_face"],
        photographs_hz=spec.get("photographs_hz", 0.0),
        hand=spec.get("hand"),
        steady=spec.get("steady", False),
        **spec.get("disturbance", {}),
    )
    settings = complete(row, Conditions(seed=spec["seed"]), dataset)
    frames, everything = record["unit_frames"], record.get("dataset_frames") or 0
    return Job(settings, dataset.name, dataset.hash, TrialUnit(spec["unit"]), frames, everything, spec["repeat"])


def rescore(record: dict[str, Any], dataset: ViewpointDataset, run: Run) -> dict[str, Any]:
    """Measure a recorded course; see :meth:`surgbench.task.Task.rescore`.

    Raises:
        ConfigError: A simulated hand led the feature: where to is part of what was measured.
    """
    spec, frames = record["spec"], record["frames"]
    if spec.get("hand") is not None:
        raise ConfigError("runs with a simulated hand cannot be scored again")
    count = len(frames.get("index", []))
    if not count:
        return {}
    trial = dataset.trial(spec["unit"])
    world = {"seed": spec["seed"], "dataset": dataset.name, "unit": spec["unit"], "repeat": spec["repeat"]}
    scene = make_scene(trial, registration=spec["registration"], missing_face=spec["missing_face"])
    scene = displace_base(scene, Disturbance(**spec.get("disturbance", {})), world)

    def course_of(name: str) -> FloatArray:
        return np.vstack([trial.start, np.array(frames[name], dtype=np.float64)])

    course = Course(
        joints=course_of("joints"),
        setpoints=course_of("setpoint"),
        goals=np.array(frames["setpoint"], dtype=np.float64),
        clipped=np.array(frames["clipped"], dtype=bool),
        asked=np.array(frames["asked"], dtype=bool),
        active=_flags(frames["active"]),
        solver=np.array(frames["solver"], dtype=bool),
        latency_ms=np.array(frames["latency_ms"], dtype=np.float64),
    )
    errors: dict[str, Any] = measure(course, trial, scene, Pictures(0.0, generator(**world)))["errors"]
    run.advance(count)
    return errors


def _flags(bits: list[int]) -> NDArray[np.bool_]:
    """``(T, 5)`` of one number each, the first flag the lowest bit."""
    return np.array([[bool(one >> place & 1) for place in range(len(CONSTRAINTS))] for one in bits], dtype=bool)
