"""Cameras that several tests use, how Hypothesis is set, and what is left out where PyTorch is not installed."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from surgbench.camera import Camera

# A first call may compile, and the machine be busy: time is nothing to be tested.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

# Only tools/lowest.py does without: PyTorch is a dependency, but too large to be had for every interpreter.
NO_TORCH = find_spec("torch") is None


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Files of tests that import PyTorch at their top cannot be collected without it."""
    if not NO_TORCH or collection_path.suffix != ".py":
        return None
    text = collection_path.read_text(encoding="utf-8")
    return re.search(r"^(import|from) torch\b", text, flags=re.MULTILINE) is not None or None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests marked `torch` use it by way of a plug-in."""
    for item in items:
        if NO_TORCH and item.get_closest_marker("torch"):
            item.add_marker(pytest.mark.skip(reason="PyTorch is not installed"))


@pytest.fixture(autouse=True)
def ctrl_c_is_heard() -> Iterator[None]:
    """Here and in what is started: a shell's background job ignores Ctrl-C, and its children inherit that."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    if before is signal.SIG_IGN:
        signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def camera() -> Camera:
    """The camera of the paper's code for 700 x 493 pixels."""
    return Camera(width=700, height=493, fx=905.955, fy=904.820, cx=294.280, cy=238.699)


@pytest.fixture(scope="session")
def small_camera() -> Camera:
    """An eighth of the paper's camera, fast enough for brute force."""
    return Camera(width=88, height=62, fx=113.2, fy=113.1, cx=36.3, cy=29.4)
