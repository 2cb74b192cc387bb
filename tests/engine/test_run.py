"""Runs from the command line to records: strangers' trackers, failures, resuming, determinism."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commandline import AMPLE_S, RUN, STRANGERS, kill_before, records, surgbench, wait_until

from surgbench.dataset.open import open_as
from surgbench.generators.generate import generate, plan_dataset
from surgbench.generators.presets import load_preset
from surgbench.processes.child import Child, ChildProblemError
from surgbench.processes.pool import ProcessPool
from surgbench.suite import forecast
from surgbench.suite.asked import Conditions
from surgbench.suite.claim import claim
from surgbench.suite.forecast import by_row, forecasts, seconds_in_all
from surgbench.suite.plan import complete, jobs
from surgbench.tasks.instrument.asked import InstrumentRow
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.in_process import answers
from surgbench.tasks.instrument.records import (
    ABSENT,
    ARM_COLUMNS,
    JUDGED,
    PAIR_COUNTS,
    PAIR_ERRORS,
    REFERENCE_ERRORS,
    SOURCE_COLUMNS,
    SOURCE_ERROR,
    InstrumentFrames,
    InstrumentRecord,
)
from surgbench.tasks.instrument.replay import replay_traces

FRAMES = 4


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "mini"
    generate(plan_dataset(load_preset("mini", frames=FRAMES)), folder)
    return folder


TIMES_AND_MACHINE = ("latency", "initialise_s", "elapsed_s", "calibration_ms", "environment", "seal")


def without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: without_times(v) for k, v in value.items() if not k.startswith(TIMES_AND_MACHINE)}
    return value


@pytest.mark.slow
def test_a_strangers_class_runs(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surgbench(*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Still", "--out", tmp_path)
    found = records(tmp_path)
    assert [record["spec"]["unit"] for record in found] == ["000-left", "000-right"]
    for record in found:
        assert record["status"] == "ok"
        assert len(record["frames"]["state"]) == FRAMES
        assert record["frames"]["state"][0] == record["frames"]["start"][0]
        assert record["calibration_ms"] > 0
        assert record["environment"]["packages"]["numpy"] == np.__version__
        assert record["spec"]["dataset"]["sha256"] == open_as(InstrumentDataset, dataset).hash
    assert "still" in capsys.readouterr().out


@pytest.mark.slow
def test_a_record_holds_what_its_model_declares(dataset: Path, tmp_path: Path) -> None:
    surgbench(*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Still", "--out", tmp_path)
    for record in records(tmp_path):
        # Of masks that are made, and of pairs, there is more.
        assert set(record["frames"]) == set(InstrumentFrames.model_fields) - {*SOURCE_COLUMNS, *ARM_COLUMNS}
        # What is said of recordings, which have no truth, or of pairs, is not said where there is one arm with truth.
        elsewhere = {*JUDGED, *REFERENCE_ERRORS, ABSENT, *PAIR_COUNTS, *PAIR_ERRORS, SOURCE_ERROR}
        assert set(record["errors"]) == set(InstrumentRecord.error_names) - elsewhere


@pytest.mark.slow
def test_a_record_that_could_not_be_read_is_not_written(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(InstrumentRecord, "error_names", ())
    surgbench(*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Still", "--out", tmp_path, expect=2)
    assert "is not declared by InstrumentRecord" in capsys.readouterr().err
    assert not records(tmp_path)


@pytest.mark.slow
def test_truth_is_the_start_and_scores_perfectly_in_the_first_frame(dataset: Path, tmp_path: Path) -> None:
    surgbench(*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Still", "--out", tmp_path, "--filter", "none")
    for record in records(tmp_path):
        for name in ("rotation_error_rad", "translation_error_m", "tip_error_m", "q1_error_rad", "keypoint_error_px"):
            assert record["errors"][name][0] == [0.0]
            assert record["errors"][name][-1][0] > 0
        # Rendered by Mitsuba, counted by the evaluator: the true mask but for ties at edges.
        assert record["errors"]["mask_error_true"][0] < 1e-3


@pytest.mark.slow
def test_the_particle_filter_runs_with_kinematics_and_says_so_without(dataset: Path, tmp_path: Path) -> None:
    asked = (*RUN, "--dataset", dataset, "--tracker", "particle-filter", "--set", "particle-filter.particles=50")
    surgbench(*asked, "--joints", "--out", tmp_path / "with")
    assert [record["status"] for record in records(tmp_path / "with")] == ["ok", "ok"]
    surgbench(*asked, "--out", tmp_path / "without", expect=1)
    for record in records(tmp_path / "without"):
        assert record["status"] == "failed"
        assert record["error"].endswith("particle-filter needs kinematics: a dataset with them, and --joints")


@pytest.mark.slow
def test_observations_hold_no_truth(dataset: Path, tmp_path: Path) -> None:
    surgbench(*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Peeking", "--out", tmp_path)
    assert all(record["status"] == "ok" for record in records(tmp_path))


@pytest.mark.slow
def test_two_files_trackers_of_one_name_are_two_rows(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, shift in (("a", 0.0), ("b", 0.01)):
        text = f"def step(self, observation):\n        return observation.start + {shift}\n"
        (tmp_path / f"{name}.py").write_text(
            f"class Still:\n    name = 'still'\n\n    def reset(self, scene, state, rng): ...\n\n    {text}"
        )
    trackers = [word for name in "ab" for word in ("--tracker", f"{tmp_path / name}.py:Still")]
    surgbench(*RUN, "--dataset", dataset, *trackers, "--out", tmp_path / "runs", "--sequences", 1)
    hashes = {record["spec"]["tracker"]["source"].rpartition("@")[2][:6] for record in records(tmp_path)}
    assert len(hashes) == 2
    capsys.readouterr()
    surgbench("report", tmp_path / "runs", "--format", "markdown")
    page = capsys.readouterr().out
    assert all(page.count(f"| still | keypoints observed, still@{digits} |") == 1 for digits in hashes)


FAILING = {
    "raises": ("Raises", "failed", "RuntimeError: no instrument anywhere", 1),
    "exits": ("Exits", "exited", "exited with code 3", 0),
    "returns-nan": ("ReturnsNan", "invalid", "NaN", 0),
    "returns-shape": ("ReturnsShape", "invalid", "returned a state of shape (7,), not (9,)", 0),
    "returns-text": ("ReturnsText", "invalid", "returned a state of str", 0),
    "certain": ("CertainOfAll", "invalid", "returned a standard deviation of 0, not above 0", 0),
    "nan-confidence": ("NanConfidence", "invalid", "confidence that is no number (nan)", 0),
}


@pytest.mark.slow
def test_a_failing_tracker_costs_its_own_row_only(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All of them and one that works in one run, for what takes long is the start of each."""
    names = ("Still", *(name for name, *_ in FAILING.values()))
    trackers = [word for name in names for word in ("--tracker", f"{STRANGERS}:{name}")]
    surgbench(*RUN, "--dataset", dataset, *trackers, "--out", tmp_path, "--jobs", "2")
    complaints = capsys.readouterr().err
    by_row: dict[str, list[dict[str, Any]]] = {}
    for record in records(tmp_path):
        by_row.setdefault(record["spec"]["tracker"]["name"], []).append(record)
    assert [record["status"] for record in by_row.pop("still")] == ["ok", "ok"]
    assert set(by_row) == set(FAILING)
    for row, (_, status, message, frames) in FAILING.items():
        failed = by_row[row][0]
        assert failed["status"] == status, row
        assert message in failed["error"], row
        assert "\n" not in failed["error"], row
        # The warm-up on the first frame fails already, except for Raises, which fails at frame 1.
        assert len(failed["frames"]["index"]) == frames, row
        assert message in complaints, row


