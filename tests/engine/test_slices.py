"""Shares of a dataset, rows that know the truth, and rows that this machine cannot run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from commandline import RUN, STRANGERS, records, surgbench

from surgbench.dataset.open import open_as
from surgbench.errors import ConfigError
from surgbench.exchange.masks import import_masks
from surgbench.generators.generate import generate, plan_dataset
from surgbench.generators.presets import load_preset
from surgbench.registry import find
from surgbench.report.render import markdown, table
from surgbench.report.row import Row as LeaderboardRow
from surgbench.report.rows import read_rows
from surgbench.suite.asked import Conditions
from surgbench.suite.plan import complete, jobs
from surgbench.suite.slices import spread
from surgbench.tasks.instrument.asked import InstrumentRow
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.replay import replay_traces

STILL = f"{STRANGERS}:Still"
FRAMES = 4


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "mini"
    generate(plan_dataset(load_preset("mini", frames=FRAMES)), folder)
    return folder


def only(folder: Path) -> LeaderboardRow:
    (row,) = read_rows([folder])
    return row


# --- slices


def test_a_slice_takes_some_of_everything() -> None:
    """Of 16 pairs in single arms, of which the last 8 are fast: both arms and both speeds."""
    for count in (2, 4, 8, 16):
        chosen = spread(32, count)
        assert len(set(chosen)) == count
        assert sum(place < 16 for place in chosen) == count // 2  # nominal
        assert sum(place % 2 for place in chosen) == count // 2  # right arms
    assert spread(32, None) == spread(32, 32) == spread(32, 99) == list(range(32))
    assert spread(5, 1) == [0]


@pytest.mark.slow
def test_coverage_is_the_share_of_the_whole_dataset(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = (*RUN, "--dataset", dataset, "--tracker", STILL, "--out", tmp_path)
    surgbench(*command, "--sequences", 1, "--frames", 3)
    captured = capsys.readouterr()
    assert "1 runs, 3 frames to track" in captured.err
    assert "frames: 3/3" in captured.err
    (record,) = records(tmp_path)
    assert record["spec"]["frames_limit"] == record["unit_frames"] == len(record["frames"]["state"]) == 3
    row = only(tmp_path)
    assert (row["sequences"], row["frames"], row["coverage"]) == (1, 3, 3 / 8)
    assert "first 3 frames" in row["variant"]


@pytest.mark.slow
def test_a_slice_of_sequences_is_a_part_of_the_whole_run(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = (*RUN, "--dataset", dataset, "--tracker", STILL, "--out", tmp_path)
    surgbench(*command, "--sequences", 1, "--repeats", 2)
    assert only(tmp_path)["coverage"] == 0.5
    surgbench(*command, "--repeats", 2)
    assert "2 runs, 8 frames to track; 2 recorded already" in capsys.readouterr().err
    assert only(tmp_path)["coverage"] == 1.0
    assert len(records(tmp_path)) == 4


def test_a_limit_that_cuts_nothing_changes_no_hash(dataset: Path) -> None:
    data = open_as(InstrumentDataset, dataset)
    whole, uncut, cut = (
        complete(InstrumentRow(tracker="cmaes", frames=frames), Conditions(), data)
        for frames in (None, FRAMES, FRAMES - 1)
    )
    assert "frames_limit" not in whole.spec()
    assert uncut.spec() == whole.spec()
    assert cut.spec() == {**whole.spec(), "frames_limit": FRAMES - 1}
    assert jobs(uncut, data)[0].hash == jobs(whole, data)[0].hash != jobs(cut, data)[0].hash


@pytest.mark.slow
def test_rows_of_a_suite_have_slices_of_their_own(dataset: Path, tmp_path: Path) -> None:
    suite = tmp_path / "suite.yaml"
    suite.write_text(
        f"rows:\n  - {{tracker: '{STILL}', row_id: slow, sequences: 1, frames: 2}}\n  - {{tracker: '{STILL}'}}\n"
    )
    surgbench(*RUN, "--dataset", dataset, "--suite", suite, "--out", tmp_path / "runs")
    shares = {row["row_id"]: row["coverage"] for row in read_rows([tmp_path / "runs"])}
    assert shares == {"slow": 0.25, "still": 1.0}
    surgbench(*RUN, "--dataset", dataset, "--suite", suite, "--frames", 1, "--out", tmp_path / "short")
    assert {row["row_id"]: row["frames"] for row in read_rows([tmp_path / "short"])} == {"slow": 1, "still": 2}


@pytest.mark.slow
def test_a_slice_is_replayed_to_its_end(dataset: Path, tmp_path: Path) -> None:
    surgbench(*RUN, "--dataset", dataset, "--tracker", "cmaes", "--frames", 2, "--sequences", 1, "--out", tmp_path)
    (record,) = records(tmp_path)
    assert list(replay_traces(record, open_as(InstrumentDataset, dataset), [1, 3])) == [1]


@pytest.mark.slow
def test_a_small_share_is_not_shown_as_nothing(dataset: Path, tmp_path: Path) -> None:
    surgbench(*RUN, "--dataset", dataset, "--tracker", STILL, "--sequences", 1, "--out", tmp_path)
    row = only(tmp_path) | {"coverage": 160 / 32000}
    assert "| 0.5 |" in markdown([row])


# --- the truth as a filter


@pytest.mark.slow
def test_the_truth_starts_every_frame(dataset: Path, tmp_path: Path) -> None:
    """The still tracker returns its start: with this filter it makes no error, wherever the first start is."""
    surgbench(*RUN, "--dataset", dataset, "--tracker", STILL, "--filter", "truth", "--sequences", 1, "--out", tmp_path)
    for record in records(tmp_path):
        states = open_as(InstrumentDataset, dataset).sequence("000").states(record["spec"]["arms"][0])
        assert states is not None
        np.testing.assert_array_equal(record["frames"]["state"], states)
        assert record["floor"]
    row = only(tmp_path)
    assert row["floor"]
    assert row["rotation_error_rad"] == row["tip_error_m"] == 0.0
    assert row["lag_ms"] == row["start_lag_ms"] == 0.0
    assert "NOT FOR RANKING" in row["variant"]


@pytest.mark.slow
def test_a_floor_is_shown_as_one_and_never_as_the_best(dataset: Path, tmp_path: Path) -> None:
    command = (*RUN, "--dataset", dataset, "--tracker", STILL, "--sequences", 1, "--out", tmp_path)
    surgbench(*command, "--filter", "truth")
    surgbench(*command)
    surgbench(*command, "--filter", "none")
    rows = read_rows([tmp_path])
    assert [row["floor"] for row in rows] == [False, False, True]
    assert "FLOOR" in table(rows, width=80)
    floor = next(line for line in markdown(rows).splitlines() if "NOT FOR RANKING" in line)
    assert "**" not in floor


@pytest.mark.slow
def test_a_run_with_the_truth_can_be_replayed(dataset: Path, tmp_path: Path) -> None:
    surgbench(
        *RUN, "--dataset", dataset, "--tracker", "cmaes", "--filter", "truth", "--sequences", 1, "--out", tmp_path
    )
    (record,) = records(tmp_path)
    assert list(replay_traces(record, open_as(InstrumentDataset, dataset), [2])) == [2]


@pytest.mark.slow
def test_only_a_filter_that_declares_it_is_given_the_truth(dataset: Path, tmp_path: Path) -> None:
    surgbench(*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Peeking", "--sequences", 1, "--out", tmp_path)
    assert [record["status"] for record in records(tmp_path)] == ["ok"]
    assert not any(record["floor"] for record in records(tmp_path))
    with pytest.raises(ConfigError, match="needs a method 'give_truth'"):
        find("filter", f"{STRANGERS}:ForgetfulOracle")


def test_a_floor_needs_a_dataset_with_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / "source"
    (source / "masks").mkdir(parents=True)
    mask = np.zeros((30, 40), np.uint8)
    mask[10:20, :20] = 255
    cv2.imwrite(str(source / "masks" / "000000.png"), mask)
    camera = {"width": 40, "height": 30, "fx": 60.0, "fy": 61.0, "cx": 19.0, "cy": 14.5}
    (source / "camera.json").write_text(json.dumps(camera))
    import_masks(source, tmp_path / "data")
    command = (*RUN, "--dataset", tmp_path / "data", "--tracker", STILL, "--out", tmp_path / "runs")
    surgbench(*command, "--filter", "truth", expect=2)
    complaint = capsys.readouterr().err
    assert "filter 'truth' needs ground truth, which 'source' has not; use --filter kalman" in complaint
    assert complaint.count("\n") == 1


# --- what this machine lacks


def test_what_cannot_run_here_is_skipped_with_its_reason(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = (*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:NotHere", "--out", tmp_path)
    surgbench(*command)
    captured = capsys.readouterr()
    reason = "tracker 'not-here' cannot run here: needs a left-handed compiler"
    assert "0 runs, 0 frames to track; 2 cannot be run here" in captured.err
    assert f"not-here: skipped: {reason}" in captured.out
    for record in records(tmp_path):
        assert (record["status"], record["error"], record["frames"]) == ("skipped", reason, {})
    row = only(tmp_path)
    assert (row["status"], row["error"], row["coverage"]) == ("skipped", reason, 0.0)
    assert f"- not-here: skipped: {reason}" in markdown([row])


@pytest.mark.slow
def test_what_was_skipped_is_tried_again(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = (*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:NotHere", "--sequences", 1, "--out", tmp_path)
    surgbench(*command)
    cls: Any = find("tracker", f"{STRANGERS}:NotHere").cls
    monkeypatch.setattr(cls, "unavailable", classmethod(lambda cls: None))
    capsys.readouterr()
    surgbench(*command)
    captured = capsys.readouterr()
    assert "1 runs, 4 frames to track" in captured.err
    assert "failed before" not in captured.err
    assert [record["status"] for record in records(tmp_path)] == ["ok"]


@pytest.mark.slow
@pytest.mark.parametrize(("tracker", "code"), [("Still", 0), ("ReturnsNan", 1)])
def test_skips_alone_are_no_failure_and_hide_none(dataset: Path, tmp_path: Path, tracker: str, code: int) -> None:
    trackers = ("--tracker", f"{STRANGERS}:NotHere", "--tracker", f"{STRANGERS}:{tracker}")
    surgbench(*RUN, "--dataset", dataset, *trackers, "--sequences", 1, "--out", tmp_path, expect=code)
    assert [row["status"] for row in read_rows([tmp_path])].count("skipped") == 1


def test_a_plugin_that_cannot_tell_is_not_run() -> None:
    reason = find("tracker", f"{STRANGERS}:CannotTell").unavailable
    assert reason == "unavailable() raised OSError: no such driver"
    assert find("tracker", STILL).unavailable is None
    assert find("tracker", "cmaes").unavailable is None


def test_the_list_says_what_cannot_run_here(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cls: Any = find("tracker", "cmaes").cls
    monkeypatch.setattr(cls, "unavailable", classmethod(lambda cls: "no such luck"))
    surgbench("list", "trackers")
    lines = capsys.readouterr().out.splitlines()
    place = next(i for i, line in enumerate(lines) if line.startswith("cmaes "))
    assert lines[place + 1] == "  not available here: no such luck"
