"""What comes out as on another processor: bytes of datasets, and estimates, with libraries told to be on an older one.

    python benchmarks/other_processors.py                 # all
    python benchmarks/other_processors.py blas numpy      # some

Each kind of processor is told to one library, and then to all: OpenBLAS takes other kernels, NumPy and PyTorch other
vector units, numba compiles for x86-64 in general (half a minute and more, the first time). In processes of their own
``mini`` and ``wire-chaser-mini`` are generated, a few frames and samples of each, and ``cmaes``, ``hybrid`` and
``gaze`` are run on them. Printed for each: which files of the datasets are other ones, and how far off what a table
holds and each estimate are from those of the plain processor.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

# What NumPy would use beyond what every processor has that it runs on.
OLD_VECTORS = " ".join(np.show_config("dicts")["SIMD Extensions"]["found"])
PATIENCE = ("--timeout", 1800)  # everything may have to be compiled anew
# What is promised of numbers in datasets' tables, in their own units: metres, radians, pixels.
TABLES = 1e-9
# The command several times, in one process.
COMMANDS = """
import json, sys
from surgbench.cli import main
for words in json.loads(sys.argv[1]):
    sys.argv = ["surgbench", *words]
    try:
        main()
    except SystemExit as ended:
        if ended.code:
            raise
"""
PROCESSORS = {
    "blas": {"OPENBLAS_CORETYPE": "Nehalem"},
    "blas-haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "numpy": {"NPY_DISABLE_CPU_FEATURES": OLD_VECTORS},
    "torch": {"ATEN_CPU_CAPABILITY": "default", "ONEDNN_MAX_CPU_ISA": "SSE41"},
    "numba": {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""},
}
PROCESSORS["all"] = {name: value for one in PROCESSORS.values() for name, value in one.items()} | PROCESSORS["blas"]
DATASETS = {"mini": ("mini", 3), "chaser": ("wire-chaser-mini", 100)}
TRACKERS = {"mini": ("cmaes", "hybrid"), "chaser": ("gaze",)}


def take(folder: Path, environment: dict[str, str]) -> dict[str, Any]:
    """Datasets and records, made in a folder by processes with a certain environment.

    Returns:
        ``files``: name to bytes; ``estimates``: row to an array.
    """
    commands = []
    for name, (preset, frames) in DATASETS.items():
        data = folder / name
        commands.append(["generate", preset, "--sequences", 1, "--frames", frames, "--jobs", 1, "--out", data])
        trackers = [word for tracker in TRACKERS[name] for word in ("--tracker", tracker)]
        commands.append(["run", "--dataset", data, *trackers, "--sequences", 1, "--out", folder / "runs", *PATIENCE])
    words = json.dumps([[str(word) for word in command] for command in commands])
    command = [sys.executable, "-c", COMMANDS, words]
    done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    datasets = [path for name in DATASETS for path in sorted((folder / name).rglob("*")) if path.is_file()]
    files = {str(path.relative_to(folder)): path for path in datasets}
    estimates = {}
    for path in sorted((folder / "runs").rglob("*-r*.json")):
        record = json.loads(path.read_text())
        assert record["status"] == "ok", record["error"]
        frames = record["frames"]
        estimates[record["spec"]["row_id"]] = np.array(frames.get("state", frames.get("setpoint")), dtype=np.float64)
    return {"files": files, "estimates": estimates}


def largest_difference(plain: Path, other: Path) -> float | None:
    """Of two tables' numbers, or of two JSON files'; ``None`` where they are not of one form."""
    if plain.suffix == ".parquet":
        ours, theirs = (pq.read_table(path).to_pydict() for path in (plain, other))
        ours, theirs = [[list(table.values())] for table in (ours, theirs)]
    elif plain.suffix == ".json":
        ours, theirs = [json.loads(path.read_text()) for path in (plain, other)]
    else:
        return None
    return _difference(ours, theirs)


def _difference(a: Any, b: Any) -> float | None:
    if isinstance(a, dict) and isinstance(b, dict) and set(a) == set(b):
        a, b = [[one[key] for key in a if key not in ("files", "sha256")] for one in (a, b)]
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        parts = [_difference(x, y) for x, y in zip(a, b, strict=True)]
        known = [part for part in parts if part is not None]
        return max(known, default=0.0) if len(known) == len(parts) else None
    if isinstance(a, int | float) and isinstance(b, int | float):
        return 0.0 if a == b or (a != a and b != b) else abs(a - b)
    return 0.0 if a == b else None


def compare(plain: dict[str, Any], other: dict[str, Any]) -> tuple[dict[str, float | None], dict[str, float]]:
    """Files that are other ones, with the largest difference of their numbers; and that of each row's estimates."""
    assert set(plain["files"]) == set(other["files"])
    assert set(plain["estimates"]) == set(other["estimates"])
    files = {
        name: largest_difference(path, other["files"][name])
        for name, path in plain["files"].items()
        if path.read_bytes() != other["files"][name].read_bytes()
    }
    estimates = {
        row: float(np.abs(values - other["estimates"][row]).max()) for row, values in plain["estimates"].items()
    }
    return files, estimates


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("processors", nargs="*", choices=[*PROCESSORS, []], help="default: all of them")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        plain = take(Path(folder) / "plain", {})
        for name in options.processors or PROCESSORS:
            files, estimates = compare(plain, take(Path(folder) / name, PROCESSORS[name]))
            rows = ", ".join(f"{row} {far:.1e}" for row, far in estimates.items())
            print(
                f"{name}: {len(files)} of {len(plain['files'])} files are other ones; estimates off by {rows}",
                flush=True,
            )
            for file, far in files.items():
                print(f"  {file}: {'other content' if far is None else f'numbers off by {far:.1e}'}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
