"""Where a run was made: versions, git state, machine. Collected once per process."""

from __future__ import annotations

import os
import platform
import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import surgbench.version as own
from surgbench.processes.threads import ONE_THREAD

PACKAGES = (
    "numpy",
    "scipy",
    "numba",
    "opencv-python-headless",
    "cma",
    "mitsuba",
    "drjit",
    "trimesh",
    "pyarrow",
    "pydantic",
    "torch",
)


@cache
def environment(device: str = "cpu") -> dict[str, Any]:
    """Versions, git state and machine, as they stand in a record; with the card where it is used."""
    machine: dict[str, Any] = {
        "system": platform.platform(),
        "processor": _processor(),
        "vectors": _vectors(),
        "cores": os.cpu_count(),
        "threads": int(ONE_THREAD["OMP_NUM_THREADS"]),  # that a tracker's process is told to use
    }
    if device != "cpu":
        machine["gpu"] = gpu()
    return {
        "surgbench": own.__version__,
        "python": platform.python_version(),
        "packages": {name: found for name in PACKAGES if (found := _version(name)) is not None},
        "git": _git_state(),
        "machine": machine,
    }


def gpu() -> dict[str, str] | None:
    """Name of the first NVIDIA card and version of its driver; ``None`` where there is none."""
    query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    try:
        done = subprocess.run(query, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    name, _, driver = done.stdout.partition("\n")[0].rpartition(", ")
    return {"name": name, "driver": driver}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _git_state() -> dict[str, Any] | None:
    """Commit of the checkout surgbench runs from, and whether it has changes; ``None`` outside one."""
    folder = Path(own.__file__).resolve().parent

    def git(*arguments: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError):
            return None
        return done.stdout.strip()

    tracked = git("ls-files", "--error-unmatch", Path(own.__file__).name)
    commit = git("rev-parse", "HEAD") if tracked else None
    return None if commit is None else {"commit": commit, "changed": bool(git("status", "--porcelain", "-uno"))}


def _processor() -> str:
    return _cpuinfo("model name") or platform.processor() or "unknown"


def _vectors() -> str | None:
    """The widest vector instructions, which decide how sums are rounded; ``None`` where the system does not say."""
    flags = (_cpuinfo("flags") or "").split()
    return next((name for name in ("avx512f", "avx2", "avx", "sse4_2") if name in flags), None)


def _cpuinfo(key: str) -> str | None:
    """What Linux says of the first processor."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith(key):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return None
