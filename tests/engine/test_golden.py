"""What a change of the code's structure must leave as it is: ``tests/golden.py`` says what."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import golden
import numpy as np
import pytest

GOLDEN: dict[str, Any] = json.loads(Path(golden.__file__).with_name("golden.json").read_text())
# Other processors round differently, and a search by samples then takes other samples; what is meant here is another
# method, other numbers drawn or another order of the arms.
RADIANS_OR_METRES = 1e-6
PROMISED = 1e-9  # of datasets, on any processor


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The same, made now."""
    return golden.take(tmp_path_factory.mktemp("golden"))


@pytest.mark.slow
@pytest.mark.long
def test_settings_of_all_rows_of_all_tables(found: dict[str, Any]) -> None:
    assert found["settings"] == GOLDEN["settings"]


@pytest.mark.slow
@pytest.mark.long
def test_datasets_are_the_same_bytes_here_and_the_same_numbers_elsewhere(found: dict[str, Any]) -> None:
    for name, golden_dataset in GOLDEN["datasets"].items():
        made = found["datasets"][name]
        assert made["numbers"].keys() == golden_dataset["numbers"].keys()
        for table, numbers in golden_dataset["numbers"].items():
            np.testing.assert_allclose(made["numbers"][table], numbers, atol=PROMISED, rtol=0, err_msg=table)
        if found["processor"] == GOLDEN["processor"]:
            assert made["sha256"] == golden_dataset["sha256"], name


@pytest.mark.slow
@pytest.mark.long
def test_estimates_of_all_trackers(found: dict[str, Any]) -> None:
    assert set(found["estimates"]) >= set(GOLDEN["estimates"])  # a machine may have what another lacks
    for row, estimates in GOLDEN["estimates"].items():
        if isinstance(estimates, str):
            assert found["estimates"][row] == estimates
        else:
            np.testing.assert_allclose(found["estimates"][row], estimates, atol=RADIANS_OR_METRES, rtol=0, err_msg=row)
