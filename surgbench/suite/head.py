"""What every record says of its job, whatever the task."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from surgbench.report.records import RECORD_FORMAT, SKIPPED
from surgbench.suite.plan import Job

if TYPE_CHECKING:
    from surgbench.dataset.open import AnyDataset


def skipped(job: Job, dataset: AnyDataset, environment: dict[str, Any], reason: str) -> dict[str, Any]:
    """The record of a job that this machine cannot run, for ``reason``, one line."""
    return {
        **head(job, dataset, environment),
        "status": SKIPPED,
        "error": reason,
        "traceback": None,
        "initialise_s": None,
        "frames": {},
        "errors": {},
    }


def head(job: Job, dataset: AnyDataset, environment: dict[str, Any]) -> dict[str, Any]:
    """What a record says of its job."""
    return {
        "format": RECORD_FORMAT,
        "spec_hash": job.hash,
        "settings_hash": job.settings.hash,
        "variant": job.settings.variant,
        "floor": job.settings.floor,
        "spec": job.spec(),
        "references": job.settings.references,
        "environment": environment,
        "dataset_path": str(dataset.path.resolve()),
        "dataset_frames": job.dataset_frames,
        "unit_frames": job.frames,
    }
