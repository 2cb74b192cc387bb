"""The same work on a Dask cluster: a real scheduler, real workers, and one of them killed in the middle."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from commandline import RUN, records, surgbench, wait_until

from surgbench.cluster import connection
from surgbench.cluster.same_code import check_code, own_code
from surgbench.errors import SurgbenchError
from surgbench.report.rows import read_rows
from surgbench.reproduce.fingerprint import record_sha256

pytest.importorskip("distributed")
pytestmark = [pytest.mark.extras, pytest.mark.slow]

GENERATE = ("generate", "mini", "--frames", "30")
FRAMES = 4
# Says who asked for its second frame, the first time that anybody does, and waits for ever.
LAME = """
import os, time
from pathlib import Path

MARK = Path({mark!r})


class Lame:
    name = "lame"

    def reset(self, scene, state, rng):
        self.rng = rng

    def step(self, observation):
        if observation.index == 2 and not MARK.exists():
            MARK.with_suffix(".tmp").write_text(str(os.getppid()))
            MARK.with_suffix(".tmp").rename(MARK)
            time.sleep(3600)
        return observation.start + self.rng.normal(0, 1e-4, 9)
"""


class Cluster:
    """A scheduler and its workers, each a process that ends with the test."""

    def __init__(self, held: contextlib.ExitStack, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{port}"
        self._held, self._folder = held, folder
        self._start("scheduler", "--port", port, "--host", "127.0.0.1")

    def add_worker(self) -> None:
        self._start("worker", self.address, "--nthreads", 1, "--no-nanny", "--local-directory", self._folder)

    def _start(self, kind: str, *arguments: object) -> None:
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--no-dashboard", *map(str, arguments)]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=self._folder)
        self._held.callback(process.wait)
        self._held.callback(process.kill)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    with contextlib.ExitStack() as held:
        made = Cluster(held, tmp_path_factory.mktemp("cluster"))
        made.add_worker()
        made.add_worker()
        yield made


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "mini"
    surgbench(*GENERATE, "--jobs", 1, "--out", folder)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def rows(folder: Path) -> Any:
    """The leaderboard without times, and what the records hold without times and machines."""
    board = [
        {key: value for key, value in row.items() if "latency" not in key and key != "calibration_ratio"}
        for row in read_rows([folder])
    ]
    return json.dumps(board, sort_keys=True), sorted(map(record_sha256, records(folder)))


def test_a_dataset_has_the_same_bytes(
    cluster: Cluster, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)  # the workers are in another folder
    surgbench(*GENERATE, "--out", "there", "--scheduler", cluster.address)
    assert contents(tmp_path / "there") == contents(data)
    assert capsys.readouterr().out == "there\n"


def test_rows_are_the_same_wherever_they_are_made_though_a_worker_is_killed(
    data: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    mark = tmp_path / "asked"
    (tmp_path / "lame.py").write_text(LAME.format(mark=str(mark)))
    ask: tuple[object, ...] = (
        *RUN,
        "--dataset",
        data,
        "--tracker",
        "lame.py:Lame",
        "--tracker",
        "cmaes",
        "--set",
        "cmaes.iterations=1",
    )
    ask = (*ask, "--frames", FRAMES, "--repeats", 2)
    with contextlib.ExitStack() as held:
        cluster = Cluster(held, tmp_path_factory.mktemp("cluster"))
        cluster.add_worker()
        cluster.add_worker()
        command = [sys.executable, "-m", "surgbench", *map(str, ask), "--out", "there", "--scheduler", cluster.address]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as run:
            wait_until(mark.exists)
            os.kill(int(mark.read_text()), signal.SIGKILL)  # the worker whose process it is
        assert run.returncode == 0
    surgbench(*ask, "--out", "one")
    surgbench(*ask, "--out", "two", "--jobs", 2)
    assert rows(tmp_path / "one") == rows(tmp_path / "two") == rows(tmp_path / "there")
    assert len(records(tmp_path / "there")) == 8
    assert all(record["status"] == "ok" for record in records(tmp_path / "there"))
    assert [record["references"] for record in records(Path("there"))] == [
        record["references"] for record in records(Path("one"))
    ]


def test_a_run_goes_on_where_another_stopped(cluster: Cluster, data: Path, tmp_path: Path) -> None:
    ask = (*RUN, "--dataset", data, "--tracker", "cmaes", "--set", "cmaes.iterations=1", "--frames", 2, "--out")
    surgbench(*ask, tmp_path, "--sequences", 1)
    (before,) = records(tmp_path)
    surgbench(*ask, tmp_path, "--scheduler", cluster.address)
    assert len(records(tmp_path)) == 2
    assert before in records(tmp_path)


def test_what_a_worker_does_not_see_is_told_in_one_line(
    cluster: Cluster, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("surgbench.cluster.runs._working_folder", lambda: str(tmp_path / "only-here"))
    ask = (*RUN, "--dataset", data, "--tracker", "cmaes", "--frames", 2, "--sequences", 1, "--out", tmp_path / "runs")
    surgbench(*ask, "--scheduler", cluster.address, expect=2)
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("surgbench: a worker of the cluster cannot run this: ")
    assert "only-here" in said


def test_what_is_no_scheduler_is_told_in_one_line(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "CONNECT_TIMEOUT_S", 0.2)
    for address in ("nowhere", "tcp://127.0.0.1:1"):
        surgbench(*RUN, "--dataset", data, "--tracker", "cmaes", "--out", tmp_path, "--scheduler", address, expect=2)
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"surgbench: --scheduler {address}: no Dask scheduler answers there (")


def test_a_cluster_without_workers_is_told_in_one_line(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "WORKERS_TIMEOUT_S", 0.2)
    with contextlib.ExitStack() as held:
        address = Cluster(held, tmp_path).address
        surgbench(*GENERATE, "--out", tmp_path / "there", "--scheduler", address, expect=2)
    assert f"has no workers; start some, one for each core: dask worker {address}" in capsys.readouterr().err


def test_other_code_is_refused() -> None:
    check_code(own_code())
    with pytest.raises(SurgbenchError, match=r"a worker has surgbench .*, this command 0\.0\.1; install the same"):
        check_code("0.0.1")
