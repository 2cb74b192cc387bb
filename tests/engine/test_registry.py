"""Finding plug-ins: by name, behind entry points, in files; broken ones harm no other."""

from __future__ import annotations

import importlib
import json
import pickle
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from commandline import STRANGERS

from surgbench import contract, registry
from surgbench.errors import ConfigError, NotFoundError
from surgbench.kinds import KINDS
from surgbench.registry import Found, configure, create, describe, discover, find


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_plugin_of_ours_loads_with_its_defaults(kind: str) -> None:
    for name, found in discover(kind).items():
        assert found.problem is None, found
        plugin = create(found, {})
        assert plugin.name == name
        assert all(meaning for _, _, meaning in describe(found)), name
        config = configure(found, {})
        if config is not None:
            assert configure(found, json.loads(config.model_dump_json())) == config


def test_a_file_is_loaded_once_and_its_instances_can_be_pickled() -> None:
    found = find("tracker", f"{STRANGERS}:Still")
    assert found.cls is find("tracker", f"{STRANGERS}:Still").cls
    assert found.cls is not None
    assert isinstance(pickle.loads(pickle.dumps(found.cls())), found.cls)


def test_another_text_is_another_plugin(tmp_path: Path) -> None:
    source = (STRANGERS).read_text()
    (tmp_path / "a.py").write_text(source)
    (tmp_path / "b.py").write_text(source + "\n# changed\n")
    one, other = (find("tracker", f"{tmp_path / name}:Still") for name in ("a.py", "b.py"))
    assert one.hash != other.hash


TWO_FILES = """\
import helper


class Mine:
    name = "mine"

    def reset(self, scene, state, rng):
        self.memory = helper.Memory(state)

    def step(self, observation):
        from helper import SHIFT
        from parts.more import more

        return SHIFT + more()
"""
HELPER = """\
from dataclasses import dataclass


@dataclass
class Memory:
    state: object


SHIFT = {shift}
"""
STILL = """

class Still:
    name = "still"

    def reset(self, scene, state, rng): ...

    def step(self, observation):
        return twice(observation)
"""


def two_files(folder: Path, shift: int) -> str:
    """A tracker whose other half lies beside it, and a folder of more beside both."""
    (folder / "parts").mkdir(parents=True)
    (folder / "mine.py").write_text(TWO_FILES)
    (folder / "helper.py").write_text(HELPER.format(shift=shift))
    (folder / "parts" / "more.py").write_text(
        "import helper\nfrom .rest import REST\n\n\ndef more():\n    return 10 * helper.SHIFT + REST\n"
    )
    (folder / "parts" / "rest.py").write_text("REST = 1000\n")
    return f"{folder / 'mine.py'}:Mine"


def test_what_lies_beside_a_file_can_be_imported_and_is_its_own(tmp_path: Path) -> None:
    before = list(sys.path)
    one, other = (
        create(find("tracker", two_files(tmp_path / name, shift)), {}) for name, shift in (("a", 1), ("b", 2))
    )
    assert (one.step(None), other.step(None)) == (1011, 1022)
    assert (one.step(None), other.step(None)) == (1011, 1022)
    for tracker in (one, other):
        tracker.reset(None, 3, None)
        again = pickle.loads(pickle.dumps(tracker))
        assert type(again) is type(tracker)
        assert again.memory == tracker.memory
    assert sys.path == before
    assert "helper" not in sys.modules
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("helper")


def test_what_lies_beside_a_file_does_not_replace_the_library(tmp_path: Path) -> None:
    for name in ("json", "surgbench"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('not this one')\n")
    (tmp_path / "numpy").mkdir()
    (tmp_path / "mine.py").write_text("import json\n\nimport numpy.linalg\n\nimport surgbench.contract\n" + TWO_FILES)
    (tmp_path / "helper.py").write_text(HELPER.format(shift=1))
    module = sys.modules[str(getattr(find("tracker", f"{tmp_path / 'mine.py'}:Mine").cls, "__module__", ""))]
    assert (module.json, module.numpy.linalg, module.surgbench.contract) == (json, np.linalg, contract)


@pytest.mark.slow
def test_compiled_code_outlives_a_move_of_its_folder(tmp_path: Path) -> None:
    """Numba keeps the name of the module with the code."""
    (tmp_path / "a").mkdir()
    text = "from numba import njit\n\n\n@njit(cache=True)\ndef twice(value):\n    return 2 * value\n"
    (tmp_path / "a" / "mine.py").write_text(text + STILL)
    assert create(find("tracker", f"{tmp_path / 'a' / 'mine.py'}:Still"), {}).step(2.0) == 4.0
    (tmp_path / "a").rename(tmp_path / "b")
    assert list((tmp_path / "b" / "__pycache__").glob("*.nbi"))
    call = f"from surgbench.registry import find; f = find('tracker', '{tmp_path}/b/mine.py:Still').cls(); "
    call += (
        "assert f.step(2.0) == 4.0; import sys; m = sys.modules[type(f).__module__]; assert m.twice.stats.cache_hits"
    )
    subprocess.run([sys.executable, "-c", call], check=True)


def test_entry_points_are_found_and_broken_ones_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    points = [
        EntryPoint("theirs", "surgbench.trackers.cmaes:CmaesTracker", "surgbench.trackers"),
        EntryPoint("broken", "no_such_package:Tracker", "surgbench.trackers"),
    ]
    monkeypatch.setattr(registry, "entry_points", lambda group: points if group == "surgbench.trackers" else [])
    discover.cache_clear()
    try:
        found = discover("tracker")
        assert found["theirs"].problem is None
        assert "no_such_package" in str(found["broken"].problem)
        assert found["cmaes"].problem is None
        with pytest.raises(ConfigError, match="cannot be loaded"):
            find("tracker", "broken")
        points.append(EntryPoint("cmaes", "surgbench.trackers.cmaes:CmaesTracker", "surgbench.trackers"))
        discover.cache_clear()
        with pytest.raises(ConfigError, match="two trackers are named 'cmaes'"):
            find("tracker", "cmaes")
        assert find("tracker", "hybrid").problem is None
    finally:
        discover.cache_clear()


def test_a_failed_import_beside_a_file_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("import halper\n")
    with pytest.raises(
        ConfigError, match=r"mine\.py: cannot be imported \(ModuleNotFoundError: No module named 'halper'"
    ):
        find("tracker", f"{tmp_path / 'mine.py'}:Mine")


def test_a_file_that_does_not_import_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text("import no_such_package\n")
    with pytest.raises(ConfigError, match=r"bad\.py: cannot be imported \(ModuleNotFoundError") as raised:
        find("tracker", f"{tmp_path / 'bad.py'}:Tracker")
    assert "\n" not in str(raised.value)


def test_unknown_names_offer_the_nearest() -> None:
    with pytest.raises(NotFoundError, match="did you mean 'cmaes'"):
        find("tracker", "cma-es")


def test_options_of_a_class_without_any_are_refused() -> None:
    with pytest.raises(ConfigError, match="takes no options"):
        configure(Found("still", "here", object), {"speed": 1})
