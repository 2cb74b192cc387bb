"""What columns are called: one name for one quantity, wherever it is shown."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import Any

import pytest

from surgbench.report.column import Column

MODULES = (
    "surgbench.report.column",
    "surgbench.report.losses",
    "surgbench.tasks.instrument.columns",
    "surgbench.tasks.viewpoint.columns",
    "surgbench.tasks.viewpoint.hand_columns",
)
NAMES = {"latency_ms": "latency", "latency_ms_mean": "mean latency", "latency_optimise_ms": "optimisation"}


def found_in(value: Any) -> Iterator[Column]:
    if isinstance(value, Column):
        yield value
    elif isinstance(value, dict):
        yield from found_in(tuple(value.values()))
    elif isinstance(value, tuple):
        for one in value:
            yield from found_in(one)


def columns() -> list[tuple[str, Column]]:
    modules = map(importlib.import_module, MODULES)
    return [(name, one) for module in modules for name, value in vars(module).items() for one in found_in(value)]


@pytest.mark.parametrize(("key", "name"), NAMES.items())
def test_a_latency_is_called_the_same_everywhere(key: str, name: str) -> None:
    # Of the article on AutoCam there is one latency, which it says is a mean.
    own = [(place, one) for place, one in columns() if place != "PUBLISHED_MEAN_LATENCY"]
    assert {one.name for _, one in own if one.key == key} == {name}
    assert {one.key for _, one in own if one.name == name} == {key}
    assert all(one.short.split("\n")[0] in ("", name) for _, one in own if one.key == key)


def test_nothing_is_just_a_time() -> None:
    assert len(columns()) > 60
    assert not [one for _, one in columns() if one.name == "time" or one.short.split("\n")[0] == "time"]
