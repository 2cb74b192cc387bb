"""What every record says of its job, whatever the task."""

from __future__ import annotations

from typing import Any

from surgbench.dataset.base import Dataset
from surgbench.records.format import RECORD_FORMAT, SKIPPED
from surgbench.suite.environment import environment
from surgbench.suite.settings import Job


def head(job: Job, dataset: Dataset[Any]) -> dict[str, Any]:
    """What a record says of its job, known before it is done."""
    return {
        "format": RECORD_FORMAT,
        "spec_hash": job.hash,
        "settings_hash": job.settings.hash,
        "variant": job.settings.variant,
        "floor": job.settings.floor,
        "spec": job.spec(),
        "references": job.settings.references,
        "dataset_path": str(dataset.path.resolve()),
        "dataset_frames": job.dataset_frames,
        "unit_frames": job.frames,
    }


def skipped(reason: str) -> dict[str, Any]:
    """What a record says of a job that this machine cannot run, for ``reason``, one line."""
    return without_results(SKIPPED, reason)


def without_results(status: str, reason: str) -> dict[str, Any]:
    """What a record says of a job that nothing is known of but how it ended, and why, one line."""
    return {
        "environment": environment(),
        "calibration_ms": None,
        "status": status,
        "error": reason,
        "traceback": None,
        "initialise_s": None,
        "frames": {},
        "errors": {},
    }
