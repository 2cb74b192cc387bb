"""Output as it may be: ASCII only, names that are no characters, a pipe that nobody reads, a full disk."""

from __future__ import annotations

import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from commandline import surgbench
from fabricate import record, write
from hypothesis import given
from hypothesis import strategies as st

from surgbench.processes.streams import print_whatever_comes

COMMAND = (sys.executable, "-c", "from surgbench.cli import main; main()")


def printed(text: str, encoding: str) -> bytes:
    """What arrives of a text that is printed."""
    raw = io.BytesIO()
    before = sys.stdout
    sys.stdout = io.TextIOWrapper(raw, encoding=encoding, newline="")
    try:
        print_whatever_comes()
        sys.stdout.write(text)
        sys.stdout.flush()
        return raw.getvalue()
    finally:
        sys.stdout = before


@given(st.text(), st.sampled_from(["ascii", "latin-1", "cp437", "utf-8"]))
def test_every_text_can_be_printed(text: str, encoding: str) -> None:
    arrived = printed(f"<{text}>", encoding)
    assert arrived.startswith(b"<")
    assert arrived.endswith(b">")
    if text.isascii():
        assert arrived == f"<{text}>".encode()


@pytest.mark.parametrize(
    ("text", "plain"), [("run … 3 × 4 ± 1 µs", "run ... 3 x 4 +- 1 us"), ("Köln", "Koln"), ("界", "?"), ("±½", "+-12")]
)
def test_characters_are_replaced_by_what_they_mean(text: str, plain: str) -> None:
    assert printed(text, "ascii").decode() == plain
    assert printed(text, "utf-8").decode() == text


def test_names_of_files_that_are_no_characters_stay_what_they_are() -> None:
    name = b"r\xffuns"
    assert printed(os.fsdecode(name), "utf-8") == name


@pytest.mark.slow
def test_an_ascii_terminal_gets_lists_and_complaints() -> None:
    environment = {**os.environ, "LC_ALL": "C", "PYTHONIOENCODING": "ascii"}
    done = subprocess.run([*COMMAND, "list", "trackers"], capture_output=True, env=environment, check=True)
    assert done.stdout.isascii()
    assert done.stderr == b""
    done = subprocess.run([*COMMAND, "report", "nöwhere"], capture_output=True, env=environment)
    assert (done.returncode, done.stderr.count(b"\n"), done.stderr.isascii()) == (2, 1, True)


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Records of two rows with a name that is not ASCII."""
    rows = [record(name, f"00{n}-left") | {"variant": "1 µm ± …"} for name in ("köln", "ours") for n in (0, 1)]
    return write(tmp_path / "runs", *rows)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["report", "compare"])
@pytest.mark.parametrize("width", ["40", "100"])
def test_an_ascii_terminal_gets_whole_tables(runs: Path, command: str, width: str) -> None:
    environment = {**os.environ, "LC_ALL": "C", "PYTHONIOENCODING": "ascii", "COLUMNS": width}
    done = subprocess.run([*COMMAND, command, runs], capture_output=True, env=environment)
    assert (done.returncode, done.stderr) == (0, b"")
    text = done.stdout.decode("ascii")
    assert "koln" in text
    assert "---" in text
    assert "?" not in text
    assert "|" not in text


@pytest.mark.slow
@pytest.mark.parametrize("command", ["report", "compare"])
@pytest.mark.parametrize("told", [{"NO_COLOR": "1"}, {"TERM": "dumb"}], ids=["no colour", "dumb"])
def test_terminals_without_colours_get_none(runs: Path, command: str, told: dict[str, str]) -> None:
    """As a user sees it, at a terminal of 60 columns."""
    program = shlex.join([*COMMAND, command, str(runs)])
    quiet = {key: value for key, value in os.environ.items() if key not in ("COLUMNS", "NO_COLOR", "FORCE_COLOR")}
    environment = {**quiet, "TERM": "xterm-256color", **told}
    wanted = ["script", "-qec", f"stty cols 60; {program}", "/dev/null"]
    if shutil.which("script") is None:
        pytest.skip("no script command, which makes a terminal")
    done = subprocess.run(wanted, capture_output=True, env=environment, stdin=subprocess.DEVNULL)
    assert done.returncode == 0
    escapes = set(re.findall(rb"\x1b\[[0-9;?]*[a-zA-Z]", done.stdout))
    # Bold is no colour, and a dumb terminal gets nothing at all.
    assert escapes <= ({b"\x1b[1m", b"\x1b[0m"} if "NO_COLOR" in told else set())
    lines = re.sub(rb"\x1b\[[0-9;?]*[a-zA-Z]", b"", done.stdout).decode().splitlines()
    assert max(map(len, lines)) <= 60


@pytest.mark.slow
@pytest.mark.parametrize("words", ["report {} --format csv", "report {}", "compare {} --format json"])
def test_a_pipe_that_is_closed_early_is_no_fault(runs: Path, words: str) -> None:
    program = f"{shlex.join(COMMAND)} {words.format(shlex.quote(str(runs)))} | head -1"
    done = subprocess.run(["sh", "-c", program], capture_output=True)
    assert (done.returncode, done.stdout.count(b"\n"), done.stderr) == (0, 1, b"")


@pytest.mark.slow
def test_output_that_nobody_reads_is_no_fault() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run([*COMMAND, "list", "presets"], stdout=writing, stderr=subprocess.PIPE)
    os.close(writing)
    assert (done.returncode, done.stderr) == (1, b"")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_output_that_cannot_be_written_is_one_line() -> None:
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run([*COMMAND, "list", "presets"], stdout=full, stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr.count(b"\n")) == (2, 1)
    assert b"no space left on device" in done.stderr


def test_a_missing_package_is_named_with_what_installs_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def open_dataset(_: Path) -> None:
        raise ModuleNotFoundError("No module named 'botorch'", name="botorch")

    monkeypatch.setattr("surgbench.dataset.open.open_dataset", open_dataset)
    surgbench("validate", tmp_path, expect=2)
    assert capsys.readouterr().err == "surgbench: botorch is not installed: pip install 'surgbench[turbo]'\n"
