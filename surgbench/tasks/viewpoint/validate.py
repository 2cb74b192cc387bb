"""Checks a dataset of the viewpoint task against its manifest, its format and common sense."""

from __future__ import annotations

from collections.abc import Callable

from surgbench.dataset.integrity import check_files
from surgbench.dataset.manifest import observations_path
from surgbench.dataset.masks import read_bytes
from surgbench.errors import DatasetError
from surgbench.tasks.viewpoint.dataset import (
    ViewpointDataset,
    entry_problems,
    reach_problems,
    read_feature,
    read_observations,
    read_scene,
    trial_files,
)
from surgbench.tasks.viewpoint.format import feature_path, scene_path


def validate(dataset: ViewpointDataset, progress: Callable[[float], None] = lambda files: None) -> list[str]:
    """Find everything that is wrong with a dataset; see :func:`surgbench.dataset.validate.validate`."""
    root, manifest = dataset.path, dataset.manifest
    expected = {file for entry in manifest.trials for file in trial_files(entry)}
    problems, sound = check_files(root, manifest, expected, progress=progress)
    for entry in manifest.trials:
        problems += entry_problems(root, entry, dataset.arm)
        for file in trial_files(entry):
            if file not in sound:
                continue
            data = read_bytes(root / file)
            try:
                if file == observations_path(entry.id):
                    poses, _, found = read_observations(root, entry, data)
                    problems += found or reach_problems(root, entry, dataset.arm, poses)
                elif file == feature_path(entry.id):
                    problems += read_feature(root, entry, data)[2]
                elif file == scene_path(entry.id):
                    read_scene(root, entry, data)
            except DatasetError as error:
                problems.append(str(error))
    return problems
