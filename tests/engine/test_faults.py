"""What a tracker's process can do wrong: its row says so in one line, and all others are there."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import faulty
import pytest
from commandline import RUN, records, surgbench, wait_until
from small_dataset import FRAMES, make_pair

from surgbench.processes.memory import parse_size
from surgbench.processes.printed import MOST_PRINTED_BYTES, Printed

FAULTY = Path(faulty.__file__)
# Far more than a tracker that does nothing uses, and far less than a machine has.
MEMORY = "700MB"
COMMAND = [sys.executable, "-c", "from surgbench.cli import main; main()"]

# Of each class: the status, the frames that are there, and the line.
ENDED = "frame 2: the tracker's process "
MEMORY_USED = "frame 2: used more than 700 MB of memory"
FAULTS: dict[str, tuple[str, int, str | None]] = {
    "TakesMemory": ("memory", 2, MEMORY_USED),
    "ChildrenTakeMemory": ("memory", 2, MEMORY_USED),
    "SharesMemory": ("ok", FRAMES, None),
    "PrintsAGigabyte": ("ok", FRAMES, None),
    "GoesOnTwice": ("ok", FRAMES, None),
    "LeavesProcesses": ("ok", FRAMES, None),
    "ClosesEverything": ("exited", 2, ENDED + "closed the line on which it answers"),
    "IsKilled": ("exited", 2, ENDED + "was killed (signal 9), as the system does when memory is used up"),
    "SysExits": ("exited", 2, ENDED + "exited with code 4"),
}
FURTHER: dict[str, tuple[str, int, str | None]] = {
    "RaisesInInit": ("failed", 0, "frame 0: RuntimeError: no licence"),
    "RaisesInReset": ("failed", 0, "frame 0: KeyError: 'left'"),
    "Raises": ("failed", 2, "frame 2: RuntimeError: no instrument"),
    "RaisesTheUnspeakable": ("failed", 2, "frame 2: UnspeakableError: which cannot be put in words"),
    "RaisesAnEssay": ("failed", 2, "frame 2: RuntimeError: " + 2000 * "x"),
    "Recurses": ("failed", 2, "frame 2: RecursionError: maximum recursion depth exceeded"),
    "Hangs": ("timeout", 2, "frame 2: no answer within 6 s"),
    "OsExits": ("exited", 2, ENDED + "exited with code 5"),
    "Segfaults": ("exited", 2, ENDED + "was killed by signal 11 (Segmentation fault)"),
    "ReturnsNan": ("invalid", 2, "frame 2: tracker 'returns-nan' returned a state with NaN or infinity"),
    "ReturnsShape": ("invalid", 2, "frame 2: tracker 'returns-shape' returned a state of shape (9, 1), not (9,)"),
    "Far": ("invalid", 2, "frame 2: tracker 'far' returned a state outside all limits: alpha is 1e+300 rad"),
    "BentTooFar": ("ok", FRAMES, None),
    "ClosesEverythingAndStays": ("exited", 2, ENDED + "closed the line on which it answers"),
    "Wanders": ("ok", FRAMES, None),
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data") / "set"
    make_pair(root, sequences=1)
    return root


def run(dataset: Path, out: Path, *classes: str) -> tuple[dict[str, dict[str, Any]], str]:
    """Run faulty trackers, and a sound one after them, as a user types it.

    Returns:
        The record of each class, and what was told on standard error.
    """
    trackers = [word for name in (*classes, "Sound") for word in ("--tracker", f"{FAULTY}:{name}")]
    asked = (*RUN, "--dataset", dataset, "--sequences", 1, *trackers, "--timeout", 6, "--memory", MEMORY)
    with (out.parent / f"{out.name}.err").open("w+b") as told:
        done = subprocess.run([*COMMAND, *map(str, (*asked, "--out", out))], stdout=subprocess.PIPE, stderr=told)
        assert done.returncode == 0
        told.seek(0)
        words = told.read().decode()
    by_name = {record["spec"]["tracker"]["name"]: record for record in records(out)}
    return {name: by_name[getattr(faulty, name).name] for name in (*classes, "Sound")}, words


@pytest.mark.slow
@pytest.mark.parametrize("faults", [FAULTS, pytest.param(FURTHER, marks=pytest.mark.long)], ids=["few", "all others"])
def test_a_fault_costs_its_own_row_only(
    faults: dict[str, tuple[str, int, str | None]], dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All in one run, for what takes long is the start of each."""
    monkeypatch.setenv(faulty.NOTED, str(tmp_path / "noted"))
    before = {path: path.read_bytes() for path in dataset.rglob("*") if path.is_file()}
    found, words = run(dataset, tmp_path / "runs", *faults)
    for name, (status, frames, error) in faults.items():
        record = found[name]
        assert (record["status"], record["error"]) == (status, error), name
        assert len(record["frames"]["index"]) == frames, name
        assert len(record["traceback"] or "") <= 20_000, name
        if error is not None:
            assert f"{record['spec']['row_id']} 000-left: {status}: {error}\n" in words, name
    assert found["Sound"]["status"] == "ok"
    assert found["Sound"]["frames"]["state"] == found["Sound"]["frames"]["start"]
    assert before == {path: path.read_bytes() for path in dataset.rglob("*") if path.is_file()}
    assert len(words) < 2 * MOST_PRINTED_BYTES
    if "PrintsAGigabyte" in faults:
        assert "(it prints more, which is left out)" in words
        assert found["GoesOnTwice"]["frames"]["state"] == found["Sound"]["frames"]["state"]
        left = [int(pid) for pid in (tmp_path / "noted").read_text().split()]
        wait_until(lambda: not any(is_alive(pid) for pid in left))
    if "BentTooFar" in faults:
        assert found["BentTooFar"]["hint"] == "joints outside their limits in 1 of 4 frames, q3 by up to 3.43 rad"
        assert found["Wanders"]["frames"]["state"] == found["Sound"]["frames"]["state"]


