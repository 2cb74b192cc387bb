"""What must not change when code is moved: settings of all tables' rows, bytes of datasets, estimates of all trackers.

    python tests/golden.py FILE.json

writes it down; run before and after a change on one machine, the two files are the same. ``tests/golden.json`` is the
committed one; the test compares settings and datasets exactly, estimates within a tolerance.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas
from commandline import records, surgbench

from surgbench.config import packaged_names
from surgbench.dataset.open import open_dataset
from surgbench.errors import ConfigError
from surgbench.files import canonical_json, sha256_file, sha256_text
from surgbench.registry import discover
from surgbench.reproduce.load import load_table
from surgbench.reproduce.table import DatasetRequest, ImportRequest
from surgbench.suite.environment import environment
from surgbench.suite.plan import complete

FRAMES, SAMPLES = 3, 100
# A controller may take another turn later on another processor (docs/dataset.md).
STEPS = 50
# Hashes are of a plug-in's text and of the engine's, which may change: names and options may not.
SOURCE_HASH, ENGINE = "@", "engine"


def settings_hashes(data: Path) -> dict[str, str]:
    """Table and row to a hash of the row's settings, without those of texts."""
    found = {}
    for name in packaged_names("tables"):
        for block in load_table(name).table.blocks:
            if isinstance(block.dataset, ImportRequest):  # recordings that only some have
                continue
            dataset = open_dataset(_small(block.dataset, data))
            for row in block.rows:
                spec = complete(row.asked(quick=False), block.conditions, dataset).spec()
                found[f"{name}/{block.name}/{row.id}"] = sha256_text(canonical_json(_without_sources(spec)))[:16]
    return found


def _small(asked: DatasetRequest, data: Path) -> Path:
    """A frame of the preset of a block's dataset, made once, whatever is put over it: enough to complete its rows."""
    folder = data / asked.preset
    if not folder.exists():
        frames = SAMPLES if asked.preset.startswith("wire") else FRAMES
        # In this process: another one takes longer to start than to make so little.
        # Images are rendered small: of them too it is only asked whether they are there.
        small = ("--set", _SMALL_CAMERA, "--set", "images.samples=1") if asked.preset in _WITH_IMAGES else ()
        surgbench("generate", asked.preset, "--sequences", 1, "--frames", frames, "--jobs", 1, *small, "--out", folder)
    return folder


def _without_sources(spec: Any) -> Any:
    if not isinstance(spec, dict):
        return spec
    return {
        key: value.partition(SOURCE_HASH)[0] if key == "source" else _without_sources(value)
        for key, value in spec.items()
        if key != ENGINE
    }


def dataset_in_short(folder: Path) -> dict[str, Any]:
    """A hash of all files, and some numbers of every table, for processors on which the bytes are others."""
    numbers = {}
    for path in sorted(folder.rglob("*.parquet")):
        table = pandas.read_parquet(path).to_numpy()[:: max(1, SAMPLES // 10)]
        numbers[path.relative_to(folder).as_posix()] = np.nan_to_num(table[:5], nan=-1.0).tolist()
    return {"sha256": sha256_file(folder / "dataset.json"), "numbers": numbers}


def estimates(data: Path, dataset: Path, chaser: Path) -> dict[str, Any]:
    """Row to its estimates, frame by frame: every tracker, and every other plug-in with a tracker of few samples."""
    out = data / "runs"
    common = ("--sequences", 1, "--out", out, "--jobs", 2)
    trackers = {k: one for k, one in discover("tracker").items() if k not in _SLOW and one.unavailable is None}
    trackers = {k: one for k, one in trackers.items() if not getattr(one.cls, "reads_images", False)}
    names = {task: [name for name, found in trackers.items() if found.task == task] for task in _TASKS}
    # In one run, so that two go on at a time.
    rows: list[dict[str, Any]] = [{"tracker": name, "keypoints": "observed"} for name in names["instrument"]]
    rows.append({"tracker": "hybrid", "readings": "noisy"})
    for kind in ("initialiser", "filter", "keypoints"):
        for name, found in discover(kind).items():
            if found.unavailable is None and name not in _SLOW:
                rows.append({"keypoints": "observed", "tracker": "xnes", "row_id": f"{kind}-{name}", kind: name})
    (data / "rows.yaml").write_text(json.dumps({"rows": rows}))
    surgbench("run", "--dataset", dataset, "--suite", data / "rows.yaml", "--frames", FRAMES, *common)
    asked = [word for name in names["viewpoint"] for word in ("--tracker", name)]
    surgbench("run", "--dataset", chaser, "--frames", SAMPLES, *common, *asked)
    surgbench("run", "--dataset", dataset, "--tracker", "xnes", "--arms", "dual", "--frames", FRAMES, *common)
    surgbench("generate", "occlusion", "--sequences", 1, "--frames", FRAMES, "--out", data / "crossing")
    pairs = [{"tracker": "hybrid", "row_id": f"hybrid-{masks}", "masks": masks} for masks in ("instances", "union")]
    (data / "pairs.yaml").write_text(json.dumps({"rows": pairs}))
    surgbench("run", "--dataset", data / "crossing", "--suite", data / "pairs.yaml", "--arms", "dual", *common)
    surgbench("generate", "paper-rcm", "--sequences", 1, "--frames", FRAMES, "--out", data / "rcm")
    surgbench("run", "--dataset", data / "rcm", "--tracker", "particle-filter", "--joints", *common)
    found_estimates = {}
    for record in records(out):
        spec, frames = record["spec"], record["frames"]
        key = f"{spec['dataset']['name']}/{spec['row_id']}/{spec['unit']}"
        estimated = frames.get("state", frames.get("setpoint", []))[:STEPS]
        found_estimates[key] = estimated if record["status"] == "ok" else record["error"]
    return found_estimates


_WITH_IMAGES = ("endoscope", "markers")
_SMALL_CAMERA = "camera={width: 64, height: 48, fx: 80.0, fy: 80.0, cx: 31.5, cy: 23.5}"
_TASKS = ("instrument", "viewpoint")
_SLOW = ("turbo", "random", "adam-mitsuba")  # each takes seconds, and has tests of its own


def processor() -> str:
    """Its name and whether it has the widest vectors: where these are alike, so are bytes."""
    flags = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    return f"{environment()['machine']['processor']}{', AVX-512' if 'avx512f' in flags else ''}"


def take(data: Path) -> dict[str, Any]:
    """Everything, made in a folder."""
    surgbench("generate", "mini", "--out", data / "mini")
    surgbench("generate", "wire-chaser-mini", "--out", data / "chaser")
    return {
        "processor": processor(),
        "settings": settings_hashes(data / "tables"),
        "datasets": {name: dataset_in_short(data / name) for name in ("mini", "chaser")},
        "estimates": estimates(data, data / "mini", data / "chaser"),
    }


def main() -> None:
    """Write everything down."""
    if len(sys.argv) != 2:
        raise ConfigError("python tests/golden.py FILE.json")
    with tempfile.TemporaryDirectory() as folder:
        content = take(Path(folder))
    Path(sys.argv[1]).write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