@pytest.mark.slow
def test_a_hanging_tracker_is_given_up(dataset: Path, tmp_path: Path) -> None:
    command = (*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Hangs", "--out", tmp_path, "--jobs", "2")
    surgbench(*command, "--timeout", "5", expect=1)
    assert [record["status"] for record in records(tmp_path)] == ["timeout", "timeout"]


def test_a_childs_start_is_waited_for_longer_than_an_answer() -> None:
    with Child(1e-3, "surgbench.conformance.worker") as child:
        child.send("ready")
        assert child.ready() == ("ready",)
        with pytest.raises(ChildProblemError, match=r"^no answer within 0\.001 s$"):
            child.receive()


@pytest.mark.slow
def test_recorded_runs_are_not_run_again_and_failed_ones_are(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flag, out = tmp_path / "flag", tmp_path / "runs"
    monkeypatch.setenv("SURGBENCH_TEST_FLAG", str(flag))
    command = (*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:FailsOnce", "--out", out)
    surgbench(*command, expect=1)
    assert [record["status"] for record in records(out)] == ["failed", "failed"]
    flag.touch()
    surgbench(*command, "--keep-failed")
    assert [record["status"] for record in records(out)] == ["failed", "failed"]
    surgbench(*command)
    assert "2 failed before and are tried again" in capsys.readouterr().err
    assert [record["status"] for record in records(out)] == ["ok", "ok"]
    before = [path.stat().st_mtime_ns for path in out.rglob("*.json")]
    surgbench(*command)
    assert "2 recorded already" in capsys.readouterr().err
    assert [path.stat().st_mtime_ns for path in out.rglob("*.json")] == before


@pytest.mark.slow
def test_rows_do_not_depend_on_jobs_order_or_company(dataset: Path, tmp_path: Path) -> None:
    noisy, still = f"{STRANGERS}:Noisy", f"{STRANGERS}:Still"
    surgbench(*RUN, "--dataset", dataset, "--tracker", noisy, "--out", tmp_path / "a")
    surgbench(
        *RUN, "--dataset", dataset, "--tracker", still, "--tracker", noisy, "--jobs", "2", "--out", tmp_path / "b"
    )
    one = [without_times(record) for record in records(tmp_path / "a")]
    other = [
        without_times(record) for record in records(tmp_path / "b") if record["spec"]["tracker"]["name"] == "noisy"
    ]
    assert one == other
    surgbench(*RUN, "--dataset", dataset, "--tracker", noisy, "--seed", "1", "--out", tmp_path / "c")
    assert [record["frames"]["state"] for record in records(tmp_path / "c")] != [r["frames"]["state"] for r in one]


@pytest.mark.slow
def test_killed_in_the_middle_then_resumed_gives_the_same_rows(dataset: Path, tmp_path: Path) -> None:
    """kill -9 while the second record is written, then the same command: equal but for times and machine."""
    arguments = [*RUN, "--dataset", str(dataset), "--tracker", "cmaes", "--repeats", "2"]
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    kill_before("*-r*.json", 2, *arguments, "--out", killed)
    assert len(records(killed)) == 1
    surgbench(*arguments, "--out", killed)
    surgbench(*arguments, "--out", whole)
    assert len(records(whole)) == 4
    assert [without_times(r) for r in records(killed)] == [without_times(r) for r in records(whole)]


@pytest.mark.slow
def test_readings_reach_the_tracker(dataset: Path, tmp_path: Path) -> None:
    """The still tracker returns its start, whose joints are the readings, clipped to the limits."""
    surgbench(*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Still", "--joints", "--out", tmp_path)
    surgbench(*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Still", "--readings", "true", "--out", tmp_path)
    sequence = open_as(InstrumentDataset, dataset).sequence("000")
    limits = open_as(InstrumentDataset, dataset).instrument("large_needle_driver").search_limits
    readings, states = sequence.readings("left"), sequence.states("left")
    assert readings is not None
    assert states is not None
    for record in records(tmp_path):
        if record["spec"]["unit"] == "000-left":
            joints = np.array(record["frames"]["state"])[:, 6:]
            expected = limits.clip(readings) if record["spec"]["readings"] == "noisy" else states[:, 6:]
            # The first frame of a truth start keeps to its readings too.
            np.testing.assert_allclose(joints, expected, atol=1e-12)


@pytest.mark.slow
def test_two_arms_run_as_a_pair(dataset: Path, tmp_path: Path) -> None:
    surgbench(*RUN, "--dataset", dataset, "--tracker", "cmaes", "--arms", "dual", "--out", tmp_path)
    (record,) = records(tmp_path)
    assert record["status"] == "ok"
    assert np.shape(record["frames"]["state"]) == (FRAMES, 18)
    assert np.shape(record["errors"]["rotation_error_rad"]) == (FRAMES, 2)


@pytest.mark.slow
def test_replay_shows_the_runs_own_samples(dataset: Path, tmp_path: Path) -> None:
    surgbench(*RUN, "--dataset", dataset, "--tracker", "cmaes", "--out", tmp_path)
    record = records(tmp_path)[0]
    traces = replay_traces(record, open_as(InstrumentDataset, dataset), [0, 2])
    assert list(traces) == [0, 2]
    assert [len(trace.states) for trace in traces.values()] == [3, 3]
    best = min(range(3), key=lambda k: traces[2].losses[k][0])
    assert traces[2].states[best][0].tolist() == record["frames"]["state"][2]


@pytest.mark.slow
def test_lags_and_the_filters_time_are_recorded(dataset: Path, tmp_path: Path) -> None:
    """The still tracker stays where it began while the instrument moves on: it trails behind."""
    surgbench(*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Still", "--out", tmp_path, "--filter", "none")
    for record in records(tmp_path):
        errors, frames = record["errors"], record["frames"]
        assert errors["lag_ms"] == errors["start_lag_ms"]
        assert errors["lag_ms"][0] > 0
        for filter_ms, all_ms in zip(frames["latency_filter_ms"], frames["latency_ms"], strict=True):
            assert 0 < filter_ms < all_ms


@pytest.mark.slow
def test_dry_run_tells_time_and_disk_and_writes_nothing(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ask = (*RUN, "--dataset", dataset, "--tracker", "cmaes", "--tracker", f"{STRANGERS}:Raises")
    surgbench(*ask, "--dry-run", "--out", tmp_path / "runs")
    assert not (tmp_path / "runs").exists()
    captured = capsys.readouterr()
    assert "4 runs, 16 frames" in captured.err
    assert captured.out.count(".json") == 4
    assert re.search(r"cmaes +2 +8 +\d+ s +0\.0 +measured", captured.err)
    assert re.search(r"raises +2 +8 +– +– +–", captured.err)
    assert re.search(r"about \d+ s with --jobs 1; records of 0\.0 MB, \d+ MB free", captured.err)


@pytest.mark.slow
def test_what_a_run_will_take_is_known_from_what_one_took(dataset: Path, tmp_path: Path) -> None:
    ask = (*RUN, "--dataset", dataset, "--tracker", "cmaes", "--set", "cmaes.iterations=1", "--out", tmp_path)
    surgbench(*ask, "--sequences", 1)
    (record,) = records(tmp_path)
    data = open_as(InstrumentDataset, dataset)
    row = InstrumentRow(tracker="cmaes", keypoints="observed", options={"cmaes": {"iterations": 1}})
    planned = jobs(complete(row, Conditions(), data), data)
    (found,) = forecasts(by_row(planned), data, tmp_path)
    assert (found.runs, found.frames, found.rate.known_from) == (2, 8, "records")
    assert found.seconds == pytest.approx(2 * record["elapsed_s"])
    assert found.longest_s == pytest.approx(record["elapsed_s"])
    assert seconds_in_all([found], jobs=1) == pytest.approx(found.seconds)
    assert seconds_in_all([found], jobs=8) == pytest.approx(found.longest_s)  # one run is never shared
    (path,) = tmp_path.rglob("*-r0.json")
    assert found.size_bytes == pytest.approx(2 * path.stat().st_size)


@pytest.mark.slow
@pytest.mark.parametrize("filter_name", ["kalman", "truth"])
def test_a_run_in_this_process_answers_as_a_recorded_one(dataset: Path, tmp_path: Path, filter_name: str) -> None:
    asked = ("--dataset", dataset, "--sequences", 1, "--filter", filter_name, "--seed", 7)
    surgbench(*RUN, *asked, "--tracker", "cmaes", "--out", tmp_path)
    (record,) = records(tmp_path)
    row = InstrumentRow(tracker="cmaes", keypoints="observed", filter=filter_name, sequences=1)
    data = open_as(InstrumentDataset, dataset)
    (job,) = jobs(complete(row, Conditions(seed=7), data), data)
    assert [answer.state.tolist() for answer in answers(job, data)] == record["frames"]["state"]


@pytest.mark.slow
def test_a_suite_file_runs_its_rows(dataset: Path, tmp_path: Path) -> None:
    suite = tmp_path / "suite.yaml"
    suite.write_text(
        "seed: 3\n"
        "rows:\n"
        "  - {tracker: cmaes, row_id: cmaes-1, options: {cmaes: {iterations: 1}}}\n"
        "  - {tracker: cmaes}\n"
    )
    surgbench(*RUN, "--dataset", dataset, "--suite", suite, "--set", "cmaes.population=10", "--out", tmp_path / "runs")
    by_row = {record["spec"]["row_id"]: record["spec"] for record in records(tmp_path / "runs")}
    assert by_row["cmaes-1"]["tracker"]["options"]["iterations"] == 1
    assert by_row["cmaes"]["tracker"]["options"]["iterations"] == 3
    assert all(spec["tracker"]["options"]["population"] == 10 for spec in by_row.values())
    assert all(spec["seed"] == 3 for spec in by_row.values())


def dry_run(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, list[str]]:
    """Records that a command would make, by row; their folders tell the rows' settings."""
    capsys.readouterr()
    with pytest.MonkeyPatch.context() as patch:  # how long it takes is not asked here, and would take long
        patch.setattr(forecast, "measured_rate", lambda job, data: forecast.Rate())
        surgbench(*RUN, *arguments, "--dry-run")
    paths = [Path(line) for line in capsys.readouterr().out.splitlines()]
    rows = {path.parent.name.rpartition("-")[0] for path in paths}
    return {row: [str(path) for path in paths if path.parent.name.rpartition("-")[0] == row] for row in rows}


def test_an_option_is_set_in_the_rows_in_which_its_plug_in_takes_part(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = ("--dataset", dataset, "--tracker", "cmaes", "--tracker", "xnes", "--out", tmp_path / "runs")
    before = dry_run(capsys, *both)
    one = dry_run(capsys, *both, "--set", "cmaes.iterations=1")
    assert set(before) == set(one) == {"cmaes", "xnes"}
    assert one["xnes"] == before["xnes"]
    assert one["cmaes"] != before["cmaes"]
    assert one["cmaes"] == dry_run(capsys, *both[:4], *both[6:], "--set", "cmaes.iterations=1")["cmaes"]
    shared = dry_run(capsys, *both, "--set", "kalman.noise=published")
    assert shared["cmaes"] != before["cmaes"]
    assert shared["xnes"] != before["xnes"]


def test_an_option_is_set_in_those_rows_of_a_suite_too(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    suite = tmp_path / "suite.yaml"
    suite.write_text("rows: [{tracker: cmaes, options: {cmaes: {population: 10}}}, {tracker: xnes}]\n")
    asked = ("--dataset", dataset, "--suite", suite, "--out", tmp_path / "runs")
    before, after = dry_run(capsys, *asked), dry_run(capsys, *asked, "--set", "xnes.iterations=1")
    assert after["cmaes"] == before["cmaes"]
    assert after["xnes"] != before["xnes"]


def test_an_option_that_no_row_takes_is_refused(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("--dataset", dataset, "--tracker", "cmaes", "--tracker", "xnes", "--out", tmp_path / "runs")
    surgbench(*RUN, *asked, "--set", "pycma.iterations=1", expect=2)
    complaint = capsys.readouterr().err
    assert "'pycma' takes no part in this run (taking part: cmaes, truth, kalman, observed, xnes)" in complaint


def test_an_option_of_a_suites_row_must_be_for_that_row(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    suite = tmp_path / "suite.yaml"
    suite.write_text("rows: [{tracker: cmaes, options: {xnes: {iterations: 1}}}, {tracker: xnes}]\n")
    surgbench(*RUN, "--dataset", dataset, "--suite", suite, "--out", tmp_path / "runs", expect=2)
    assert "'xnes' takes no part in this run (taking part: cmaes," in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--tracker", "cmeas"), "unknown tracker 'cmeas'; did you mean 'cmaes'?"),
        (("--tracker", "missing.py:Tracker"), "missing.py: no such file"),
        (("--tracker", f"{STRANGERS}:Stil"), "unknown class 'Stil'; did you mean 'Still'?"),
        (("--tracker", f"{STRANGERS}:NoStep"), "needs a method 'step'"),
        (("--tracker", str(STRANGERS)), "say which class"),
        (("--tracker", f"{STRANGERS}:WrongName"), "needs a 'name' of letters"),
        (("--tracker", f"{STRANGERS}:WrongConfig"), "'Config' must be a pydantic model"),
        (("--tracker", "cmaes", "--timeout", "0"), "'timeout_s'"),
        (("--tracker", "cmaes", "--set", "cmaes.iterations=true"), "'iterations'"),
        (("--tracker", "cmaes", "--set", "cmaes.iterations='5'"), "'iterations'"),
        (("--tracker", "cmaes", "--set", "cmaes.iteration=5"), "did you mean 'iterations'?"),
        (("--tracker", "cmaes", "--set", "cmaes.iterations=many"), "'iterations'"),
        (("--tracker", "cmaes", "--set", "cmaes.loss.keypoint=0"), "did you mean 'keypoints'?"),
        (("--tracker", "cmaes", "--set", "cmaes"), "NAME.option=value"),
        (("--tracker", "cmaes", "--set", "xnes.iterations=3"), "takes no part in this run"),
        (("--tracker", "cmaes", "--initialiser", "thruth"), "did you mean 'truth'?"),
        (("--tracker", "cmaes", "--filter", "kalmann"), "did you mean 'kalman'?"),
        (("--tracker", "cmaes", "--keypoints", "observd"), "did you mean 'observed'?"),
        (("--tracker", "cmaes", "--joints", "--no-joints"), "contradict each other"),
        (("--tracker", "cmaes", "--readings", "some"), "some"),
        (("--suite", "demmo"), "did you mean 'demo'?"),
        ((), "say what to run"),
        (("--tracker", "cmaes", "--trackr", "x"), "--trackr"),
    ],
)
def test_mistakes_are_answered_in_one_line(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], message: str
) -> None:
    surgbench(*RUN, "--dataset", dataset, "--out", tmp_path / "runs", *arguments, expect=2)
    complaint = capsys.readouterr().err
    assert message in complaint
    assert complaint.count("\n") == 1
    assert not (tmp_path / "runs").exists()


def test_wrong_folders_are_answered_in_one_line(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = ("run", "--tracker", "cmaes", "--dataset")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    for arguments, message in (
        ((*run, tmp_path / "nothing"), "nothing"),
        ((*run, dataset, "--out", dataset), "is a dataset"),
        ((*run, dataset, "--out", tmp_path / "other"), "holds something else ('thesis.tex')"),
        ((*run, dataset, "--out", STRANGERS), "is a file"),
    ):
        surgbench(*arguments, expect=2)
        complaint = capsys.readouterr().err
        assert message in complaint
        assert complaint.count("\n") == 1


@pytest.mark.slow
def test_a_damaged_record_is_named(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = (*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Still", "--out", tmp_path)
    surgbench(*command)
    path = next(tmp_path.rglob("000-left-r0.json"))
    path.write_text(path.read_text()[:200])
    capsys.readouterr()
    surgbench(*command, expect=2)
    assert "000-left-r0.json: damaged record" in capsys.readouterr().err


@pytest.mark.slow
def test_a_change_of_what_a_tracker_imports_is_another_tracker(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.py").write_text(
        "import helper\n\n\nclass Mine:\n    name = 'mine'\n\n    def reset(self, scene, state, rng): ...\n\n"
        "    def step(self, observation):\n        return observation.start + helper.SHIFT\n"
    )
    (tmp_path / "helper.py").write_text("SHIFT = 0.0\n")
    asked = (*RUN, "--dataset", dataset, "--tracker", f"{tmp_path / 'mine.py'}:Mine", "--out", tmp_path / "runs")
    surgbench(*asked, "--sequences", 1)
    (first,) = records(tmp_path / "runs")
    assert first["status"] == "ok"
    (tmp_path / "helper.py").write_text("SHIFT = 0.0125\n")
    capsys.readouterr()
    surgbench(*asked, "--sequences", 1)
    assert "recorded already" not in capsys.readouterr().err
    (second,) = (record for record in records(tmp_path / "runs") if record["spec_hash"] != first["spec_hash"])
    assert second["errors"]["tip_error_m"] != first["errors"]["tip_error_m"]
    assert second["spec"]["engine"] == first["spec"]["engine"]


@pytest.mark.slow
def test_again_makes_the_asked_records_anew(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = (*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Still", "--out", tmp_path)
    surgbench(*asked)
    left, right = sorted(tmp_path.rglob("*-r0.json"))
    sound = json.loads(left.read_text())
    left.write_text(left.read_text().replace('"mask_error":[', '"mask_error":[0.0,', 1))
    untouched = right.read_bytes()
    surgbench(*asked, expect=2)
    complaint = capsys.readouterr().err
    assert f"{left}: altered: its content is not what was written" in complaint
    assert "--again" in complaint
    surgbench(*asked, "--sequences", 1, "--again")
    assert "1 runs, 4 frames to track; 1 recorded already and made again" in capsys.readouterr().err
    assert without_times(json.loads(left.read_text())) == without_times(sound)
    assert right.read_bytes() == untouched
    left.write_text(left.read_text()[:200])
    surgbench(*asked, "--again")
    assert "2 recorded already and made again" in capsys.readouterr().err
    assert [record["status"] for record in records(tmp_path)] == ["ok", "ok"]
    surgbench(*asked, "--again", "--dry-run")
    assert capsys.readouterr().out.count(".json") == 2


@pytest.mark.slow
def test_two_calls_into_one_folder_share_the_work(dataset: Path, tmp_path: Path) -> None:
    out, flag = tmp_path / "runs", tmp_path / "pids"
    asked = (*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Signs", "--repeats", 3, "--out", out)
    environment = {**os.environ, "SURGBENCH_TEST_FLAG": str(flag)}

    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    calls = [subprocess.Popen(command(*asked), env=environment, **pipes) for _ in range(2)]
    said = [call.communicate(timeout=300) for call in calls]
    assert [call.returncode for call in calls] == [0, 0], said
    assert len(flag.read_text().split()) == 6
    assert said[0][0] == said[1][0]
    assert [record["status"] for record in records(out)] == ["ok"] * 6
    assert not list(out.rglob("*.lock"))


@pytest.mark.slow
def test_what_another_call_leaves_undone_is_done_here(dataset: Path, tmp_path: Path) -> None:
    """Its lock is held until it is gone; one that a killed call left behind holds nobody up."""
    asked = (*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Still", "--out", tmp_path)
    surgbench(*asked)
    left, right = sorted(tmp_path.rglob("*-r0.json"))
    left.unlink()
    right.unlink()
    right.with_name(f"{right.name}.lock").touch()
    with claim(left) as ours:
        assert ours
        process = subprocess.Popen(command(*asked), stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None
        said = ""
        while "waiting for another call's runs" not in said:
            line = process.stderr.readline()
            assert line, said
            said += line
        assert right.exists()
        assert not left.exists()
    assert process.communicate(timeout=120)[1] is not None
    assert process.returncode == 0
    assert [record["status"] for record in records(tmp_path)] == ["ok", "ok"]
    assert not list(tmp_path.rglob("*.lock"))


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-c", "from surgbench.cli import main; main()", *map(str, arguments)]


@pytest.mark.slow
def test_what_a_tracker_prints_stays_out_of_the_output(dataset: Path, tmp_path: Path) -> None:
    arguments = command(*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Prints", "--out", tmp_path)
    done = subprocess.run(arguments, capture_output=True, text=True, check=True)
    assert "seen" not in done.stdout
    assert "seen" in done.stderr


def workers(mark: str) -> set[int]:
    """The worker processes of the one run that was started with ``MARK`` in its environment."""
    found = set()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if b"surgbench.tasks.instrument.worker" not in (folder / "cmdline").read_bytes():
                continue
            if f"MARK={mark}\0".encode() in (folder / "environ").read_bytes():
                found.add(int(folder.name))
        except OSError:
            continue
    return found


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_no_tracker_outlives_an_interrupted_run(dataset: Path, tmp_path: Path, how: signal.Signals) -> None:
    mark, flag = str(tmp_path), tmp_path / "flag"
    arguments = command(*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Spins", "--out", tmp_path / "runs")
    environment = {**os.environ, "MARK": mark, "SURGBENCH_TEST_FLAG": str(flag)}
    process = subprocess.Popen(arguments, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, env=environment)
    wait_until(lambda: flag.exists() or process.poll() is not None)
    assert workers(mark)
    process.send_signal(how)
    complaint = process.communicate(timeout=AMPLE_S)[1]
    if how == signal.SIGINT:
        assert process.returncode == 130
        assert complaint.splitlines()[-1] == "surgbench: interrupted; the same command again goes on from here"
        assert "Traceback" not in complaint
    wait_until(lambda: not workers(mark))


def test_a_folder_that_cannot_be_written_is_noticed_before_the_work(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    arguments = (*RUN, "--dataset", dataset, "--tracker", f"{STRANGERS}:Still", "--out", tmp_path / "file" / "x")
    surgbench(*arguments, expect=2)
    error = capsys.readouterr().err
    assert f"{tmp_path / 'file' / 'x'}: cannot be written" in error
    assert error.count("\n") == 1  # no plan of what comes to nothing


@pytest.mark.slow
def test_a_damaged_dataset_ends_the_run_at_once(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import shutil

    damaged = tmp_path / "data"
    shutil.copytree(dataset, damaged)
    mask = damaged / "sequences/000/observed/left/000001.png"
    mask.write_bytes(mask.read_bytes()[:60])
    arguments = (*RUN, "--dataset", damaged, "--tracker", f"{STRANGERS}:Still", "--out", tmp_path / "runs")
    surgbench(*arguments, expect=2)
    assert "000001.png" in capsys.readouterr().err
    assert not records(tmp_path / "runs")


@pytest.mark.slow
def test_the_papers_tracker_follows_the_mini_dataset(tmp_path: Path) -> None:
    """What `make demo` shows: mask error at most 0.10, rotation at most 0.30 rad, without readings."""
    folder = tmp_path / "mini"
    generate(plan_dataset(load_preset("mini")), folder, workers=ProcessPool(2))
    surgbench(*RUN, "--dataset", folder, "--tracker", "cmaes", "--jobs", "2", "--out", tmp_path / "runs")
    found = records(tmp_path / "runs")
    assert np.mean([record["errors"]["mask_error"] for record in found]) <= 0.10
    assert np.mean([record["errors"]["rotation_error_rad"] for record in found]) <= 0.30


def test_a_key_given_twice_is_refused(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    suite = tmp_path / "suite.yaml"
    suite.write_text("seed: 0\nseed: 1\nrows: [{tracker: cmaes}]\n")
    surgbench(*RUN, "--dataset", dataset, "--suite", suite, "--out", tmp_path / "runs", expect=2)
    assert "'seed' is given twice" in capsys.readouterr().err
    suite.write_text("seed: '1'\nrows: [{tracker: cmaes}]\n")
    surgbench(*RUN, "--dataset", dataset, "--suite", suite, "--out", tmp_path / "runs", expect=2)
    assert "'seed'" in capsys.readouterr().err
