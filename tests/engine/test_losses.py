"""Time lost and regained, of arms and of features."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fabricate import record, write
from hypothesis import given
from hypothesis import strategies as st

from surgbench.report import render
from surgbench.report.losses import Losses, loss_row, losses
from surgbench.report.rows import read_rows


def test_lost_is_far_off_and_regained_is_right_again() -> None:
    assert losses([1, 11, 8, 6, 5, 8, 1], 10, 5) == Losses(7, 3, (3,), 1)  # 8 mm alone is no loss
    assert losses([11, 11, np.nan, 7], 10, 5) == Losses(3, 3, (3,), 0)  # out of view, and never regained
    assert losses([11, 4, 11, 4], 10, 5) == Losses(4, 2, (1, 1), 2)
    assert losses([], 10, 5) == losses([np.nan], 10, 5) == Losses(0, 0, (), 0)


@given(st.lists(st.sampled_from([0.0, 4.0, 7.0, 12.0, float("nan")])))
def test_counts_fit_each_other(errors: list[float]) -> None:
    found = losses(errors, 10, 5)
    assert found.lost == sum(found.taken) <= found.frames
    assert len(found.taken) - 1 <= found.regained <= len(found.taken)
    assert losses([*errors, 0.0], 10, 5).regained == len(found.taken)


def test_every_sequence_weighs_the_same() -> None:
    row = loss_row([[losses([11, 0, 0, 0], 10, 5)], [losses([0, 11], 10, 5), losses([0, 0], 10, 5)]])
    assert row == {"time_lost_share": 0.25, "losses": 2, "regained": 1, "frames_to_regain": 1.0}
    assert set(loss_row([[losses([], 10, 5)]]).values()) == {None}


def test_a_row_has_what_its_arms_lost(tmp_path: Path) -> None:
    one = record(unit="000", frames=4)
    one["errors"]["tip_error_m"] = [[0.001, 0.02], [0.011, 0.004], [0.006, 0.001], [0.004, None]]
    (row,) = read_rows([write(tmp_path, one)])
    assert row["time_lost_share"] == pytest.approx((2 / 4 + 1 / 3) / 2)
    assert (row["losses"], row["regained"], row["frames_to_regain"]) == (2, 2, 1.5)
    assert "| time lost [%] | frames to regain |" in render.markdown([row])


def test_who_loses_nothing_has_no_columns_to_read(tmp_path: Path) -> None:
    steady = record(frames=2)
    steady["errors"]["tip_error_m"] = [[0.0], [0.009]]
    (row,) = read_rows([write(tmp_path / "steady", steady)])
    assert (row["time_lost_share"], row["losses"], row["frames_to_regain"]) == (0.0, 0, None)
    assert "time lost" not in render.markdown([row])
    (row,) = read_rows([write(tmp_path / "recording", record(truth=False))])
    assert row["time_lost_share"] is None
    assert "time_lost_share" not in render.csv([row])
