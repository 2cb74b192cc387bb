"""What the benchmark of stated deviations makes of errors whose spread is known."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from surgbench.trackers.registration.follower import STATED

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "stated_deviations.py"
FRAMES = 20_000


@pytest.fixture(scope="module")
def script() -> ModuleType:
    if not SCRIPT.is_file():
        pytest.skip("a wheel holds no benchmarks")
    spec = importlib.util.spec_from_file_location("stated_deviations", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_factor_is_what_beliefs_are_too_wide_by(script: ModuleType) -> None:
    """Of each component its own, whatever the frame's belief is; a few slips far off do not move it."""
    rng = np.random.default_rng(0)
    belief = rng.uniform(0.001, 0.1, (FRAMES, 9))
    factors = np.linspace(0.1, 0.5, 9)
    errors = factors * belief * rng.standard_normal((FRAMES, 9))
    errors[:100] = 3.0
    np.testing.assert_allclose(script.factor(script.Off(errors, belief, belief))[:9], factors, rtol=0.04)


def test_right_deviations_cover_what_they_say(script: ModuleType) -> None:
    rng = np.random.default_rng(1)
    belief = np.full((FRAMES, 9), 0.05)
    errors = STATED * belief * rng.standard_normal((FRAMES, 9))
    np.testing.assert_allclose(script.covered(errors, STATED * belief), 0.9, atol=0.01)
    assert script.factor(script.Off(errors, belief, belief))[-1] == pytest.approx(STATED, rel=0.02)
