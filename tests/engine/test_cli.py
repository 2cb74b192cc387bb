"""The command line as a whole: help, versions, lists."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

import surgbench
from surgbench.cli import app, main
from surgbench.suite.suites import parse_sets

COMMANDS = [
    ("generate",),
    ("validate",),
    ("import", "masks"),
    ("run",),
    ("report",),
    ("compare",),
    ("reproduce",),
    ("video",),
    ("export",),
    ("score",),
    ("track",),
    ("list",),
    ("bench", "silhouettes"),
    ("bench", "keypoints"),
    ("train", "keypoints"),
    ("convert", "sam2"),
    ("check", "tracker"),
    ("instrument", "show"),
    ("instrument", "check"),
]


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_shows_an_example(command: tuple[str, ...]) -> None:
    result = CliRunner().invoke(app, [*command, "--help"])
    assert result.exit_code == 0
    assert f"Example: surgbench {' '.join(command)}" in " ".join(result.output.split())


def test_the_many_options_of_a_run_stand_in_groups(capsys: pytest.CaptureFixture[str]) -> None:
    run_main("run", "--help")
    text = capsys.readouterr().out
    headings = [line.rstrip(":") for line in text.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert headings == [
        "What is run", "Under which conditions", "How much of it", "The work", "Of the instrument task",
        "Of the viewpoint task", "Options",
    ]  # fmt: skip
    of_cameras = text.partition("Of the viewpoint task:")[2]
    assert "--hand" in of_cameras
    assert "--initialiser" not in of_cameras
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ("generate wire-chaser-m", ["wire-chaser-mini"]),
        ("run --tracker hybr", ["hybrid"]),
        ("run --suite fil", ["filters"]),
        ("run --filter kal", ["kalman"]),
        ("run --masks colour", ["colour-edge"]),
        ("reproduce tele", ["teleoperation"]),
        ("check tracker gaz", ["gaze"]),
        ("instrument show cad", ["cadiere_forceps"]),
    ],
)
def test_the_shell_completes_names(
    words: str, names: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_SURGBENCH_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", f"surgbench {words}")
    monkeypatch.setenv("COMP_CWORD", str(len(words.split())))
    run_main()
    assert capsys.readouterr().out.split() == names


def run_main(*arguments: str) -> None:
    """The command in this process, whatever its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["surgbench", *arguments])
        patch.setattr(sys.modules["__main__"], "__package__", None)  # else it takes pytest's name for its own
        with pytest.raises(SystemExit):
            main()


def all_commands(group: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command there is, groups too, by what is typed for it."""
    for name in group.list_commands(None):
        command = group.get_command(None, name)
        yield (*path, name), command
        if hasattr(command, "list_commands"):
            yield from all_commands(command, (*path, name))


def test_no_command_is_without_an_example() -> None:
    found = dict(all_commands(typer.main.get_command(app)))
    assert set(COMMANDS) <= set(found)
    bare = [" ".join(path) for path, one in found.items() if f"Example: surgbench {' '.join(path)}" not in one.help]
    assert not bare


def test_it_is_a_module_too() -> None:
    done = subprocess.run([sys.executable, "-m", "surgbench", "--version"], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, f"surgbench {surgbench.__version__}")


def test_version_is_the_packages() -> None:
    assert CliRunner().invoke(app, ["--version"]).output.strip() == f"surgbench {surgbench.__version__}"


@pytest.mark.parametrize(
    ("what", "name"),
    [
        ("trackers", "cmaes"),
        ("initialisers", "random"),
        ("filters", "kalman"),
        ("keypoints", "observed"),
        ("keypoints", "resnet18"),
        ("exporters", "bop"),
        ("presets", "mini"),
        ("suites", "demo"),
        ("tables", "table1"),
        ("training", "resnet18"),
        ("instruments", "large_needle_driver"),
    ],
)
def test_lists_name_what_there_is(what: str, name: str) -> None:
    assert any(line.split()[:1] == [name] for line in CliRunner().invoke(app, ["list", what]).output.splitlines())


def test_listed_options_have_their_defaults() -> None:
    output = CliRunner().invoke(app, ["list", "trackers"]).output
    assert "cmaes.iterations = 3" in output
    assert "cmaes.loss.keypoint_tolerance_px = 10.0" in output


def test_help_is_quick_to_import() -> None:
    """The help needs no renderer, compiler or table library."""
    heavy = ("mitsuba", "numba", "pandas", "matplotlib", "torch")
    code = f"import sys, surgbench.cli; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_wrong_command_offers_the_nearest() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "from surgbench.cli import main; main()", "rnu"], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "Did you mean 'run'?" in done.stderr
    assert done.stderr.count("\n") == 1


def test_numbers_of_the_command_line_are_those_of_yaml_1_2() -> None:
    """1e-4 is a number, as everyone expects, and not a text, as YAML 1.1 has it."""
    options = parse_sets(["a.b=1e-4", "a.c=-2.5E+3", "a.d=[1e-3, 2]", "a.e=none", "a.f=e4"])
    assert options == {"a": {"b": 1e-4, "c": -2500.0, "d": [1e-3, 2], "e": "none", "f": "e4"}}
