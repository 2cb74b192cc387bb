"""Finding plug-ins: by name, behind entry points, in files; broken ones harm no other."""

from __future__ import annotations

import json
import pickle
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from commandline import STRANGERS

from surgbench import registry
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
            discover("tracker")
    finally:
        discover.cache_clear()


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
