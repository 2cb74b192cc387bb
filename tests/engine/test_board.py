"""A leaderboard that others join: what is handed in fits or is refused, and whatever is in the file harms nobody."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commandline import RUN, STRANGERS, records, surgbench
from small_dataset import make_pair, states_of

from surgbench.board.submission import ABOUT, read_submission
from surgbench.board.verify import choose
from surgbench.dataset.open import open_as
from surgbench.errors import DatasetError, SurgbenchError
from surgbench.files import canonical_json, sha256_bytes
from surgbench.records.seal import SEAL, sealed
from surgbench.suite.running import Run
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.rescored import rescore

pytestmark = pytest.mark.slow

Change = Callable[[dict[str, Any]], None]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_pair(tmp_path_factory.mktemp("board") / "pair", sequences=2).path


@pytest.fixture(scope="module")
def runs(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs")
    surgbench(*RUN, "--dataset", data, "--tracker", "cmaes", "--set", "cmaes.iterations=1", "--out", out)
    return out


@pytest.fixture(scope="module")
def handed_in(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("in") / "mine.zip"
    surgbench("submit", runs, "--by", "A Lab", "--statement", "one iteration", "--out", out)
    return out


def repacked(handed_in: Path, out: Path, change: Change, first: int = 0) -> Path:
    """A submission like another one, one record of which was changed by somebody who knows how it is sealed."""
    with zipfile.ZipFile(handed_in) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    about = json.loads(files[ABOUT])
    listed = about["records"][first]
    record = json.loads(files[listed["file"]])
    del record[SEAL]
    change(record)
    files[listed["file"]] = canonical_json(sealed(record)).encode()
    listed["sha256"] = sha256_bytes(files[listed["file"]])
    files[ABOUT] = json.dumps(about).encode()
    return packed(out, files)


def packed(out: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return out


def test_what_is_right_fits(data: Path, runs: Path, handed_in: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("verify", handed_in, "--dataset", data, "--again", 2)
    said = capsys.readouterr()
    assert said.out.splitlines()[-1] == "fits: 4 scored again, 2 run again"
    assert "cmaes by A Lab, made with surgbench" in said.err
    assert "one iteration" in said.err
    assert said.err.count("4 estimates bit for bit") == 2


def test_the_same_runs_are_the_same_bytes(runs: Path, handed_in: Path, tmp_path: Path) -> None:
    surgbench("submit", runs, runs, "--by", "A Lab", "--statement", "one iteration", "--out", tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == handed_in.read_bytes()


def test_errors_that_are_not_those_of_the_estimates_are_refused(
    data: Path, handed_in: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def better(record: dict[str, Any]) -> None:
        record["errors"]["tip_error_m"] = [[0.0]] * 4

    forged = repacked(handed_in, tmp_path / "forged.zip", better)
    surgbench("verify", forged, "--dataset", data, "--again", 0, expect=1)
    last = capsys.readouterr().out.splitlines()[-1]
    assert re.match(
        r"refused: cmaes 00\d-\w+ r0: scored again: differs: tip_error_m of frame 0 is 0\.00\d+, not 0", last
    )


def test_estimates_that_the_tracker_does_not_make_are_refused(
    data: Path, handed_in: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The truth is handed in, its errors measured as ours are: only who runs the tracker again finds out."""
    dataset = open_as(InstrumentDataset, data)

    def true(record: dict[str, Any]) -> None:
        arm, sequence = record["spec"]["unit"].split("-")[1], int(record["spec"]["sequence"])
        record["frames"]["state"] = states_of(arm, sequence=sequence).tolist()
        record["errors"] |= rescore(record, dataset, Run())

    forged = repacked(handed_in, tmp_path / "forged.zip", true)
    assert np.max(read_submission(forged).records[0].errors["tip_error_m"]) < 1e-9  # the truth scores perfectly
    surgbench("verify", forged, "--dataset", data, "--again", 4, expect=1)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("refused: ")]
    assert "run again: differs: mean " in line


