"""Intervals over sequences, and rows held against others sequence by sequence."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from surgbench.report.bootstrap import mean_interval
from surgbench.report.row import Row
from surgbench.reproduce.paired import differences, with_differences
from surgbench.reproduce.table import table_model
from surgbench.task import find_task
from surgbench.tasks.viewpoint.asked import ViewpointRow


@pytest.mark.slow
def test_an_interval_covers_the_mean_as_often_as_it_says() -> None:
    """Of 12 sequences, of a normal distribution: about 95 %, rather less, as bootstraps of few have it."""
    rng = np.random.default_rng(0)
    covered = [low <= 0 <= high for low, high in filter(None, map(mean_interval, rng.standard_normal((60, 12))))]
    assert 0.85 <= np.mean(covered) <= 1.0


def test_an_interval_weighs_its_sequences() -> None:
    assert mean_interval([1.0]) is None
    assert mean_interval([]) is None
    assert mean_interval([2.0, 2.0]) == (2.0, 2.0)
    values = [100.0] * 11 + [86.0]
    plain, heavy = mean_interval(values), mean_interval(values, [1.0] * 11 + [100.0])
    assert plain is not None
    assert heavy is not None
    assert plain == mean_interval(values)  # the same again
    assert heavy[0] < plain[0] < 99.0 < plain[1] == pytest.approx(100.0)


def table(**ours: Any) -> Any:
    rows = [{"row_id": "ours", "label": "Ours", "tracker": "gaze", **ours},
            {"row_id": "theirs", "label": "Theirs", "tracker": "autocam"}]  # fmt: skip
    part = {"runs": 1, "frames": 10}
    block = {"name": "b", "heading": "B", "dataset": {"preset": "x"}, "quick_sequences": ["000"], "rows": rows}
    content = {"title": "T", "task": "viewpoint", "quick": part, "timing": part, "check": part, "blocks": [block]}
    return table_model(ViewpointRow).model_validate(content)


def line(row_id: str, unit: str, vva: float, cost: float, status: str = "ok", repeat: int = 0) -> Row:
    """A line of sequences.csv, as far as it matters."""
    return {"row_id": row_id, "unit": unit, "repeat": repeat, "status": status, "vva_deg": vva, "view_cost": cost}


LINES = [
    # Trial 1 is hard for both, and trial 2 was not finished by one: what counts is the difference within a trial.
    line("ours", "000", 1.0, 0.1), line("ours", "001", 8.0, 0.5), line("ours", "002", 3.0, 0.2),
    line("theirs", "000", 2.0, 0.3), line("theirs", "001", 8.5, 0.6), line("theirs", "002", 99.0, 9.0, "failed"),
    line("theirs", "000", 3.0, 0.5, repeat=1),
]  # fmt: skip


def test_differences_are_within_trials_that_both_have_done() -> None:
    sheet = find_task("viewpoint").sheet
    _, row = next(iter(table(against="theirs", floor="theirs").rows()))
    found = differences(row, LINES, sheet)
    assert found["against"] == "theirs"
    assert found["vva_deg_difference"] == pytest.approx((1.0 - 2.5 + 8.0 - 8.5) / 2)
    assert found["vva_deg_difference_low"] <= found["vva_deg_difference"] <= found["vva_deg_difference_high"]
    assert found["regret"] == pytest.approx((0.1 - 0.4 + 0.5 - 0.6) / 2)
    assert found["fd_mm_difference"] is None  # nobody says
    _, alone = next(iter(table().rows()))
    assert differences(alone, LINES, sheet) == {}


def test_one_trial_has_a_difference_but_no_interval() -> None:
    _, row = next(iter(table(against="theirs").rows()))
    found = differences(row, [one for one in LINES if one["unit"] == "000"], find_task("viewpoint").sheet)
    assert found["vva_deg_difference"] == pytest.approx(-1.5)
    assert found["vva_deg_difference_low"] is None


def test_whole_rows_alone_get_them_and_old_ones_go() -> None:
    sheet, task = find_task("viewpoint").sheet, find_task("viewpoint")
    whole: Row = {"row_id": "ours", **task.parts}
    part: Row = {**whole, "subset": "constrained"}
    rows = with_differences(table(against="theirs"), [whole, part], LINES, sheet)
    assert rows[0]["vva_deg_difference"] == pytest.approx(-1.0)
    assert rows[1] == part
    again = with_differences(table(), rows, LINES, sheet)
    assert again[0]["vva_deg_difference"] is None
