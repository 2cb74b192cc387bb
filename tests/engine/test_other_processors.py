"""What is promised of another processor (docs/dataset.md): libraries are told that they are on an older one."""

from __future__ import annotations

import importlib.util
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "other_processors.py"
RADIANS_OR_METRES = 1e-6
EARLY = 50  # steps
RADIANS_IN_A_CONTROLLERS_RUN = 1e-2


@pytest.fixture(scope="module")
def script() -> ModuleType:
    if not SCRIPT.is_file():
        pytest.skip("a wheel holds no benchmarks")
    spec = importlib.util.spec_from_file_location("other_processors", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.long
def test_datasets_and_estimates_of_an_older_processor(script: ModuleType, tmp_path: Path) -> None:
    """Numba is left as it is: it would compile everything anew. The script does that too."""
    old = {name: value for one in ("numpy", "torch", "blas") for name, value in script.PROCESSORS[one].items()}
    with ThreadPoolExecutor(2) as pool:
        plain, other = pool.map(script.take, (tmp_path / "plain", tmp_path / "old"), ({}, old))
    files, estimates = script.compare(plain, other)
    assert not [name for name in files if name.endswith(".png")]
    assert all(far is not None and far <= script.TABLES for far in files.values()), files
    assert set(estimates) == {"cmaes", "hybrid", "gaze"}
    assert max(estimates["cmaes"], estimates["hybrid"]) < RADIANS_OR_METRES, estimates
    # A search that ends by a tolerance ends a step sooner or later once, and the difference fades again.
    ours, theirs = (taken["estimates"]["gaze"][:EARLY] for taken in (plain, other))
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=RADIANS_OR_METRES)
    assert estimates["gaze"] < RADIANS_IN_A_CONTROLLERS_RUN, estimates
