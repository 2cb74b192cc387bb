"""A few kills of ``benchmarks/kills.py``: nothing is lost, doubled or changed once the command has ended well."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "kills.py"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    if not SCRIPT.is_file():
        pytest.skip("a wheel holds no benchmarks")
    spec = importlib.util.spec_from_file_location("kills", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "kills"),
    [
        pytest.param("generate", 3, marks=pytest.mark.long),
        pytest.param("run", 3, marks=pytest.mark.long),
        ("import", 1),
        pytest.param("train", 1, marks=[pytest.mark.long, pytest.mark.torch]),
    ],
)
def test_what_is_killed_at_any_moment_is_finished_by_the_same_command(
    script: ModuleType, command: str, kills: int, tmp_path: Path
) -> None:
    result = script.trials(command, kills, 7, tmp_path)
    assert result.problems == []
    assert result.kills == kills


def test_a_difference_is_found(script: ModuleType, tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / name).write_bytes(b"1")
    whole = script.content(tmp_path)
    (tmp_path / "a").unlink()
    (tmp_path / "b").write_bytes(b"2")
    (tmp_path / "c.123.partial").touch()
    found = script.differences(script.content(tmp_path), whole)
    assert found == ["a: lost", "c.123.partial: left behind", "b: another"]


@pytest.mark.slow
def test_a_process_that_outlives_its_command_is_found(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(script, "NOTICED_S", 0.5)
    monkeypatch.setattr(script, "SURGBENCH", [sys.executable, "-c", "import time; time.sleep(3600)"])
    process = script.start([], tmp_path / "out", tmp_path / "tmp", heard=False)
    try:
        assert script.left_processes(tmp_path) == [f"process {process.pid}: outlived its command"]
    finally:
        process.kill()
        process.wait()
    assert script.left_processes(tmp_path) == []
