"""What a child process is told, and the work that is timed in it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import pytest
from commandline import wait_until

from surgbench.processes import reference_work
from surgbench.processes.child import Child, ChildProblemError
from surgbench.processes.reference import REFERENCE_MS
from surgbench.processes.service import COMPILING, serve
from surgbench.suite.running import Run

# Any module that serves its parent; it says which threads its libraries would use.
SERVER = """
from __future__ import annotations
import os
import cv2, numba, numpy as np, scipy.linalg, torch
from surgbench.processes.service import serve_parent

def answer(tell, kind):
    if kind == "fail":
        raise RuntimeError("no more")
    large = np.ones((1000, 1000), np.float32)
    cv2.warpAffine(large, np.eye(2, 3), (1000, 1000))
    scipy.linalg.lu(large @ large), torch.from_numpy(large) @ torch.from_numpy(large)
    asked = {"cv2": cv2.getNumThreads(), "torch": torch.get_num_threads(), "numba": numba.config.NUMBA_NUM_THREADS}
    return ("threads", asked, len(os.listdir("/proc/self/task")))

if __name__ == "__main__":
    serve_parent(answer)
"""


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "some_server.py").write_text(SERVER)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    return "some_server"


@pytest.mark.slow
def test_every_library_keeps_to_one_thread(server: str) -> None:
    with Child(120.0, server) as child:
        child.send("threads")
        _, asked, threads = child.receive()
    assert set(asked.values()) == {1}, asked
    assert threads == 2  # and the one that sees whether the parent is there


@pytest.mark.slow
def test_the_reference_work_is_timed_before_and_after(server: str) -> None:
    run = Run()
    assert run.calibration_ms is None
    part = run.part()
    with part.child(server, 120.0) as child:
        before = list(part._calibration_ms)
        child.send("threads")
        assert child.receive()[0] == "threads"  # in no message's way
    assert len(before) == reference_work.TURNS
    assert len(part._calibration_ms) == 2 * reference_work.TURNS
    assert part.calibration_ms is not None
    assert part.calibration_ms > 0
    assert run.calibration_ms is None  # of one job, not of all
    assert child.timeout_s == 120.0


@pytest.mark.slow
def test_what_failed_is_timed_before(server: str) -> None:
    part = Run().part()

    def fail() -> None:
        with part.child(server, 120.0) as child:
            child.send("fail")
            child.receive()

    with pytest.raises(ChildProblemError, match="no more"):
        fail()
    assert len(part._calibration_ms) == reference_work.TURNS


def test_the_reference_work_is_the_one_that_its_unit_was_measured_with() -> None:
    work: Any = reference_work.ReferenceWork()
    work()
    counts = reference_work._SCANS, reference_work._SYSTEMS, reference_work._PRODUCTS
    assert (*counts, *work._large.shape, *work._samples.shape) == (29, 130, 5, 320, 320, 70, 9)
    assert reference_work._scan(work._polygons, work._sums, work._crossings) == 1233573
    assert REFERENCE_MS == 10.9


# A tracker's process with a helper, which would go on for an hour.
STARTER = """
from __future__ import annotations
import os, subprocess
from surgbench.processes.service import serve_parent

def answer(tell, kind):
    if kind == "exit":
        os._exit(3)
    return ("helper", subprocess.Popen(["sleep", "3600"], close_fds=False).pid)

if __name__ == "__main__":
    serve_parent(answer)
"""


def test_a_parent_that_is_killed_with_words_unread_is_no_error() -> None:
    ours, theirs = Pipe()
    theirs.send("nobody reads this")
    ours.close()
    serve(theirs, lambda tell, *message: ("never",))


COMPILER = """
from __future__ import annotations
from surgbench.processes.service import serve_parent

def answer(tell, kind):
    import surgbench.compiled
    from numba import njit

    @njit
    def inner(x):
        return 2 * x

    @njit
    def outer(x):
        return inner(x) + 1

    return ("done", outer(20))

if __name__ == "__main__":
    serve_parent(answer)
"""


def test_what_compiles_says_so_and_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "some_compiler.py").write_text(COMPILER)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    with Child(120.0, "some_compiler") as child:
        said: list[tuple[Any, ...]] = []
        receive = child._connection.recv

        def recv() -> tuple[Any, ...]:
            said.append(receive())
            return said[-1]

        monkeypatch.setattr(child, "_connection", Line(child._connection, recv))
        child.send("compile")
        assert child.receive() == ("done", 41)
    assert said[:-1] == [COMPILING] * 4  # as each of both functions begins and is done


class Line:
    """A connection whose messages are seen."""

    def __init__(self, connection: Any, recv: Callable[[], tuple[Any, ...]]) -> None:
        self.recv, self.send, self.poll, self.close = recv, connection.send, connection.poll, connection.close


@pytest.fixture
def starter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "some_starter.py").write_text(STARTER)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    return "some_starter"


def is_gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def helper_of(child: Child) -> int:
    child.send("start")
    pid = child.ready()[1]
    assert isinstance(pid, int)
    assert not is_gone(pid)
    return pid


@pytest.mark.parametrize("how", ["the end", "kill"])
def test_what_a_tracker_has_started_ends_with_it(starter: str, how: str) -> None:
    with Child(120.0, starter) as child:
        helper = helper_of(child)
        if how == "kill":  # as on Ctrl-C, from another thread
            child.kill()
            wait_until(lambda: is_gone(helper))
    wait_until(lambda: is_gone(helper))


def test_a_tracker_that_exits_is_noticed_though_its_helper_holds_the_line(starter: str) -> None:
    with Child(600.0, starter) as child:
        helper = helper_of(child)
        child.send("exit")
        with pytest.raises(ChildProblemError, match="exited with code 3"):
            child.receive()
        wait_until(lambda: is_gone(helper))


def test_they_end_where_the_command_is_killed(starter: str) -> None:
    """And whoever reads its output need not wait for them: they have inherited it."""
    code = (
        "import os; from surgbench.processes.child import Child; child = Child(120.0, 'some_starter');"
        "child.send('start'); print(child.ready()[1], flush=True); os.kill(os.getpid(), 9)"
    )
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    wait_until(lambda: is_gone(int(done.stdout)))  # it hangs up a moment before it is a zombie
    assert done.returncode == -9
