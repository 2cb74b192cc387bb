"""Every command in a document is one that the command line takes, and the README's own are run as they stand."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import typer.main
from commandline import surgbench

from surgbench.cli import app

ROOT = next(folder for folder in Path(__file__).parents if (folder / "pyproject.toml").is_file())
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```(?:sh|bash|console)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def commands(document: Path) -> Iterator[list[str]]:
    """The words of each command in a document's blocks of shell."""
    for block in BLOCK.findall(document.read_text(encoding="utf-8")):
        for line in block.replace("\\\n", " ").splitlines():
            words: list[str] = []
            for word in [*shlex.split(line, comments=True), ";"]:
                if word not in (";", "&", "&&", "||", "|"):
                    words.append(word)
                    continue
                while words and re.fullmatch(r"\w+=\S*", words[0]):  # variables of the environment
                    words = words[1:]
                if words:
                    yield words
                words = []


def all_commands() -> list[Any]:
    return [
        pytest.param(words, id=f"{document.relative_to(ROOT)}: {' '.join(words)[:60]}")
        for document in DOCUMENTS
        for words in commands(document)
        if words[0] in ("surgbench", "make", "python")
    ]


def parse(words: list[str]) -> None:
    """Have the command line take words, without doing anything.

    Raises:
        click.UsageError: It does not.
    """
    command: Any = typer.main.get_command(app)
    context = command.make_context("surgbench", list(words))
    rest = [*context._protected_args, *context.args]
    while hasattr(command, "resolve_command"):
        name, command, rest = command.resolve_command(context, rest)
        context = command.make_context(name, rest, parent=context)
        rest = [*getattr(context, "_protected_args", []), *context.args]


@pytest.mark.parametrize("words", all_commands())
def test_a_documented_command_is_taken(words: list[str]) -> None:
    if words[0] == "surgbench":
        parse(words[1:])
    elif words[0] == "make":
        targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
        assert set(words[1:]) <= set(targets)
    elif words[1].startswith(("benchmarks/", "tools/", "docs/", "tests/")):
        text = (ROOT / words[1]).read_text()
        own = words[2 : words.index("--ros-args")] if "--ros-args" in words else words[2:]  # the rest is ROS's
        for option in re.findall(r"--[\w-]+", " ".join(own)):
            assert f'"{option}"' in text


def test_the_readmes_table_is_the_committed_one() -> None:
    board = pd.read_csv(ROOT / "results/table1/leaderboard.csv").set_index("row_id")
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    lines = re.findall(r"^\| `([\w-]+)` \|.*?\|.*?\| (.*) \|$", text, flags=re.MULTILINE)
    assert len(lines) == 7
    for row_id, cells in lines:
        row = board.loc[row_id]
        numbers = [f"{row.mask_error:.3f}", f"{row.rotation_error_rad:.3f}", f"{1e3 * row.translation_error_m:.2f}"]
        numbers += [f"{1e3 * row.tip_error_m:.2f}", f"{row.latency_ms:.1f}"]
        assert cells.split(" | ") == numbers, row_id


MINE = """
class MyTracker:
    name = "mine"

    def reset(self, scene, state, rng): ...

    def step(self, observation):
        return observation.start
"""
# What takes long is made shorter, and what needs a recording gets one.
SHORTER = {"generate": ["--frames", "6"], "run": ["--frames", "2"], "reproduce": None, "track": None}


@pytest.mark.slow
@pytest.mark.long
def test_the_readmes_commands_run_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(MINE)
    done = []
    for words in commands(ROOT / "README.md"):
        further = SHORTER.get(words[1], []) if words[0] == "surgbench" else None
        if further is not None:
            surgbench(*words[1:], *further)
            done.append(words[1])
    assert done == ["generate", "check", "run", "report", "compare"]
    assert (tmp_path / "report.html").stat().st_size > 10_000
