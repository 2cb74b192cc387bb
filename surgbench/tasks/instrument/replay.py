"""Repeat a recorded run in this process to see the candidates that its tracker looked at."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from surgbench.contract import Trace, View
from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray
from surgbench.registry import create, find
from surgbench.suite.asked import Conditions
from surgbench.suite.plan import complete
from surgbench.suite.settings import Job
from surgbench.tasks.instrument.asked import InstrumentRow
from surgbench.tasks.instrument.dataset import InstrumentDataset, InstrumentUnit
from surgbench.tasks.instrument.execute import child_setup, true_states, unit_data
from surgbench.tasks.instrument.made_masks import MaskMaker, with_images_read
from surgbench.tasks.instrument.told_prompts import of_views
from surgbench.tasks.instrument.worker import Loop


def replay_traces(record: dict[str, Any], dataset: InstrumentDataset, frames: list[int]) -> dict[int, Trace]:
    """Candidates of some frames of a recorded run.

    The run is repeated from its record: the same options, seeds and recorded starts give the same samples, so
    that what is drawn is what the run looked at. Estimates are compared with the record to make sure.

    Args:
        record: A record's whole content.
        dataset: The dataset of the run.
        frames: Frame numbers.

    Returns:
        Frame number to its candidates; without the frames that the run did not reach.

    Raises:
        SurgbenchError: The dataset is another one, or the repeated run takes another course.
    """
    spec, recorded = record["spec"], record["frames"]
    if dataset.hash != spec["dataset"]["sha256"]:
        raise SurgbenchError(f"{dataset.path}: not the dataset of the run '{spec['row_id']}' (another hash)")
    job = recorded_job(record, dataset)
    data = unit_data(job, dataset)
    last = min(max(frames, default=-1), len(recorded["index"]) - 1)
    first = _first(recorded)
    if first is None or first > last:
        return {}  # no tracker was asked about these frames
    loop = Loop(child_setup(job, data, first))
    loop.begin(data.observation(first), _initial(record, first), true_states(job, data, first))
    traces: dict[int, Trace] = {}
    for frame in range(first, last + 1):
        trace = Trace() if frame in frames else None
        observation = data.observation(frame)
        answer = loop.step(observation, trace)
        if not np.array_equal(answer.state, recorded["state"][frame]):
            raise SurgbenchError(
                f"'{spec['row_id']}' {spec['unit']}: frame {frame} comes out differently now than when it was "
                "recorded (another version of surgbench, of a library, or another processor); run it again"
            )
        if trace is not None:
            traces[frame] = trace
    return traces


def made_masks(record: dict[str, Any], dataset: InstrumentDataset) -> Iterator[tuple[int, View]]:
    """The masks that a recorded run's mask source made, made again: no record holds them.

    Args:
        record: A record's whole content, of a run with a mask source.
        dataset: The dataset of the run.

    Yields:
        Frame numbers from where tracking began, and what the source made of the reference view.

    Raises:
        SurgbenchError: The source cannot run here, or breaks down.
    """
    job, recorded = recorded_job(record, dataset), record["frames"]
    data, frames = unit_data(job, dataset), len(recorded["index"])
    first = _first(recorded)
    if first is None:
        return
    setup = child_setup(job, data, first)
    source = setup.mask_source
    assert source is not None
    maker = MaskMaker(partial(create, find(source.kind, source.reference), source.options), source.name)
    for frame in range(first, frames):
        start = np.array(recorded["start"][frame])
        observation = with_images_read(replace(data.observation(frame), start=start))
        if frame == first:
            known = _initial(record, first) if setup.initialiser.needs_truth else None
            maker.reset(setup.scene, observation, of_views(setup.prompts, setup.scene, observation, known))
        yield frame, maker.make(observation).observation.views[0]


def _first(recorded: dict[str, Any]) -> int | None:
    """The frame that tracking began with: the first that took a tracker's time; ``None`` where none did."""
    return next((frame for frame, took in enumerate(recorded["latency_ms"]) if took is not None), None)


def _initial(record: dict[str, Any], first: int) -> FloatArray:
    """The state that tracking began with; of runs on the dataset's masks, with the joints of its readings."""
    return np.array(record.get("initial_state") or record["frames"]["start"][first])


def recorded_job(record: dict[str, Any], dataset: InstrumentDataset) -> Job:
    """The job that a record's specification describes."""
    spec, references = record["spec"], record["references"]
    plugs = [spec[kind] for kind in ("tracker", "initialiser", "filter", "keypoints", "mask_source") if kind in spec]
    row = InstrumentRow(
        tracker=references["tracker"],
        row_id=spec["row_id"],
        initialiser=references["initialiser"],
        filter=references["filter"],
        keypoints=references["keypoints"],
        readings=spec["readings"],
        view=spec.get("view"),
        masks=references.get("mask_source", spec.get("masks", "union")),
        scored=spec.get("scored", "raw"),
        options={plug["name"]: plug["options"] for plug in plugs if plug["options"]},
        frames=spec.get("frames_limit"),
        told_prompts=spec.get("prompts", {}),
    )
    conditions = Conditions(
        arms="single" if len(spec["arms"]) == 1 else "dual", seed=spec["seed"], device=spec.get("device", "cpu")
    )
    unit = InstrumentUnit(spec["unit"], spec["sequence"], tuple(spec["arms"]), spec["mask_kind"])
    frames, everything = record["unit_frames"], record.get("dataset_frames", 0)
    return Job(complete(row, conditions, dataset), dataset.name, dataset.hash, unit, frames, everything, spec["repeat"])
