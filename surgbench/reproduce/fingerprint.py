"""What is kept of a record beside a table: hashes that a rerun elsewhere compares with, the first frames in short."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from surgbench.files import canonical_json, sha256_text
from surgbench.geometry import FloatArray
from surgbench.records.seal import SEAL
from surgbench.reproduce.sheet import Sheet

# What differs from machine to machine, or from one run to the next, though the estimates are the same.
_VOLATILE = (
    "environment",
    "dataset_path",
    "references",
    "initialise_s",
    "elapsed_s",
    "traceback",
    "calibration_ms",
    SEAL,
)
_VOLATILE_FRAMES = "latency_"


def record_sha256(record: dict[str, Any]) -> str:
    """SHA-256 of a record's canonical JSON without times, machine, versions and paths."""
    kept = {key: value for key, value in record.items() if key not in _VOLATILE}
    frames = record["frames"] or {}
    kept["frames"] = {key: value for key, value in frames.items() if not key.startswith(_VOLATILE_FRAMES)}
    return sha256_text(canonical_json(kept))


def head(record: dict[str, Any], frames: int, sheet: Sheet) -> dict[str, Any]:
    """A record's first frames in short.

    Args:
        record: A record's whole content.
        frames: How many frames at most.
        sheet: Of its task.

    Returns:
        ``frames`` (how many there are), ``states_sha256`` (of the estimates as little-endian float64, frame
        by frame), ``last`` (the last of these), ``errors`` (those of ``sheet.no_difference`` to mean and
        standard deviation over the frames, to six digits; without those that the record has not).
    """
    found = record["frames"] or {}
    columns = [found.get(sheet.estimates, []), *filter(None, map(found.get, sheet.further_estimates))]
    states = np.concatenate([np.array(column, dtype="<f8")[:frames] for column in columns], axis=-1)
    errors = {}
    for name in sheet.no_difference:
        values = np.array((record["errors"] or {}).get(name) or [], dtype=np.float64)[:frames]
        values = values[~np.isnan(values)]
        if values.size:
            errors[name] = [_short(values.mean()), _short(values.std())]
    return {
        "frames": len(states),
        "states_sha256": hashlib.sha256(states.tobytes()).hexdigest(),
        "last": states[-1].tolist() if len(states) else [],
        "errors": errors,
    }


def largest_deviation(recorded: list[float], found: list[float]) -> float:
    """The largest difference of two states in any component, radians and metres alike."""
    difference: FloatArray = np.abs(np.subtract(recorded, found))
    return float(difference.max())


def _short(value: float) -> float:
    return float(f"{value:.6g}")
