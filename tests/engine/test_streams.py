"""Output as it may be: ASCII only, names that are no characters, a pipe that nobody reads, a full disk."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from commandline import surgbench
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
