"""Where compiled code and other caches go on machines whose home folder cannot be written."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

import surgbench
from surgbench.caches import announce_cache, settle_caches, usable
from surgbench.errors import ConfigError

VARIABLES = ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "MPLCONFIGDIR", "DRJIT_CACHE_DIR", "NUMBA_CACHE_DIR")


@pytest.fixture
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A temporary folder, and a home that cannot be written by anybody, not even by root: it is below a file."""
    for variable in VARIABLES:
        monkeypatch.setenv(variable, "")  # so that what is set meanwhile is taken back
        monkeypatch.delenv(variable)
    (tmp_path / "file").touch()
    monkeypatch.setenv("HOME", str(tmp_path / "file" / "home"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    settle_caches.cache_clear()
    yield tmp_path
    settle_caches.cache_clear()


def test_a_folder_need_not_be_there_to_be_usable(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert usable(tmp_path / "a" / "b")
    assert not usable(tmp_path / "file")
    assert not usable(tmp_path / "file" / "b")
    assert not (tmp_path / "a").exists()


def test_caches_move_to_a_temporary_folder_of_ones_own(nowhere: Path) -> None:
    folder = settle_caches()
    assert folder == nowhere / f"surgbench-{os.geteuid()}"
    assert folder.stat().st_mode & 0o777 == 0o700
    assert {os.environ[variable] for variable in ("XDG_CACHE_HOME", "MPLCONFIGDIR", "DRJIT_CACHE_DIR")} == {str(folder)}


def test_what_is_set_stays(nowhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLCONFIGDIR", str(nowhere / "mine"))
    settle_caches()
    assert os.environ["MPLCONFIGDIR"] == str(nowhere / "mine")


def test_with_a_home_nothing_is_moved(nowhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(nowhere))
    assert settle_caches() is None
    assert not any(os.environ.get(variable) for variable in VARIABLES)
    assert sorted(path.name for path in nowhere.iterdir()) == ["file"]


def test_code_that_others_can_write_is_not_run(nowhere: Path) -> None:
    """Compiled code is loaded from there: a folder that somebody has laid out for us is not taken."""
    laid_out = nowhere / f"surgbench-{os.geteuid()}"
    laid_out.mkdir()
    laid_out.chmod(0o777)
    folder = settle_caches()
    assert folder is not None
    assert folder != laid_out


def test_it_is_said_only_where_it_matters(
    nowhere: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    announce_cache(nowhere)  # numba's own place, beside the sources
    assert capsys.readouterr().err == ""
    announce_cache(nowhere / "file")
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"compiled code is kept in {settle_caches()}" in said
    assert "set NUMBA_CACHE_DIR" in said
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(nowhere / "mine"))
    announce_cache(nowhere / "file")
    assert capsys.readouterr().err == ""


def test_nowhere_at_all_is_an_error_that_says_what_to_set(nowhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(nowhere / "file"))
    with pytest.raises(ConfigError, match=r"^[^\n]*set NUMBA_CACHE_DIR to a folder that can$"):
        announce_cache(nowhere / "file")


@pytest.mark.slow
def test_a_function_is_compiled_where_nothing_beside_it_can_be_written(nowhere: Path) -> None:
    """Numba itself, in a process that has neither home nor a place beside the sources."""
    code = (
        "import surgbench.caches as caches; usable = caches.usable;"
        "caches.usable = lambda folder: folder.name != '__pycache__' and usable(folder);"
        "from numba.core.caching import CacheImpl; place = CacheImpl._locator_classes;"
        "place[:] = [one for one in place if one.__name__.lstrip('_') != 'InTreeCacheLocator'];"
        "from surgbench.camera.change_of_view import _turned; print(_turned._cache._cache_path)"
    )
    environment = {**os.environ, "TMPDIR": str(nowhere), "PYTHONPATH": str(Path(surgbench.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"{nowhere}/surgbench-{os.geteuid()}/")
    assert done.stderr.startswith("surgbench: neither the home folder nor ")