def is_alive(pid: int) -> bool:
    """Whether it runs, and is not only waited for by somebody."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_what_is_printed_is_passed_on_up_to_a_bound_and_not_kept(capfd: pytest.CaptureFixture[str]) -> None:
    printed = Printed(most=100)
    writer = os.dup(printed.theirs)
    printed.begin()
    tracemalloc.start()
    for _ in range(100):
        os.write(writer, b"x" * faulty.MEGABYTE)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    os.close(writer)
    printed.end()
    assert capfd.readouterr().err == "x" * 100 + "\n(it prints more, which is left out)\n"
    assert peak < 5 * faulty.MEGABYTE


@pytest.mark.slow
def test_a_tracker_that_alters_the_dataset_is_found_out(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = shutil.copytree(dataset, tmp_path / "set")
    monkeypatch.setenv(faulty.NOTED, str(mine))
    trackers = ("--tracker", f"{FAULTY}:Sound", "--tracker", f"{FAULTY}:Alters")
    surgbench(*RUN, "--dataset", mine, "--sequences", 1, *trackers, "--out", tmp_path / "runs", expect=2)
    complaint = capsys.readouterr().err.splitlines()[-1]
    mask = mine / "sequences/000/observed/left/000003.png"
    assert complaint == f"surgbench: {mask}: altered, its SHA-256 is not the one in dataset.json"
    assert [record["spec"]["tracker"]["name"] for record in records(tmp_path / "runs")] == ["sound"]


def test_a_tracker_whose_file_cannot_be_imported_is_told_before_anything_is_run(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, text in enumerate(("raise RuntimeError('no\\nlicence')", "import sys; sys.exit(3)", "import nowhere")):
        path = tmp_path / f"mine{number}.py"
        path.write_text(f"{text}\nclass Mine: ...\n")
        trackers = ("--tracker", f"{path}:Mine", "--tracker", f"{FAULTY}:Sound")
        surgbench(*RUN, "--dataset", dataset, *trackers, "--out", tmp_path / "runs", expect=2)
        complaint = capsys.readouterr().err
        assert complaint.startswith(f"surgbench: {path}: ")
        assert complaint.count("\n") == 1
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("text", "size"), [("2GB", 2 * 10**9), ("1.5 g", 1_500_000_000), ("512MiB", 2**29), ("300 mb", 3 * 10**8)]
)
def test_sizes_have_units(text: str, size: int) -> None:
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["", "2", "GB", "-1GB", "0GB", "2XB", "1e3MB", "nan GB", "inf"])
def test_what_is_no_size_is_told(text: str, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ("--dataset", dataset, "--tracker", "cmaes", "--out", tmp_path / "runs")
    surgbench(*RUN, *asked, "--memory", text, expect=2)
    said = f"surgbench: command line: 'memory': must be a size with its unit, as 2GB or 512MiB, not '{text}'\n"
    assert capsys.readouterr().err == said


def test_a_suite_may_say_how_much_memory(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    suite = tmp_path / "suite.yaml"
    suite.write_text("memory: 2\nrows: [{tracker: cmaes}]\n")
    surgbench(*RUN, "--dataset", dataset, "--suite", suite, "--dry-run", expect=2)
    assert "'memory': " in capsys.readouterr().err
    suite.write_text("memory: 2GiB\nrows: [{tracker: cmaes}]\n")
    surgbench(*RUN, "--dataset", dataset, "--suite", suite, "--dry-run")
