"""Which code a record depends on: a change of any of it is another plug-in, or another engine."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from surgbench.registry import discover, find
from surgbench.sources import PLUMBING, engine_modules, hash_modules, own_modules
from surgbench.task import all_tasks, find_task

# Modules of tasks that name, order and write what others make.
TASK_PLUMBING = {"asked", "format", "plan", "records"}


def names(modules: frozenset[object]) -> set[str]:
    return {module.name for module in modules}  # type: ignore[attr-defined]


@pytest.mark.slow
def test_a_plugin_of_ours_is_all_that_it_imports_of_its_package() -> None:
    own = names(own_modules(find("tracker", "hybrid").modules))
    assert own >= {
        "surgbench.trackers.hybrid",
        "surgbench.trackers.registration.fit",
        "surgbench.trackers.registration",
    }
    assert not own & {"surgbench.trackers.cmaes", "surgbench.trackers.adam"}
    assert all(name.startswith("surgbench.trackers") for name in own)
    # Imported inside a function.
    assert "surgbench.trackers.keypoints.heatmaps.network" in names(own_modules(find("keypoints", "resnet18").modules))


def test_the_engine_is_what_makes_estimates_and_no_plumbing() -> None:
    for name in ("hybrid", "cmaes", "gaze"):
        found = find("tracker", name)
        engine = names(engine_modules(found.modules, find_task(found.task).made_by))
        assert f"surgbench.tasks.{found.task}.worker" in engine
        assert not [one for one in engine if one.split(".")[1] in (*PLUMBING, "trackers", "generators", "exchange")]
    assert "surgbench.objective" in names(engine_modules(find("tracker", "cmaes").modules, ()))
    assert "surgbench.objective" not in names(engine_modules(find("tracker", "gaze").modules, ()))


def test_tasks_name_all_of_their_modules_that_make_something() -> None:
    for task in all_tasks():
        room = type(task).__module__.rpartition(".")[0]
        importlib.import_module(f"{room}.execute")
        reached = names(own_modules((f"{room}.execute", f"{room}.worker")))
        others = {name.removeprefix(f"{room}.") for name in reached if name.startswith(f"{room}.")}
        assert others - {name.removeprefix(f"{room}.") for name in task.made_by} <= TASK_PLUMBING


def test_hashes_of_all_plugins_can_be_had() -> None:
    for kind in ("tracker", "initialiser", "filter", "keypoints"):
        hashes = [found.hash for found in discover(kind).values() if found.cls is not None]
        assert "unknown" not in hashes
        assert len(set(hashes)) == len(hashes)


TRACKER = """\
from surgbench.state import JOINTS


class Mine:
    name = "mine"

    def reset(self, scene, state, rng): ...

    def step(self, observation):
        {imports}
"""


@pytest.mark.parametrize(
    "imports", ["import near.far.helper", "from near.far import helper", "from near.far.helper import X"]
)
def test_a_file_is_all_that_it_imports_from_beside_it(tmp_path: Path, imports: str) -> None:
    (tmp_path / "mine.py").write_text(TRACKER.format(imports=imports))
    (tmp_path / "near" / "far").mkdir(parents=True)
    for name, text in (("__init__", ""), ("far/helper", "from . import further\nX = 1\n"), ("far/further", "Y = 1\n")):
        (tmp_path / "near" / f"{name}.py").write_text(text)
    (tmp_path / "stranger.py").write_text("Z = 1\n")
    found = find("tracker", f"{tmp_path / 'mine.py'}:Mine")
    assert names(own_modules(found.modules)) == {"mine", "near", "near.far.helper", "near.far.further"}
    assert "surgbench.state" in names(engine_modules(found.modules, ()))
    before = found.hash
    (tmp_path / "stranger.py").write_text("Z = 2\n")
    assert found.hash == before
    (tmp_path / "near" / "far" / "further.py").write_text("Y = 22\n")
    assert found.hash != before


def test_a_plugin_of_another_distribution_is_all_that_it_imports_of_its_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "theirs_of_test_sources"
    package.mkdir()
    for name, text in (
        ("__init__", ""),
        ("tracker", "from theirs_of_test_sources.base import Base\n\n\nclass Mine(Base):\n    name = 'mine'\n"),
        ("base", "import numpy\n\nfrom .deep import X\n\n\nclass Base: ...\n"),
        ("deep", "X = 1\n"),
        ("other", "X = 1\n"),
    ):
        (package / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module("theirs_of_test_sources.tracker")
    own = own_modules((module.__name__,))
    parts = ("", ".tracker", ".base", ".deep")
    assert names(own) == {f"theirs_of_test_sources{part}" for part in parts}
    before = hash_modules(own)
    (package / "deep.py").write_text("X = 22\n")
    assert hash_modules(own_modules((module.__name__,))) != before
