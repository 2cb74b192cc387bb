"""The house: which room may know which, and that no two know each other."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from itertools import filterfalse
from pathlib import Path

import pytest

import surgbench

ROOT = Path(surgbench.__file__).parent
# What plugs into the engine: it is found by name, never imported.
PLUGGED_IN = ("surgbench.tasks", "surgbench.exchange", "surgbench.trackers", "surgbench.generators")
# The rooms that have to do with tasks; the others are what tasks are built on.
ENGINE = (
    *("cli", "conformance", "dataset", "generation", "kinds", "processes", "records", "registry", "report"),
    *("reproduce", "suite", "task"),
)
# The command line hands generators and the network's training on.
MAY_IMPORT_PLUGINS = "surgbench.cli"


@cache
def modules() -> dict[str, Path]:
    """Every module of ``surgbench/`` itself, plug-ins of other folders left out."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT.parent).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        if not name.startswith(("surgbench.trackers", "surgbench.generators", "surgbench.configs")):
            found[name] = path
    return found


def imports(module: str) -> Iterator[str]:
    """What a module imports, inside functions and for type checkers too; the most exact module of each name."""
    known = modules()
    for node in ast.walk(ast.parse(known[module].read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            if name.partition(".")[0] == "surgbench":
                yield name if name in known else name.rpartition(".")[0] if isinstance(node, ast.ImportFrom) else name


def is_plugged_in(module: str) -> bool:
    return module.startswith(PLUGGED_IN)


def test_there_are_no_circles() -> None:
    graph = {module: {name for name in imports(module) if name in modules()} - {module} for module in modules()}
    assert len(graph) > 150
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def test_the_engine_imports_no_task_and_no_plugin() -> None:
    for module in filterfalse(is_plugged_in, modules()):
        if not module.startswith(MAY_IMPORT_PLUGINS):
            assert not [name for name in imports(module) if name.startswith(PLUGGED_IN)], module
        assert not [name for name in imports(module) if name.startswith("surgbench.tasks")], module


def test_the_engine_names_no_task() -> None:
    """In no text of its code; docstrings may explain."""
    names = {path.name for path in (ROOT / "tasks").iterdir() if (path / "task.py").is_file()}
    assert names >= {"instrument", "viewpoint"}
    for module in modules():
        if module.split(".")[1:2] not in [[room] for room in ENGINE]:
            continue
        tree = ast.parse(modules()[module].read_text(encoding="utf-8"))
        texts = [
            node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
        ]
        assert not names.intersection(texts), module


def test_one_task_knows_no_other() -> None:
    for module in modules():
        for task in ("instrument", "viewpoint"):
            if module.startswith(f"surgbench.tasks.{task}"):
                others = [name for name in imports(module) if name.startswith("surgbench.tasks.")]
                assert all(name.startswith(f"surgbench.tasks.{task}") for name in others), module
