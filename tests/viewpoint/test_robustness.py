"""Errors over levels of disturbance: which rows make a curve, the table, and the picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surgbench.report.field import keys
from surgbench.reproduce.load import load_table
from surgbench.tasks.viewpoint.robustness import FAMILIES, Level, curves, draw_robustness, robustness_table
from surgbench.tasks.viewpoint.rows import VIEWPOINT_COLUMNS
from surgbench.viewpoint.disturbance import Disturbance


def row(**values: Any) -> dict[str, Any]:
    """A line of the leaderboard."""
    return {**dict.fromkeys(keys(VIEWPOINT_COLUMNS)), "label": "A", "row_id": "a", "samples": 10, **values}


def level(controller: str, vva_deg: float, **levels: float) -> Level:
    errors = {"vva_deg": vva_deg, "fd_mm": 10 * vva_deg, "vva_true_deg": 2 + vva_deg}
    return Level(controller, Disturbance(**levels).levels(), row(**errors))


FOUND = [
    level("gaze", 0.1),
    level("gaze", 0.4, noise_m=2e-3, noise_rad=0.04),
    level("gaze", 0.2, noise_m=1e-3, noise_rad=0.02),
    level("gaze", 0.3, told_lag=1.5),
    level("gaze", 0.15, told_lag=0.5),
    level("gaze", 9.0, told_lag=0.5, noise_m=1e-3),
    level("autocam", 1.0),
    level("autocam", 1.2, noise_m=1e-3),
]


def test_a_curve_is_of_one_disturbance_and_begins_where_there_is_none() -> None:
    noise = curves(FOUND, "noise_m")
    assert {name: [at for at, _ in line] for name, line in noise.items()} == {
        "gaze": [0.0, 1e-3, 2e-3],
        "autocam": [0.0, 1e-3],
    }
    assert [found["vva_deg"] for _, found in noise["gaze"]] == [0.1, 0.2, 0.4]
    # Of the lag, the true one is in the middle; one point alone makes no curve, and two disturbances neither.
    assert {name: [at for at, _ in line] for name, line in curves(FOUND, "told_lag").items()} == {
        "gaze": [0.5, 1.0, 1.5]
    }
    assert curves(FOUND, "dropouts") == {}


def test_every_disturbance_belongs_to_a_curve() -> None:
    known = {*FAMILIES, *(other for beside, _, _ in FAMILIES.values() for other in beside)}
    assert known == {*Disturbance.__dataclass_fields__}


def test_the_table_says_by_what_a_row_is_disturbed() -> None:
    words = ", ".join(Disturbance(noise_m=1e-3).words())
    text = robustness_table([row(vva_deg=0.1), row(row_id="b", vva_deg=0.2, disturbance=words)])
    assert "| A | `a` | nothing | 10 | 0.10 |" in text
    assert "| A | `b` | noise 0.001 m | 10 | 0.20 |" in text


def test_the_reproduced_table_has_each_controller_under_every_disturbance() -> None:
    block = load_table("autocam").table.block("robustness")
    asked: dict[str, list[dict[str, float]]] = {}
    for one in block.rows:
        levels = {name: getattr(one, name) for name in Disturbance.__dataclass_fields__}
        asked.setdefault(one.tracker, []).append(Disturbance(**levels).levels())
    assert set(asked) >= {"gaze", "autocam", "horizon"}
    first, *others = asked.values()
    assert {} in first
    assert {name for levels in first for name in levels} == {*Disturbance.__dataclass_fields__}
    assert all(other == first for other in others)


@pytest.mark.extras
def test_the_picture_is_drawn_where_there_is_a_curve(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    assert draw_robustness(FOUND, tmp_path / "robustness.png", "Disturbed")
    assert (tmp_path / "robustness.png").read_bytes().startswith(b"\x89PNG")
    assert not draw_robustness(FOUND[:1], tmp_path / "none.png", "Disturbed")
    assert not (tmp_path / "none.png").exists()
    unknown = [Level("gaze", {}, row(vva_deg=0.1)), Level("gaze", {"noise_m": np.float64(1e-3)}, row())]
    assert draw_robustness(unknown, tmp_path / "failed.png", "A row that failed leaves a gap")
