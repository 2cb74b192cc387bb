"""The errors of a record's estimates, measured once more: its plug-ins need not be there."""

from __future__ import annotations

from typing import Any

import numpy as np

from surgbench.contract import Observation
from surgbench.suite.asked import Conditions
from surgbench.suite.running import Run
from surgbench.suite.settings import Job, Plug
from surgbench.tasks.instrument.answered import AnsweredRun
from surgbench.tasks.instrument.dataset import InstrumentDataset, InstrumentUnit
from surgbench.tasks.instrument.execute import execute
from surgbench.tasks.instrument.plan import InstrumentSettings
from surgbench.tasks.instrument.records import ANSWER_COLUMNS, ARM_COLUMNS, SOURCE_ERROR

# Errors that look at the masks which the tracker saw: where a source made them, no record holds them.
_OF_MADE_MASKS = ("mask_error", SOURCE_ERROR)


def rescore(record: dict[str, Any], dataset: InstrumentDataset, run: Run) -> dict[str, Any]:
    """Measure a record's estimates.

    Args:
        record: Its whole content.
        dataset: What they were made on.
        run: Is told how far it is.

    Returns:
        Names of errors to their values, as in the record; without those that cannot be measured of a record.
    """
    spec, frames = record["spec"], record["frames"]
    source = spec.get("mask_source")
    entry = next((one.entry for one in dataset.sequences if one.id == spec["sequence"]), None)
    if not frames.get("index") or (source is not None and entry is not None and not entry.truth):
        return {}  # without truth there are but the masks
    settings = InstrumentSettings(
        row_id=spec["row_id"],
        tracker=_plug("tracker", spec),
        conditions=Conditions(arms="single" if len(spec["arms"]) == 1 else "dual", seed=spec["seed"]),
        sequences=None,
        frames_limit=None,
        initialiser=_plug("initialiser", spec),
        filter=_plug("filter", spec),
        keypoints=_plug("keypoints", spec),
        readings=spec["readings"],
        masks=spec.get("masks", "union"),
        scored=spec.get("scored", "raw"),
    )
    unit = InstrumentUnit(spec["unit"], spec["sequence"], tuple(spec["arms"]), spec["mask_kind"])
    job = Job(settings, dataset.name, dataset.hash, unit, len(frames["index"]), 0, spec["repeat"])
    names = [name for name in (*ANSWER_COLUMNS, *ARM_COLUMNS) if frames.get(name)]

    def step(observation: Observation) -> dict[str, Any]:
        told = {name: frames[name][observation.index] for name in names}
        return {name: np.array(value) if isinstance(value, list) else value for name, value in told.items()}

    done = execute(job, dataset, AnsweredRun(run, np.array(frames["state"][0]), step), waits=False)
    errors = {name: values for name, values in done["errors"].items() if source is None or name not in _OF_MADE_MASKS}
    # Where estimates came from a file, nobody knows where a search began.
    return errors if frames.get("start") else {**errors, "start_lag_ms": None}


def _plug(kind: str, spec: dict[str, Any]) -> Plug:
    return Plug(kind, spec[kind]["name"], spec[kind]["name"], "", {}, {}, False)
