"""Records as the suite writes them, made up for tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from surgbench.files import short_hash
from surgbench.records.format import RECORD_FORMAT
from surgbench.records.seal import sealed


def record(
    row_id: str = "cmaes",
    unit: str = "000-left",
    repeat: int = 0,
    frames: int = 4,
    truth: bool = True,
    dataset: tuple[str, str] = ("mini", "ab" * 32),
    **changes: Any,
) -> dict[str, Any]:
    """A sound record whose errors grow with the frame: rotation 0.1, 0.2, ...; everything else derived from it."""
    sequence, _, arm = unit.partition("-")
    arms = [arm] if arm else ["left", "right"]
    step = [0.1 * (frame + 1) for frame in range(frames)]
    spec = {
        "task": "instrument",
        "dataset": {"name": dataset[0], "sha256": dataset[1]},
        "unit": unit,
        "sequence": sequence,
        "arms": arms,
        "mask_kind": arm or "both",
        "row_id": row_id,
        "tracker": {"name": "cmaes", "options": {"iterations": 3, "population": 70}, "source": "builtin"},
        "initialiser": {"name": "truth" if truth else "random", "options": {}},
        "filter": {"name": "kalman", "options": {}},
        "keypoints": {"name": "dataset", "options": {}},
        "readings": "none",
        "seed": 0,
        "repeat": repeat,
        "timeout_s": 60.0,
    }
    per_arm = {
        "rotation_error_rad": 1.0,
        "translation_error_m": 0.01,
        "tip_error_m": 0.02,
        "q1_error_rad": 0.5,
        "q2_error_rad": 0.25,
        "q3_error_rad": 0.125,
        "keypoint_error_px": 10.0,
    }
    errors: dict[str, Any] = {
        key: [[value * scale] * len(arms) for value in step] if truth else None for key, scale in per_arm.items()
    }
    errors["mask_error"] = [value / 5 for value in step]
    errors["mask_error_true"] = [value / 10 for value in step] if truth else None
    errors["jitter"] = [0.5] * len(arms)
    not_settings = ("unit", "sequence", "arms", "mask_kind", "repeat", "dataset")
    settings = {key: value for key, value in spec.items() if key not in not_settings}
    content = {
        "format": RECORD_FORMAT,
        "spec_hash": short_hash(spec),
        "spec": spec,
        "settings_hash": short_hash(settings),
        "variant": f"none/{'truth' if truth else 'random'} kalman",
        "status": "ok",
        "error": None,
        "traceback": None,
        "environment": {"python": "3.11"},
        "dataset_path": "/somewhere/mini",
        "initialise_s": 1.2,
        "unit_frames": frames,
        "frames": {
            "index": list(range(frames)),
            "state": [[0.0, 0.1, 0.2, 0.0, 0.0, 0.15, 0.1, 0.2, 0.3] * len(arms)] * frames,
            "start": [[0.0, 0.1, 0.2, 0.0, 0.0, 0.15, 0.1, 0.2, 0.3] * len(arms)] * frames,
            "confidence": [1.0] * frames,
            "lost": [False] * (frames - 1) + [True],
            "latency_ms": [10.0 + frame for frame in range(frames)],
            "latency_optimise_ms": [8.0 + frame for frame in range(frames)],
            "latency_keypoints_ms": [None] * frames,
            "latency_masks_ms": [2.0] * frames,
        },
        "errors": errors,
    }
    return {**content, **changes}


def with_seed(seed: int, content: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """The same run with another seed, and so of other settings."""
    return content | {"spec": content["spec"] | {"seed": seed}, "settings_hash": f"{seed}" * 16} | changes


def failed(**axes: Any) -> dict[str, Any]:
    """A record of a tracker that raised before its first frame."""
    return record(**axes) | {
        "status": "failed",
        "error": "ValueError: step | returned (3,)",
        "frames": None,
        "errors": None,
    }


def as_written(content: dict[str, Any]) -> dict[str, Any]:
    """A record with the hashes that fit its content."""
    return sealed(content | {"spec_hash": short_hash(content["spec"])})


def write(folder: Path, *records: dict[str, Any]) -> Path:
    """Write records where the suite does, hashed and sealed: ``<row folder>/<unit>-r<repeat>.json``."""
    for content in records:
        spec = content["spec"]
        path = folder / f"{spec['row_id']}-{content['settings_hash'][:6]}" / f"{spec['unit']}-r{spec['repeat']}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(as_written(content)), encoding="utf-8")
    return folder
