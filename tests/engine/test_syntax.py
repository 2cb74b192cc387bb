"""Python's parser in several threads."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import cycle
from pathlib import Path

import pytest
import trimesh

import surgbench
from surgbench.instrument.meshes import load_mesh
from surgbench.instrument.spec import MeshFile
from surgbench.syntax import parse_file


class Litter:
    """Garbage whose end runs Python code: it is collected amid a tree, and another thread goes on."""

    def __init__(self) -> None:
        self.itself = self

    def __del__(self) -> None:
        sum(range(50))


@pytest.fixture
def interrupted() -> Iterator[None]:
    """Threads that interrupt each other all the time."""
    interval, thresholds = sys.getswitchinterval(), gc.get_threshold()
    sys.setswitchinterval(1e-6)
    gc.set_threshold(5, 1, 1)
    yield
    sys.setswitchinterval(interval)
    gc.set_threshold(*thresholds)


@pytest.mark.usefixtures("interrupted")
def test_text_and_meshes_are_read_in_several_threads(tmp_path: Path) -> None:
    trimesh.creation.box((0.01, 0.01, 0.01)).export(tmp_path / "link.ply")
    sources = cycle(sorted(Path(surgbench.__file__).parent.rglob("*.py")))
    end = time.monotonic() + 2.0

    def repeat(work: Callable[[], object]) -> int:
        times = 0
        while time.monotonic() < end:
            for _ in range(20):
                Litter()
            work()
            times += 1
        return times

    with ThreadPoolExecutor(3) as pool:
        done = [pool.submit(repeat, lambda: parse_file(next(sources))) for _ in range(2)]
        done.append(pool.submit(repeat, lambda: load_mesh(MeshFile(path="link.ply"), tmp_path, "link")))
    assert all(future.result() > 0 for future in done)
