"""Two arms: what trackers are shown of them, what they may answer, and what is kept and measured of it."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commandline import records, surgbench
from small_dataset import list_anew, make_pair, states_of

from surgbench import pair_metrics
from surgbench.dataset.masks import encode_mask
from surgbench.errors import InvalidAnswerError
from surgbench.report.rows import read_rows
from surgbench.tasks.instrument.format import MaskKind, observed_path
from surgbench.tasks.instrument.pose_table import POSE_COLUMNS, pose_columns
from surgbench.tasks.instrument.units import UnitData
from surgbench.tasks.instrument.worker import check_confidence, check_lost

BOTH: tuple[MaskKind, ...] = ("visible_left", "visible_right")
TRACKER = """
import numpy as np
from surgbench import Estimate

class Tracker:
    name = "half"

    def reset(self, scene, state, rng):
        pass

    def step(self, observation):
        told = observation.views[0].instance_masks
        share = [0.25, 0.75] if told is None else [float(mask.mean()) for mask in told]
        return Estimate(observation.start, confidence=np.array(share), lost=np.array([False, observation.index == 1]))
"""


def test_instance_masks_reach_a_tracker_as_they_lie_in_the_dataset(tmp_path: Path) -> None:
    dataset = make_pair(tmp_path, sequences=1, visible=BOTH)
    unit = dataset.units("dual")[0]
    mask = dataset.sequence("000").mask("both", 1)
    view = UnitData(dataset, unit, "none", masks="instances").observation(1).views[0]
    sent = pickle.dumps(view)
    there = pickle.loads(sent)
    assert len(sent) < mask.size  # as bits
    assert [np.array_equal(one, two) for one, two in zip(view.instance_masks or (), there.instance_masks, strict=True)]
    assert np.array_equal(there.instance_masks[1], dataset.sequence("000").mask("visible_right", 1))
    assert UnitData(dataset, unit, "none").observation(1).views[0].instance_masks is None
    alone = UnitData(dataset, dataset.units("single")[0], "none", masks="instances")
    assert alone.observation(1).views[0].instance_masks is None


def test_the_arms_of_a_recording_are_instances(tmp_path: Path) -> None:
    assert (
        make_pair(tmp_path / "with", truth=True).sequences[0].instance_kinds is None
    )  # as if the other were not there
    assert make_pair(tmp_path / "without", truth=False).sequences[0].instance_kinds == ("left", "right")


@pytest.mark.slow
def test_masks_are_what_there_is_and_each_arm_has_its_own_confidence(tmp_path: Path) -> None:
    (tmp_path / "half.py").write_text(TRACKER)
    make_pair(tmp_path / "told", sequences=1, visible=BOTH, name="told")
    make_pair(tmp_path / "plain", sequences=1, name="plain")
    run: tuple[Any, ...] = (
        "--tracker",
        f"{tmp_path / 'half.py'}:Tracker",
        "--arms",
        "dual",
        "--out",
        tmp_path / "runs",
    )
    for folder, masks in (("told", ()), ("told", ("--masks", "union")), ("plain", ())):
        surgbench("run", "--dataset", tmp_path / folder, *run, *masks)
    found = records(tmp_path / "runs")
    shown = {(one["spec"]["dataset"]["name"], one["spec"].get("masks")): one["frames"] for one in found}
    assert set(shown) == {("told", "instances"), ("told", None), ("plain", None)}
    for (_, masks), frames in shown.items():
        assert frames["lost"] == [False, True, False, False]
        assert frames["lost_arms"][1] == [False, True]
        assert (frames["confidence_arms"][0] == [0.25, 0.75]) == (masks is None)
        assert frames["confidence"] == [min(arms) for arms in frames["confidence_arms"]]
    rows = read_rows([tmp_path / "runs"])
    assert sorted(row["masks"] for row in rows) == ["instances", "union", "union"]


@pytest.mark.slow
def test_a_row_of_single_arms_has_no_column_of_masks(tmp_path: Path) -> None:
    (tmp_path / "still.py").write_text(
        TRACKER.replace("np.array(share)", "0.5").replace("np.array([False, observation.index == 1])", "False")
    )
    make_pair(tmp_path / "data", sequences=1, visible=BOTH)
    surgbench(
        "run",
        "--dataset",
        tmp_path / "data",
        "--tracker",
        f"{tmp_path / 'still.py'}:Tracker",
        "--out",
        tmp_path / "runs",
    )
    assert "masks" not in read_rows([tmp_path / "runs"])[0]
    assert all("lost_arms" not in one["frames"] for one in records(tmp_path / "runs"))


@pytest.mark.parametrize(
    ("visible", "arms", "words"),
    [
        ((), "dual", "has no masks of what shows of each arm"),
        (BOTH[:1], "dual", "has only 'visible_left'"),
        (BOTH, "single", "use --arms dual"),
    ],
)
def test_masks_of_instances_that_are_not_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], visible: Any, arms: str, words: str
) -> None:
    make_pair(tmp_path / "data", sequences=1, visible=visible)
    asked = ("run", "--dataset", tmp_path / "data", "--tracker", "hybrid", "--arms", arms, "--masks", "instances")
    surgbench(*asked, "--out", tmp_path / "runs", expect=2)
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert words in line
    assert "--masks instances" in line


def test_confidence_and_lost_are_of_all_arms_or_of_each() -> None:
    assert check_confidence(0.5, 2, "it").tolist() == [0.5, 0.5]
    assert check_confidence([0.5, 1], 2, "it").tolist() == [0.5, 1.0]
    assert check_lost(True, 2, "it").tolist() == [True, True]
    assert check_lost(np.array([True, False]), 2, "it").tolist() == [True, False]
    for wrong in ([0.5], [0.5, np.nan], "high", [[0.5, 0.5]]):
        with pytest.raises(InvalidAnswerError, match="it returned a confidence"):
            check_confidence(wrong, 2, "it")
    with pytest.raises(InvalidAnswerError, match=r"'lost' of shape \(3,\)"):
        check_lost(np.zeros(3, dtype=bool), 2, "it")


# --- whose track is whose


def test_a_swap_lasts_and_hidden_frames_are_passed_over() -> None:
    everywhere = np.ones(60, dtype=bool)
    turned = np.zeros(60, dtype=bool)
    turned[5:14] = True  # one too few
    assert pair_metrics.swaps(turned, everywhere) == 0
    turned[14] = True
    assert pair_metrics.swaps(turned, everywhere) == 1
    turned[30:50] = True
    assert pair_metrics.swaps(turned, everywhere) == 2
    counts = everywhere.copy()
    counts[15:30] = False  # between the two nobody can tell: it is one
    assert pair_metrics.swaps(turned, counts) == 1
    assert pair_metrics.swaps(turned, ~everywhere) == 0
    assert pair_metrics.swaps(turned[:0], everywhere[:0]) == 0


def test_one_estimate_on_the_other_arm_is_no_exchange() -> None:
    """Both on one arm: one has slipped; each a little nearer to the other: exchanged."""
    truth = np.zeros((3, 2, 2, 3))
    truth[:, 1, :, 0] = 0.04
    estimate = truth.copy()
    estimate[1, 0, :, 0] = 0.04
    estimate[2, :, :, 0] = [[0.021, 0.021], [0.019, 0.019]]
    estimate[2, 0] = estimate[2, 0, ::-1]  # jaws have no order
    distances = pair_metrics.tip_distances(estimate, truth)
    np.testing.assert_allclose(distances[2], [[0.021, 0.019], [0.019, 0.021]])
    assert pair_metrics.exchanged(distances).tolist() == [False, False, True]


def test_tracks_have_a_while_to_come_out_right() -> None:
    away = np.zeros((100, 2), dtype=bool)
    away[10:20, 1] = away[60:70, 0] = away[95:, 0] = True
    turned = np.zeros(100, dtype=bool)
    turned[20:49] = True
    assert pair_metrics.right_way_round(turned, away).tolist() == [1.0, 1.0]  # the third one does not end
    turned[49] = True
    turned[90:] = True
    assert pair_metrics.right_way_round(turned, away).tolist() == [0.0, 0.0]
    assert pair_metrics.right_way_round(turned[:10], away[10:20]).size == 0


EXCHANGING = """
import numpy as np
from surgbench import Estimate