def test_a_row_is_about_all_of_a_dataset(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ask = (*RUN, "--dataset", data, "--tracker", f"{STRANGERS}:Still", "--sequences", 1, "--out", tmp_path / "runs")
    surgbench(*ask)
    surgbench("submit", tmp_path / "runs", "--by", "me", "--out", tmp_path / "mine.zip")
    surgbench("verify", tmp_path / "mine.zip", "--dataset", data, expect=1)
    assert "refused: still: 1 of 4 units of 'pairs'; a row is about all of them" in capsys.readouterr().out


def test_a_strangers_tracker_is_run_where_it_is_named(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    surgbench(*RUN, "--dataset", data, "--tracker", f"{STRANGERS}:Still", "--out", tmp_path / "runs")
    surgbench("submit", tmp_path / "runs", "--by", "me", "--out", tmp_path / "mine.zip")
    ask = ("verify", tmp_path / "mine.zip", "--dataset", data, "--again", 1)
    surgbench(*ask)
    said = capsys.readouterr()
    assert "fits as far as could be seen: 4 scored again, 0 run again, 1 unknown" in said.out
    assert (
        "run again: unknown: tracker 'still' cannot be run here; where it is: --tracker still=FILE.py:Class" in said.err
    )
    surgbench(*ask, "--tracker", f"still={STRANGERS}:Still")
    assert "fits: 4 scored again, 1 run again" in capsys.readouterr().out
    surgbench(*ask, "--tracker", f"still={STRANGERS}:Noisy")
    assert "is not the tracker 'still' that was run (its code is " in capsys.readouterr().err
    surgbench(*ask, "--tracker", "still", expect=2)
    assert "--tracker still: must be NAME=FILE.py:Class" in capsys.readouterr().err


def test_runs_that_failed_or_knew_the_truth_are_not_handed_in(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ask = (*RUN, "--dataset", data, "--sequences", 1)
    surgbench(*ask, "--tracker", f"{STRANGERS}:Raises", "--out", tmp_path / "failed", expect=1)
    surgbench(*ask, "--tracker", f"{STRANGERS}:Still", "--filter", "truth", "--out", tmp_path / "floor")
    for folder, words in (
        ("failed", "failed ("),
        ("floor", "is a floor, which knew the truth"),
        ("no", "no such folder"),
    ):
        capsys.readouterr()
        surgbench("submit", tmp_path / folder, "--by", "me", "--out", tmp_path / "mine.zip", expect=2)
        assert words in capsys.readouterr().err
    assert not (tmp_path / "mine.zip").exists()


def test_a_dataset_that_is_not_here_verifies_nothing(
    handed_in: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = make_pair(tmp_path / "other", name="other", sequences=1).path
    surgbench("verify", handed_in, "--dataset", other, expect=2)
    assert "nothing of it can be scored here: its dataset 'pairs' is not here" in capsys.readouterr().err


def test_nobody_who_hands_in_knows_what_is_run_again(handed_in: Path) -> None:
    submission = read_submission(handed_in)
    chosen = {tuple(choose(submission, 2, salt)) for salt in map(str, range(50))}
    assert len(chosen) == 6  # all pairs of four come up
    assert choose(submission, 2, "x") == choose(submission, 2, "x")


def test_whatever_is_in_the_file_is_one_line(handed_in: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(handed_in) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    about = json.loads(files[ABOUT])
    first = about["records"][0]["file"]

    def with_about(**changes: Any) -> dict[str, bytes]:
        return {**files, ABOUT: json.dumps({**about, **changes}).encode()}

    outside = [{**about["records"][0], "file": "../../evil.json"}]
    damaged: dict[str, tuple[dict[str, bytes], str]] = {
        "outside": (with_about(records=outside), "file"),
        "unlisted": ({**files, "../evil.json": b"{}"}, "holds what it does not list"),
        "missing": ({name: data for name, data in files.items() if name != first}, "lacks records/000000.json"),
        "swapped": ({**files, first: files["records/000001.json"]}, "not the record that the submission lists"),
        "no about": ({first: files[first]}, f"lacks {ABOUT}"),
        "deep": ({**files, ABOUT: b"[" * 100_000}, "nested"),
        "empty": (with_about(records=[]), "records"),
        "none": ({}, f"lacks {ABOUT}"),
    }
    for name, (content, words) in damaged.items():
        with pytest.raises(SurgbenchError, match=words) as found:
            read_submission(packed(tmp_path / f"{name}.zip", content))
        assert "\n" not in str(found.value), name
    (tmp_path / "text.zip").write_text("no archive")
    with pytest.raises(DatasetError, match="no submission"):
        read_submission(tmp_path / "text.zip")
    with pytest.raises(DatasetError, match="no such file"):
        read_submission(tmp_path / "nothing.zip")
    cut = tmp_path / "cut.zip"
    cut.write_bytes(handed_in.read_bytes()[:-200])
    with pytest.raises(DatasetError, match="no submission"):
        read_submission(cut)


def test_a_controller_s_runs_fit_and_are_found_out_likewise(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("generate", "wire-chaser-mini", "--sequences", 1, "--frames", 150, "--out", tmp_path / "data")
    surgbench("run", "--dataset", tmp_path / "data", "--tracker", "gaze", "--out", tmp_path / "runs")
    assert len(records(tmp_path / "runs")) == 1
    surgbench("submit", tmp_path / "runs", "--by", "me", "--out", tmp_path / "mine.zip")
    surgbench("verify", tmp_path / "mine.zip", "--dataset", tmp_path / "data")
    assert "fits: 1 scored again, 1 run again" in capsys.readouterr().out

    def level(record: dict[str, Any]) -> None:
        record["errors"]["pf_deg"][20] += 0.001

    forged = repacked(tmp_path / "mine.zip", tmp_path / "forged.zip", level)
    surgbench("verify", forged, "--dataset", tmp_path / "data", "--again", 0, expect=1)
    assert "refused: gaze 000 r0: scored again: differs: pf_deg of frame 20 is" in capsys.readouterr().out
