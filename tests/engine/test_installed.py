"""The wheel: it holds every file of the repository's packages, all of it imports, and it works from elsewhere.

`make wheel-test` and `make lowest` run this against what they installed; the other tests say of the code what there is
to say, wherever it lies.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from pathlib import Path

import pytest
from commandline import records, surgbench

import surgbench as package
from surgbench.extras import EXTRAS

SITE = os.environ.get("SURGBENCH_EXPECT_SITE")
ROOT = Path(__file__).parents[2]
FOLDERS = {"surgbench": ".", "trackers": "trackers", "generators": "generators", "configs": "configs"}
NOT_SHIPPED = ("__pycache__", ".mypy_cache", ".ruff_cache")
# What the extras install: modules that import one of these at their top are imported where it is used. The last comes
# with gpytorch.
OF_EXTRAS = {*itertools.chain.from_iterable(EXTRAS.values()), "linear_operator"}

pytestmark = pytest.mark.skipif(SITE is None, reason="for an installed wheel: make wheel-test")


def test_the_wheel_holds_every_file() -> None:
    installed = Path(package.__file__).parent
    for folder, place in FOLDERS.items():
        for source in (ROOT / folder).rglob("*"):
            if source.is_file() and not set(NOT_SHIPPED) & set(source.parts) and source.suffix != ".pyc":
                there = installed / place / source.relative_to(ROOT / folder)
                assert there.is_file(), there
                assert there.read_bytes() == source.read_bytes(), there


IMPORT_ALL = """
import importlib, pkgutil, surgbench
for module in pkgutil.walk_packages(surgbench.__path__, "surgbench."):
    if module.name.endswith(".__main__"):
        continue
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:
        print(error.name)
"""


def test_every_module_imports(tmp_path: Path) -> None:
    """In a process of its own: modules that workers run set the number of threads, and the like."""
    done = subprocess.run([sys.executable, "-c", IMPORT_ALL], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    missing = {name.partition(".")[0] for name in done.stdout.split()}
    absent = {"torch"} if "torch" in missing and not _has_torch() else set()
    assert missing - absent <= OF_EXTRAS


def _has_torch() -> bool:
    from importlib.util import find_spec

    return find_spec("torch") is not None


@pytest.mark.parametrize("what", ["instruments", "presets", "suites", "tables", "training"])
def test_every_kind_of_data_file_is_listed(what: str, capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("list", what)
    assert capsys.readouterr().out.strip()


@pytest.mark.torch
def test_a_run_of_the_instrument_task(tmp_path: Path) -> None:
    """Preset, instrument, suite and the network's weights; worker processes and reports."""
    data, runs = tmp_path / "mini", tmp_path / "runs"
    surgbench("generate", "mini", "--frames", 3, "--out", data)
    surgbench("run", "--dataset", data, "--suite", "demo", "--sequences", 1, "--frames", 2, "--out", runs)
    assert {record["status"] for record in records(runs)} == {"ok"}
    surgbench("report", runs, "--format", "markdown", "--out", tmp_path / "leaderboard.md")
    assert "cmaes" in (tmp_path / "leaderboard.md").read_text(encoding="utf-8")


def test_a_run_of_the_viewpoint_task(tmp_path: Path) -> None:
    data, runs = tmp_path / "chaser", tmp_path / "runs"
    surgbench("generate", "wire-chaser-mini", "--sequences", 1, "--frames", 100, "--out", data)
    surgbench("run", "--dataset", data, "--tracker", "gaze", "--frames", 40, "--out", runs)
    assert [record["status"] for record in records(runs)] == ["ok"]