class Tracker:
    name = "exchanging"

    def reset(self, scene, state, rng):
        pass

    def step(self, observation):
        start = observation.start
        if observation.index >= 4:
            start = np.concatenate([start[9:], start[:9]])
        hidden = 6 <= observation.index < 8
        return Estimate(start, confidence=np.array([0.9, 0.1]), lost=np.array([False, hidden]))
"""


@pytest.mark.slow
def test_a_run_tells_swaps_and_what_was_said_of_hidden_arms(tmp_path: Path) -> None:
    """The tracker starts each frame from the truth, and names the arms wrongly from the fifth frame on."""
    (tmp_path / "exchanging.py").write_text(EXCHANGING)
    hidden = range(5, 8)
    make_pair(tmp_path / "data", sequences=1, frames=20, visible=BOTH, hidden=hidden)
    surgbench("validate", tmp_path / "data")
    run: tuple[Any, ...] = ("--tracker", f"{tmp_path / 'exchanging.py'}:Tracker", "--arms", "dual", "--filter", "truth")
    surgbench("run", "--dataset", tmp_path / "data", *run, "--out", tmp_path / "runs")
    (row,) = read_rows([tmp_path / "runs"])
    assert (row["swaps"], row["overlaps"], row["right_way_round"]) == (1, 1, 0.0)
    assert row["hidden_known"] == pytest.approx(2 / 3)
    assert row["far_off_doubted"] == pytest.approx(0.5)  # of each frame the right arm alone
    assert row["frames_to_recover"] == 12
    assert row["tip_error_m"] == pytest.approx((row["tip_error_m_left"] + row["tip_error_m_right"]) / 2)
    (record,) = records(tmp_path / "runs")
    assert np.array(record["errors"]["mask_error_arms"])[:4].max() < 0.05 < record["errors"]["mask_error_arms"][4][0]
    assert "left and right are exchanged" in record["hint"]


@pytest.mark.parametrize(
    ("how", "words"),
    [("alike", "the same in all 4 frames"), ("gone", "right arm's own mask shows no"), ("turned", "other way round")],
)
def test_odd_masks_of_a_recording_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], how: str, words: str
) -> None:
    root = tmp_path / "data"
    dataset = make_pair(root, truth=False, sequences=1)
    for frame in range(4):
        left, right = (dataset.sequence("000").mask(arm, frame) for arm in ("left", "right"))
        pair = {"alike": (left, left), "gone": (left, left & False), "turned": (right, left)}[how]
        for arm, mask in zip(("left", "right"), pair, strict=True):
            (root / observed_path("000", arm, frame)).write_bytes(encode_mask(mask))
    list_anew(root)
    lines = ["sequence,arm,frame," + ",".join(POSE_COLUMNS)]
    for arm in ("left", "right"):
        poses = pose_columns(states_of(arm))
        lines += [f"000,{arm},{frame}," + ",".join(map(repr, pose.tolist())) for frame, pose in enumerate(poses)]
    (tmp_path / "poses.csv").write_text("\n".join(lines) + "\n")
    surgbench("score", root, tmp_path / "poses.csv", "--name", "mine", "--arms", "dual", "--out", tmp_path / "runs")
    assert words in capsys.readouterr().err
    (row,) = read_rows([tmp_path / "runs"])
    assert row["mask_error_arms"] is not None


def test_readings_of_the_other_arm_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Masks and estimates agree; the readings say that left and right are exchanged somewhere."""
    root = tmp_path / "data"
    make_pair(root, truth=False, sequences=1)
    lines = ["sequence,arm,frame," + ",".join(POSE_COLUMNS)]
    for arm, other in (("left", "right"), ("right", "left")):
        poses = pose_columns(states_of(other))
        lines += [f"000,{arm},{frame}," + ",".join(map(repr, pose.tolist())) for frame, pose in enumerate(poses)]
        for frame in range(4):  # masks as the estimates
            (root / observed_path("000", arm, frame)).write_bytes(masks_of(tmp_path / "plain", other, frame))
    list_anew(root)
    (tmp_path / "poses.csv").write_text("\n".join(lines) + "\n")
    surgbench("score", root, tmp_path / "poses.csv", "--name", "mine", "--arms", "dual", "--out", tmp_path / "runs")
    assert "joint readings fit far better the other way round" in capsys.readouterr().err
    (record,) = records(tmp_path / "runs")
    assert "left and right are exchanged" in record["hint"]


def masks_of(root: Path, arm: str, frame: int) -> bytes:
    """The file of an arm's mask, of the same pair untouched."""
    if not root.exists():
        make_pair(root, truth=False, sequences=1)
    return (root / observed_path("000", arm, frame)).read_bytes()


@pytest.mark.slow
def test_a_pair_whose_run_fails_at_once_has_a_row_all_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """There is not one estimate, and of no error an axis of arms."""
    (tmp_path / "fails.py").write_text(TRACKER.replace("told = ", "raise ValueError('no')\n        told = "))
    make_pair(tmp_path / "data", sequences=1, visible=BOTH)
    tracker = f"{tmp_path / 'fails.py'}:Tracker"
    run = ("run", "--dataset", tmp_path / "data", "--tracker", tracker, "--arms", "dual", "--out", tmp_path / "runs")
    surgbench(*run, "--keypoints", "observed", expect=1)
    captured = capsys.readouterr()
    assert "ValueError: no" in captured.err
    assert "Traceback" not in captured.err
    (row,) = read_rows([tmp_path / "runs"])
    assert row.get("tip_error_m_left") is None
