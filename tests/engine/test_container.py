"""The container's recipe: what it is built from is enough, and it keeps its promises. Building it takes Docker."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RECIPE = ROOT / "Dockerfile"
FOLDERS = {"surgbench": "surgbench"} | {name: f"surgbench/{name}" for name in ("trackers", "generators", "configs")}


def kept() -> list[str]:
    """What ``.dockerignore`` lets through."""
    lines = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert "*" in lines
    return [line[1:] for line in lines if line.startswith("!")]


def test_it_runs_the_command_without_rights() -> None:
    steps = RECIPE.read_text(encoding="utf-8").rpartition("\nFROM ")[2]
    assert 'ENTRYPOINT ["surgbench"]' in steps
    assert re.search(r"^USER [1-9]\d*$", steps, re.MULTILINE)
    assert re.search(r"^ARG PYTHON=\d+\.\d+\.\d+-slim-\w+$", RECIPE.read_text(encoding="utf-8"), re.MULTILINE)


def test_it_names_no_place_to_load_from() -> None:
    """Where packages come from is the builder's choice."""
    assert "://" not in RECIPE.read_text(encoding="utf-8")


def test_every_word_of_the_document_is_in_the_recipe() -> None:
    document = (ROOT / "docs" / "container.md").read_text(encoding="utf-8")
    arguments = set(re.findall(r"^\| `(\w+)` \|", document, re.MULTILINE))
    assert arguments == set(re.findall(r"^ARG (\w+)", RECIPE.read_text(encoding="utf-8"), re.MULTILINE))


@pytest.mark.slow
def test_what_is_sent_makes_the_whole_wheel(tmp_path: Path) -> None:
    context = tmp_path / "context"
    for name in kept():
        source, there = ROOT / name, context / name
        there.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, there, ignore=shutil.ignore_patterns("__pycache__", "*.pyc"), symlinks=True)
        else:
            shutil.copy(source, there)
    build = [sys.executable, "-m", "build", "-q", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(context)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    held = set(zipfile.ZipFile(wheel).namelist())
    for folder, package in FOLDERS.items():
        for module in (ROOT / folder).rglob("*.py"):
            assert f"{package}/{module.relative_to(ROOT / folder)}" in held


@pytest.mark.skipif(shutil.which("hadolint", path=str(Path(sys.executable).parent)) is None, reason="no hadolint")
def test_a_linter_has_no_word_against_it() -> None:
    linter = str(Path(sys.executable).parent / "hadolint")
    done = subprocess.run([linter, str(RECIPE)], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "")
