"""Trials as files, and what the manifest says of them: for generators and importers."""

from __future__ import annotations

import numpy as np

from surgbench.dataset import tables
from surgbench.dataset.manifest import observations_path
from surgbench.files import canonical_json
from surgbench.geometry import FloatArray
from surgbench.tasks.viewpoint.dataset import pose_columns
from surgbench.tasks.viewpoint.format import (
    CONTACT,
    SceneTruth,
    TouchEntry,
    TrialEntry,
    WireEntry,
    feature_path,
    scene_path,
)
from surgbench.viewpoint.trial import Trial


def encode_trial(trial: Trial) -> dict[str, bytes]:
    """A trial's files, by their place in the dataset."""
    files = {
        observations_path(trial.id): tables.encode_table(
            {tables.TIMESTAMP: trial.timestamps_s, **pose_columns(trial.T_world_feature)}
        )
    }
    truth = trial.truth
    if truth is not None:
        contact = {CONTACT: truth.contact.astype(np.float64)}
        files[feature_path(trial.id)] = tables.encode_table({**pose_columns(truth.T_world_feature), **contact})
        wire = truth.wire
        scene = SceneTruth(
            T_world_base=_numbers(truth.T_world_base),
            wire=None
            if wire is None
            else WireEntry(
                points_m=_points(wire.points_m),
                radius_m=wire.radius_m,
                ring_radius_m=wire.ring_radius_m,
                tube_radius_m=wire.tube_radius_m,
            ),
        )
        files[scene_path(trial.id)] = canonical_json(scene.model_dump(mode="json")).encode()
    return files


def describe_trial(trial: Trial, level: str) -> TrialEntry:
    """A trial's part of the manifest."""
    content = {
        "id": trial.id,
        "samples": len(trial.timestamps_s),
        "dt_s": trial.dt_s,
        "level": level,
        "truth": trial.truth is not None,
        "T_world_base": _numbers(trial.T_world_base),
        "touches": TouchEntry(world_m=_points(trial.touches.world_m), base_m=_points(trial.touches.base_m)),
        "zone_m": _points(trial.zone_m),
        "start": _numbers(trial.start),
        "distance_m": trial.distance_m,
        "floor_m": trial.floor_m,
        "proximity_m": trial.proximity_m,
        "preferred_side": trial.preferred_side,
    }
    return TrialEntry.model_validate(content)


def _numbers(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(value) for value in np.ravel(values))


def _points(values: FloatArray) -> tuple[tuple[float, float, float], ...]:
    return tuple((float(x), float(y), float(z)) for x, y, z in values)
