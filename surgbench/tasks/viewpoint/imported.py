"""Writes recorded trials as a dataset: all of them or nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from surgbench.dataset.manifest import MANIFEST_NAME, FileEntry, dataset_name
from surgbench.dataset.storage import new_folder
from surgbench.dataset.writer import write_files
from surgbench.errors import DatasetError
from surgbench.tasks.viewpoint.dataset import entry_problems, reach_problems
from surgbench.tasks.viewpoint.format import ViewpointManifest
from surgbench.tasks.viewpoint.writing import describe_trial, encode_trial
from surgbench.version import __version__
from surgbench.viewpoint.arm_files import CameraArmSpec, unless_default
from surgbench.viewpoint.trial import Trial


def write_trials(
    out: Path,
    trials: Sequence[Trial],
    *,
    name: str,
    configuration: Mapping[str, Any],
    camera_arm: CameraArmSpec | None,
) -> None:
    """Write trials as a dataset.

    Args:
        out: Its folder: new or empty. It appears when all is written.
        trials: In order, with one camera arm.
        name: Of the dataset; what cannot stand in a name is replaced.
        configuration: The importer and its options.
        camera_arm: What the trials' arm was made of.

    Raises:
        DatasetError: A trial cannot be: its zone is none, its arm starts outside of its limits or sees nothing; one
            line.
        SurgbenchError: ``out`` holds something, or the disk is full; one line.
    """
    entries = [describe_trial(trial, "custom") for trial in trials]
    for trial, entry in zip(trials, entries, strict=True):
        problems = entry_problems(out, entry, trial.arm)
        for problem in problems or reach_problems(out, entry, trial.arm, trial.T_world_feature):
            raise DatasetError(problem)
    with new_folder(out) as scratch:
        files: dict[str, FileEntry] = {}
        for trial in trials:
            files |= write_files(scratch, encode_trial(trial))
        manifest = ViewpointManifest(
            name=dataset_name(name),
            created_by=f"surgbench {__version__}",
            origin="imported",
            configuration=dict(configuration),
            trials=tuple(entries),
            camera_arm=unless_default(camera_arm),
            files=files,
        )
        (scratch / MANIFEST_NAME).write_bytes(manifest.to_bytes())
