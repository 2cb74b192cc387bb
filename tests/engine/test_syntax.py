"""Texts of others: Python's parser in several threads; JSON and YAML that nest deeply, or stand for too much."""

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
import yaml

import surgbench
from surgbench.instrument.meshes import load_mesh
from surgbench.instrument.spec import MeshFile
from surgbench.syntax import parse_file, parse_json, parse_yaml


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


DEEP = {
    "brackets": "[" * 100_000,
    "closed brackets": "[" * 150 + "]" * 150,
    "keys": '{"a":' * 150 + "1" + "}" * 150,
}
DEEP_YAML = {
    **{name: f"a: {text}" for name, text in DEEP.items()},
    "brackets in lines": "a:\n" + " [\n" * 50_000,
    "dashes": "- " * 50_000,
    "indents": "\n".join(" " * depth + "a:" for depth in range(500)),
    "itself": "&a [*a]",
    "much from few": "\n".join(["a0: &a0 [1, 1]"] + [f"a{k}: &a{k} [{f'*a{k - 1},' * 9}]" for k in range(1, 12)]),
}


@pytest.mark.parametrize("text", DEEP.values(), ids=DEEP)
def test_json_that_nests_deeply_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="nested more than 100 deep"):
        parse_json(text)


@pytest.mark.parametrize("loader", [yaml.SafeLoader, getattr(yaml, "CSafeLoader", yaml.SafeLoader)])
@pytest.mark.parametrize("text", DEEP_YAML.values(), ids=DEEP_YAML)
def test_yaml_that_nests_deeply_or_stands_for_too_much_is_refused(text: str, loader: type) -> None:
    with pytest.raises(ValueError, match=r"nested more than 100 deep|holds more than \d+ values"):
        parse_yaml(text, loader)


def test_a_date_that_is_none_is_a_wrong_value() -> None:
    with pytest.raises(ValueError, match="month must be in"):
        parse_yaml("a: 2026-13-45")
