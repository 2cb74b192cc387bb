"""A full disk, a place where nothing can be written, and a dataset that was altered after a run: one line for each."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from commandline import RUN, STRANGERS, records, surgbench
from small_dataset import make_pair

MASK = "sequences/000/observed/left/000003.png"


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data") / "set"
    make_pair(root, sequences=1)
    return root


def asked(dataset: Path, out: Path) -> tuple[object, ...]:
    return (*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Still", "--sequences", 1, "--out", out)


@pytest.fixture
def mounted(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Mounts small disks, which only root can."""
    places: list[Path] = []

    def mount(options: str) -> Path:
        place = tmp_path / f"disk{len(places)}"
        place.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(place)]
        if shutil.which("mount") is None or subprocess.run(command, capture_output=True).returncode:
            pytest.skip("no disk can be mounted here")
        places.append(place)
        return place

    yield mount
    for place in places:
        subprocess.run(["umount", str(place)], check=True)


def fill(disk: Path, but: int) -> None:
    """Leave so many bytes."""
    about = os.statvfs(disk)
    (disk / "filling").write_bytes(bytes(about.f_bavail * about.f_bsize - but))


@pytest.mark.slow
def test_what_a_full_disk_stops_goes_on_once_there_is_room(
    sound: Path, mounted: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    disk = mounted("size=256k")
    fill(disk, 8192)
    surgbench(*asked(sound, disk / "runs"), expect=2)
    told = f"surgbench: {disk}/runs: cannot be written (No space left on device); mend that, then run the same command"
    assert capsys.readouterr().err == f"{told} again\n"
    (disk / "filling").unlink()
    surgbench(*asked(sound, disk / "runs"))
    assert [record["status"] for record in records(disk / "runs")] == ["ok"]
    fill(disk, 0)
    capsys.readouterr()
    surgbench("report", disk / "runs", "--format", "csv", "--out", disk / "table.csv", expect=2)
    assert capsys.readouterr().err == f"surgbench: {disk}/table.csv: cannot be written (No space left on device)\n"
    assert {path.name for path in disk.iterdir()} == {"filling", "runs"}
    assert [path for path in (disk / "runs").rglob("*") if path.is_file() and not path.name.endswith("-r0.json")] == []


@pytest.mark.slow
def test_a_dataset_on_a_full_disk_is_finished_later(
    mounted: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    disk = mounted("size=4m")
    fill(disk, 40_000)
    command = ("generate", "mini", "--frames", 2, "--jobs", 1, "--out", disk / "mini")
    surgbench(*command, expect=2)
    complaint = capsys.readouterr().err.splitlines()[-1]
    assert complaint.startswith(f"surgbench: {disk}/mini: the disk "), complaint
    (disk / "filling").unlink()
    surgbench(*command)
    surgbench("validate", disk / "mini")
    assert not list(disk.rglob("*.partial"))


@pytest.mark.slow
def test_nothing_is_written_where_nothing_can_be(
    sound: Path, tmp_path: Path, mounted: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    surgbench(*asked(sound, tmp_path / "runs"))
    capsys.readouterr()
    read_only = mounted("size=64k,ro") / "x"
    (tmp_path / "file").touch()
    for place, why in ((read_only, "Read-only file system"), (tmp_path / "file" / "x", "Not a directory")):
        commands: tuple[tuple[object, ...], ...] = (
            asked(sound, place),
            ("generate", "mini", "--frames", 2, "--out", place),
            ("import", "masks", sound, "--out", place),
            ("export", sound, "--format", "coco", "--out", place),
            ("video", tmp_path / "runs", "--out", place),
            ("report", tmp_path / "runs", "--format", "csv", "--out", place / "table.csv"),
        )
        for command in commands:
            surgbench(*command, expect=2)
            complaint = capsys.readouterr().err
            assert complaint.count("\n") == 1, complaint
            assert why in complaint or f"{tmp_path / 'file'}: is a file" in complaint


@pytest.mark.slow
def test_a_dataset_that_was_altered_after_a_run_is_told(
    sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = shutil.copytree(sound, tmp_path / "set")
    surgbench(*asked(root, tmp_path / "runs"))
    with (root / MASK).open("ab") as file:
        file.write(b"\n")
    altered = f"{root / MASK}: altered, its SHA-256 is not the one in dataset.json"
    before = records(tmp_path / "runs")
    capsys.readouterr()
    surgbench(*asked(root, tmp_path / "runs"), "--again", expect=2)
    assert capsys.readouterr().err.splitlines()[-1] == f"surgbench: {altered}"
    surgbench("video", tmp_path / "runs", "--out", tmp_path / "videos", expect=2)
    assert capsys.readouterr().err.splitlines()[-1] == f"surgbench: {altered}"
    surgbench("validate", root, expect=2)
    assert capsys.readouterr().err.splitlines()[-1] == altered
    assert records(tmp_path / "runs") == before  # what was measured stays, and can be shown
    surgbench("report", tmp_path / "runs", "--format", "csv")
    (root / "dataset.json").write_bytes((root / "dataset.json").read_bytes() + b"\n")
    capsys.readouterr()
    surgbench("video", tmp_path / "runs", "--out", tmp_path / "videos", expect=2)
    assert "changed since the records were made" in capsys.readouterr().err
