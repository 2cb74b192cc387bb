"""Reproduced tables end to end on a tiny one: files, resuming, the check and what it must catch; published figures."""

from __future__ import annotations

import csv
import json
import re
import shutil
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from commandline import STRANGERS, surgbench
from others import bar, put
from surgpose_folder import FRAMES as SURGPOSE_FRAMES
from surgpose_folder import jaws_of, put_jaw, put_trajectory

from surgbench.config import packaged_names
from surgbench.errors import ConfigError, NotFoundError
from surgbench.report import figures
from surgbench.reproduce.check import Chosen, beyond_tolerance, choose, machine_text
from surgbench.reproduce.compare import Pair, compare
from surgbench.reproduce.consistency import inconsistencies
from surgbench.reproduce.files import json_text, read_results
from surgbench.reproduce.fingerprint import head, record_sha256
from surgbench.reproduce.load import load_table
from surgbench.reproduce.published import load_published
from surgbench.reproduce.results import Results
from surgbench.reproduce.table import Definition
from surgbench.suite.environment import environment
from surgbench.task import find_task
from surgbench.tasks.instrument.columns import PUBLISHED
from surgbench.tasks.instrument.levels import curves
from surgbench.tasks.instrument.page import markdown
from surgbench.tasks.instrument.worst import worst_moments

FRAMES = 12
TABLE: dict[str, Any] = {
    "title": "A tiny table",
    "published": "hu2026",
    "quick": {"runs": 1, "frames": 3},
    "timing": {"runs": 1, "frames": 3},
    "check": {"runs": 1, "frames": 5},
    "figure": {"block": "only", "unit": "000-left", "rows": ["still", "noisy-joints"]},
    "blocks": [
        {
            "name": "only",
            "heading": "The only block",
            "note": "Starts from the truth.",
            "dataset": {"preset": "mini", "frames": FRAMES},
            "quick_sequences": ["000"],
            "defaults": {"keypoints": "observed"},
            "published_on": "synthetic",
            "rows": [
                {"row_id": "still", "label": "Still", "tracker": f"{STRANGERS}:Still", "published": "gd-10"},
                {
                    "row_id": "noisy-joints",
                    "label": "Noisy, with joints",
                    "tracker": f"{STRANGERS}:Noisy",
                    "readings": "true",
                    "sequences": 1,
                    "beside": "gd-10-joints",
                    "floor": "still",
                },
            ],
        }
    ],
}


SHEET = find_task("instrument").sheet


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The table, made; ``tiny.yaml``, ``data`` and ``results`` lie in the folder."""
    folder = tmp_path_factory.mktemp("reproduce")
    (folder / "tiny.yaml").write_text(yaml.safe_dump(TABLE), encoding="utf-8")
    run(folder)
    return folder


def run(folder: Path, *arguments: object, expect: int = 0) -> None:
    places = ("--out", folder / "results", "--data", folder / "data", "--jobs", 1)
    surgbench("reproduce", folder / "tiny.yaml", *places, *arguments, expect=expect)


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    """The made table to be changed; its dataset is not there."""
    shutil.copy(made / "tiny.yaml", tmp_path)
    shutil.copytree(made / "results", tmp_path / "results")
    return tmp_path


@pytest.fixture
def definition(made: Path) -> Definition:
    return load_table(str(made / "tiny.yaml"))


@pytest.fixture
def results(made: Path) -> Results:
    return read_results(made / "results" / "tiny")


def minimal_table() -> str:
    """The first table file of the page about them."""
    page = (Path(__file__).parents[2] / "docs" / "reproduce.md").read_text(encoding="utf-8")
    return page.partition("This is enough:\n\n```yaml\n")[2].partition("```")[0]


def test_a_table_file_need_not_say_much(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(minimal_table(), encoding="utf-8")
    table = load_table(str(tmp_path / "mine.yaml")).table
    assert table.task == "instrument"
    assert (table.quick.runs, table.quick.frames) == (1, 40)
    assert (table.timing.runs, table.timing.frames) == (1, 100)
    assert (table.check.runs, table.check.frames) == (16, 100)
    assert table.blocks[0].quick_sequences == ("000",)


@pytest.mark.slow
def test_the_least_table_file_is_made_and_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = minimal_table().replace("hybrid", f"{STRANGERS}:Still").replace("cmaes", f"{STRANGERS}:Noisy")
    (tmp_path / "mine.yaml").write_text(text.replace("preset: mini", "preset: mini, frames: 4"), encoding="utf-8")
    places = ("--out", tmp_path, "--data", tmp_path / "data", "--jobs", 1)
    surgbench("reproduce", tmp_path / "mine.yaml", "--quick", *places)
    surgbench("reproduce", tmp_path / "mine.yaml", *places)
    surgbench("reproduce", tmp_path / "mine.yaml", "--check", *places)
    assert "confirmed (2 rows run again, 0 skipped)" in capsys.readouterr().out


# --- the files


@pytest.mark.slow
def test_a_blocks_keypoints_are_its_rows_unless_they_name_others(tmp_path: Path, definition: Definition) -> None:
    assert [row.model_dump()["keypoints"] for _, row in definition.table.rows()] == ["observed", "observed"]
    table = json.loads(json.dumps(TABLE))
    table["blocks"][0]["rows"][0]["keypoints"] = "corners"
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(table), encoding="utf-8")
    rows = load_table(str(tmp_path / "other.yaml")).table.rows()
    assert [row.asked(quick=False).model_dump()["keypoints"] for _, row in rows] == ["corners", "observed"]


@pytest.mark.slow
@pytest.mark.extras  # with and without the figure
def test_every_file_is_there_and_fits(made: Path, definition: Definition, results: Results) -> None:
    folder = made / "results" / "tiny"
    found = {path.name for path in folder.iterdir()}
    assert found == {
        *("leaderboard.csv", "leaderboard.md", "sequences.csv", "records.json"),
        *("records", "timing"),
        *(["figure.png"] if find_spec("matplotlib") else []),  # the extra `plots`
    }
    assert [(row["row_id"], row["sequences"], row["frames"]) for row in results.rows] == [
        ("still", 2, 2 * FRAMES),
        ("noisy-joints", 1, FRAMES),
    ]
    assert [(one["row_id"], one["unit"], one["speed"]) for one in results.sequences] == [
        ("still", "000-left", "nominal"),
        ("still", "000-right", "nominal"),
        ("noisy-joints", "000-left", "nominal"),
    ]
    assert inconsistencies(definition, results, folder) == []


@pytest.mark.slow
def test_page_has_published_figures_and_ratios(made: Path, results: Results) -> None:
    page = (made / "results" / "tiny" / "leaderboard.md").read_text(encoding="utf-8")
    row = results.rows[0]
    rotation = row["rotation_error_rad"]
    assert f"| Still | published | 0.4957 | 8.90 | 0.3378 | 0.3377 | 0.1715 | {42.40:.2f} |" in page
    assert f"|  | ours | {rotation:.4f} ± {row['rotation_error_rad_sem']:.4f} |" in page
    assert f"|  | ratio | **{rotation / 0.4957:.2f}×** |" in page  # bold: no worse
    assert "| Noisy, with joints | published, `gd-10-joints` |" in page
    # A figure that is met: of the row that stands for a published one alone, and no time.
    assert "The only block: 5 of the 5 accuracies of 1 row" in page
    assert "Starts from the truth." in page
    assert "NVIDIA RTX 4090" in page
    assert "### Above the floor" in page
    assert "not to be quoted" not in page


@pytest.mark.slow
def test_without_published_figures_rows_are_held_against_each_other(tmp_path: Path, results: Results) -> None:
    content = json.loads(json.dumps(TABLE))
    del content["published"]
    still, noisy = content["blocks"][0]["rows"]
    del still["published"], noisy["beside"], noisy["floor"]
    noisy["against"] = "still"
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    definition = load_table(str(tmp_path / "tiny.yaml"))
    page = markdown(definition, results)
    assert "Times were measured on one core of" in page
    assert not any(words in page for words in ("Beside", "bettered", "RTX"))
    ours, other = (row["rotation_error_rad"] for row in reversed(results.rows))
    change = f"{100 * (ours / other - 1):+.0f} %".replace("-", "−")
    assert f"| Noisy, with joints | `still` | {change} |" in page
    tips = {(one["row_id"], one["unit"]): one["tip_error_m"] for one in results.sequences}
    better = tips["noisy-joints", "000-left"] < tips["still", "000-left"]
    assert f"| {int(better)} of 1 |" in page


@pytest.mark.slow
def test_latencies_are_those_of_the_runs_one_at_a_time(made: Path, results: Results) -> None:
    timed = [json.loads(path.read_text()) for path in (made / "results" / "tiny" / "timing").rglob("*.json")]
    assert {record["spec"]["row_id"]: len(record["frames"]["index"]) for record in timed} == {
        "still": 3,
        "noisy-joints": 3,
    }
    latencies = [record["frames"]["latency_ms"] for record in timed if record["spec"]["row_id"] == "still"]
    assert results.rows[0]["latency_ms"] == sorted(latencies[0])[1]


@pytest.mark.slow
def test_the_same_command_runs_only_what_is_missing(copy: Path, made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (copy / "data").symlink_to(made / "data")
    missing = next((copy / "results" / "tiny" / "records").rglob("noisy-joints*/000-left-r0.json"))
    missing.unlink()
    (copy / "results" / "tiny" / "sequences.csv").unlink()
    run(copy)
    assert f"1 runs, {FRAMES} frames; 2 recorded already" in capsys.readouterr().err
    for name in ("sequences.csv", "leaderboard.csv"):
        again, before = (_timeless(top / "results" / "tiny" / name) for top in (copy, made))
        assert again == before
    fingerprints = [json.loads((top / "results/tiny/records.json").read_text())["records"] for top in (copy, made)]
    assert fingerprints[0] == fingerprints[1]


def _timeless(path: Path) -> list[dict[str, str]]:
    rows = csv.DictReader(path.read_text().splitlines())
    return [
        {key: value for key, value in row.items() if not key.startswith(("latency", "calibration"))} for row in rows
    ]


@pytest.mark.slow
def test_quick_does_every_row_and_says_what_it_is(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(made, "--quick")
    assert "not to be quoted" in capsys.readouterr().out
    quick = read_results(made / "results" / "tiny-quick")
    assert [(row["row_id"], row["frames"]) for row in quick.rows] == [("still", 3), ("noisy-joints", 3)]
    assert "**not to be quoted**" in (made / "results/tiny-quick/leaderboard.md").read_text(encoding="utf-8")
    # A part of the dataset, run with the same random numbers: the same first frames.
    for part in (made / "results/tiny-quick/records").rglob("*.json"):
        (whole,) = (made / "results/tiny/records").rglob(f"{part.parent.name.rpartition('-')[0]}-*/{part.name}")
        states = [json.loads(path.read_text())["frames"]["state"] for path in (part, whole)]
        assert states[0] == states[1][:3]


# --- the check


@pytest.mark.slow
def test_a_sound_table_passes(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without the dataset: just what is needed of it is made, and the states are the same to the last bit."""
    run(copy, "--check")
    out, err = capsys.readouterr()
    assert "chosen by table" in err
    assert "identical" in out
    assert "5 states bit for bit" in out
    assert "confirmed (1 rows run again, 0 skipped)" in out
    processor = machine_text(environment()["machine"])
    assert f"made on {processor}; run again on {processor}" in err
    assert re.search(
        r"latency \S+ ms \(calibration ratio \S+ \S+ ms on the reference machine\) here, .+ in the table", out
    )
    assert not (copy / "data").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "key", "column", "says"),
    [
        ("leaderboard.csv", "still", "q1_error_rad", "row 'still': q1_error_rad is"),
        ("leaderboard.csv", "still", "tip_error_m_sem", "row 'still': tip_error_m_sem is"),
        ("sequences.csv", "noisy-joints", "mask_error", "row 'noisy-joints': mask_error is"),
        ("sequences.csv", "still", "frames", "row 'still': frames is"),
    ],
)
def test_an_altered_number_is_found(
    copy: Path, capsys: pytest.CaptureFixture[str], file: str, key: str, column: str, says: str
) -> None:
    path = copy / "results" / "tiny" / file
    rows = list(csv.DictReader(path.read_text().splitlines()))
    line = next(row for row in rows if row["row_id"] == key)
    line[column] = str(int(line[column]) - 1) if column == "frames" else str(0.9 * float(line[column]))
    with path.open("w", newline="") as out:
        writer = csv.DictWriter(out, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    run(copy, "--check", expect=1)
    out_text, err = capsys.readouterr()
    assert says in err
    assert "not confirmed: its files do not agree" in out_text


@pytest.mark.slow
def test_an_altered_page_is_found_and_rendered_again(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = copy / "results" / "tiny" / "leaderboard.md"
    before = page.read_text(encoding="utf-8")
    page.write_text(before.replace("Still", "Best"), encoding="utf-8")
    run(copy, "--check", expect=1)
    assert "leaderboard.md: not what the other files" in capsys.readouterr().err
    run(copy, "--render")
    assert page.read_text(encoding="utf-8") == before


@pytest.mark.slow
def test_estimates_that_come_out_differently_fail(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A committed record of other errors than the rerun's: the row is named, and the exit code is 1."""
    path = copy / "results" / "tiny" / "records.json"
    about = json.loads(path.read_text())
    for record in about["records"].values():
        record["head"]["states_sha256"] = "0" * 64
        record["head"]["errors"]["rotation_error_rad"] = [1.5, 0.01]
        record["head"]["last"][3] += 0.25
    path.write_text(json.dumps(about))
    run(copy, "--check", expect=1)
    out = capsys.readouterr().out
    assert "differs" in out
    assert "off by 0.25" in out
    assert "mean rotation_error_rad" in out
    row = out.split()[1]  # which one is drawn
    assert f"rows that come out differently: {row}" in out


def test_tolerance_follows_the_spread() -> None:
    """Other bits, as on another processor, are no difference; other errors are."""
    committed = {"frames": 100, "errors": {"rotation_error_rad": [0.1, 0.1]}}
    tolerances = find_task("instrument").sheet.no_difference
    for now, beyond in ((0.1, False), (0.19, False), (0.01, False), (0.3, True), (float("inf"), True)):
        assert bool(beyond_tolerance(committed, {"errors": {"rotation_error_rad": [now, 0.1]}}, tolerances)) == beyond
    assert beyond_tolerance(committed, {"errors": {}}, tolerances) == [("rotation_error_rad", 0.1, float("inf"))]


@pytest.mark.slow
def test_machines_are_named_as_far_as_they_are_known() -> None:
    assert machine_text({"processor": "Old", "cores": 2}) == "Old"
    assert machine_text({"processor": "New", "vectors": "avx2", "threads": 1}) == "New, avx2, 1 thread"


def test_choice_follows_table_and_commit(definition: Definition, results: Results) -> None:
    def picks(commit: str, table: str = "t") -> list[Chosen]:
        return choose(definition, results, table, commit)

    assert picks("a") == picks("a")
    several = {(one.row.id, one.unit) for commit in "abcdefghij" for one in picks(commit)}
    assert several == {("still", "000-left"), ("still", "000-right"), ("noisy-joints", "000-left")}
    assert len({tuple(one.key for one in picks("a", table)) for table in "abcdefghij"}) > 1


@pytest.mark.slow
def test_check_without_a_table_says_so(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("reproduce", made / "tiny.yaml", "--check", "--out", made / "nowhere", expect=2)
    assert "records.json: missing" in capsys.readouterr().err


# --- fingerprints


@pytest.mark.slow
def test_fingerprint_knows_estimates_and_not_times(made: Path) -> None:
    path = next((made / "results" / "tiny" / "records").rglob("*.json"))

    def record() -> dict[str, Any]:
        content: dict[str, Any] = json.loads(path.read_text())
        return content

    elsewhere = record()
    elsewhere["environment"] = {"python": "4"}
    elsewhere["dataset_path"] = "/elsewhere"
    assert elsewhere.pop("calibration_ms") > 0  # records of old versions have none
    elsewhere["frames"]["latency_ms"] = [1.0] * FRAMES
    assert record_sha256(elsewhere) == record_sha256(record())
    assert head(elsewhere, 5, SHEET) == head(record(), 5, SHEET)
    other = record()
    other["frames"]["state"][4][8] += 1e-15
    assert record_sha256(other) != record_sha256(record())
    assert head(other, 5, SHEET)["states_sha256"] != head(record(), 5, SHEET)["states_sha256"]
    assert head(other, 4, SHEET) == head(record(), 4, SHEET)


# --- tables and published figures as files


def test_unknown_table_offers_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("reproduce", "tabel1", expect=2)
    assert "unknown table 'tabel1'; did you mean 'table1'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"published": "gd-11"}, "unknown published row 'gd-11'; did you mean 'gd-10'"),
        ({"published": None, "beside": "gd-11"}, "unknown published row 'gd-11'; did you mean 'gd-10'"),
        ({"beside": "gd-10"}, "or beside one .'beside'., not both"),
        ({"tracker": "cmeas"}, "unknown tracker 'cmeas'; did you mean 'cmaes'"),
        ({"keypoints": "observd"}, "unknown keypoints 'observd'"),
        ({"floor": "ground"}, "there is no row 'ground' to be its floor"),
        ({"against": "other"}, "there is no row 'other' to be held against"),
        ({"row_id": "noisy-joints"}, "'noisy-joints' is given twice"),
        ({"tracker": "cmaes", "options": {"cmaes": {"iteration": 3}}}, "unknown key 'iteration'"),
        ({"lable": "x"}, "did you mean 'label'"),
    ],
)
def test_a_wrong_table_is_refused_before_any_work(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    content = json.loads(json.dumps(TABLE))
    content["blocks"][0]["rows"][0] |= change
    (tmp_path / "wrong.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises((ConfigError, NotFoundError), match=says) as caught:
        load_table(str(tmp_path / "wrong.yaml"))
    assert "\n" not in str(caught.value)
    assert "wrong.yaml" in str(caught.value)


@pytest.mark.parametrize("name", packaged_names("tables"))
def test_our_own_tables_are_sound(name: str) -> None:
    table = load_table(name)
    assert table.name == name
    assert sum(1 for _ in table.table.rows()) > 0


@pytest.mark.parametrize(
    ("row", "data", "column", "value"),
    [
        ("gd-10", "synthetic", "rotation_error_rad", 0.4957),
        ("gd-10-joints", "synthetic", "q3_error_rad", 0.0028),
        ("gd-20", "synthetic", "latency_optimise_ms", 79.53),
        ("gd-pytorch3d-10", "synthetic", "q1_error_rad", 0.4162),
        ("xnes-3", "synthetic", "translation_error_m", 0.0075),
        ("cmaes-3", "synthetic", "rotation_error_rad", 0.2136),
        ("cmaes-3", "surgpose-normal", "mask_error", 0.0729),
        ("cmaes-3-joints", "synthetic", "q2_error_rad", 0.0144),
        ("cmaes-5", "surgpose-fast", "keypoint_error_px", 6.3607),
        ("cmaes-online", "surgpose-normal", "latency_ms", 25.15),
        ("cmaes-3-opencv-keypoints", "synthetic", "q3_error_rad", 0.7557),
        ("dual-cmaes-3-joints", "synthetic", "translation_error_m", 0.0049),
        ("particle-filter-1000", "collected", "mask_error_true", 0.2476),
    ],
)
def test_published_figures_are_the_articles(row: str, data: str, column: str, value: float) -> None:
    assert load_published("hu2026").value(row, data, column) == value


def test_single_arm_rows_of_the_article_are_complete() -> None:
    published = load_published("hu2026")
    single = [row for row in published.rows.values() if row.table == "Table I, single-arm"]
    assert len(single) == 11
    assert sum(len(values) for row in single for values in row.data.values()) == 10 * 6 + 11 * 4 + 2


def test_no_worse_than_published_is_met() -> None:
    measure = PUBLISHED[0]
    assert Pair(measure, 0.2, 0.2, None).met
    assert Pair(measure, 0.2, 0.1, None).ratio == 0.5
    assert not Pair(measure, 0.2, 0.2001, None).met
    assert not Pair(measure, 0.2, None, None).met


@pytest.mark.slow
def test_only_rows_with_a_published_one_are_compared(definition: Definition, results: Results) -> None:
    block = definition.table.blocks[0]
    found = compare(block, results.rows, definition.published, PUBLISHED, {})
    assert [one.row.id for one in found] == ["still", "noisy-joints"]
    assert {pair.measure.key for pair in found[0].pairs} == {
        *("rotation_error_rad", "translation_error_m", "q1_error_rad", "q2_error_rad", "q3_error_rad"),
        "latency_optimise_ms",
    }


@pytest.mark.slow
def test_what_this_machine_lacks_is_said_first(monkeypatch: pytest.MonkeyPatch, definition: Definition) -> None:
    from surgbench.reproduce.work import lacking
    from surgbench.trackers.adam_mitsuba import AdamMitsubaTracker

    monkeypatch.setattr(AdamMitsubaTracker, "unavailable", classmethod(lambda cls: "needs LLVM 17 or later"))
    lines = lacking(load_table("table1").table, quick=True)
    assert (
        "row 'gd-mitsuba-10' will be skipped: tracker 'adam-mitsuba' cannot run here: needs LLVM 17 or later" in lines
    )
    assert lacking(definition.table, quick=False) == []


def test_without_matplotlib_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    from surgbench.errors import SurgbenchError

    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(SurgbenchError, match=r"pip install 'surgbench\[plots\]'"):
        figures.check_matplotlib()


# --- pictures


@pytest.mark.slow
@pytest.mark.extras
def test_curves_over_levels_and_worst_moments(tmp_path: Path) -> None:
    table: dict[str, Any] = {key: value for key, value in TABLE.items() if key not in ("figure", "published")}
    rows = [{"label": name, "tracker": f"{STRANGERS}:{name}"} for name in ("Still", "Noisy")]
    table["blocks"] = [
        {
            "name": name,
            "heading": name,
            "dataset": {"preset": "mini", "frames": FRAMES, "corruption": name},
            "quick_sequences": ["000"],
            "levels": {"corruption": level},
            "rows": [{**row, "row_id": f"{name}-{row['label'].lower()}", "sequences": 1} for row in rows],
        }
        for name, level in (("none", 0.0), ("strong", 1.0))
    ]
    table["worst"] = {"block": "strong", "rows": ["strong-noisy", "strong-still"], "moments": 2}
    (tmp_path / "levels.yaml").write_text(yaml.safe_dump(table), encoding="utf-8")
    surgbench("reproduce", tmp_path / "levels.yaml", "--out", tmp_path, "--data", tmp_path / "data", "--jobs", 1)
    folder = tmp_path / "levels"
    results, definition = read_results(folder), load_table(str(tmp_path / "levels.yaml"))
    found = curves(definition.table.blocks, results.rows)
    assert {label: [level for level, _ in curve] for label, curve in found["corruption"].items()} == {
        "Still": [0.0, 1.0],
        "Noisy": [0.0, 1.0],
    }
    assert (found["corruption"]["Noisy"][1][1]["row_id"], len(found)) == ("strong-noisy", 1)
    page = (folder / "leaderboard.md").read_text(encoding="utf-8")
    if find_spec("matplotlib") is None:
        assert "pictures" not in results.about
        return
    assert results.about["pictures"] == ["levels.png", "worst.png"]
    for name in results.about["pictures"]:
        assert f"({name})" in page
        picture = cv2.imread(str(folder / name))
        assert picture is not None
        assert picture.std() > 10


def test_worst_moments_lie_apart() -> None:
    errors = np.zeros((300, 2))
    errors[100, 1], errors[110, 0], errors[250, 0] = 0.03, 0.02, 0.01
    record: Any = SimpleNamespace(errors={"tip_error_m": errors}, frames=SimpleNamespace(index=list(range(300))))
    assert [(one.frame, one.tip_error_m) for one in worst_moments([record], 2)] == [(100, 0.03), (250, 0.01)]


# --- some rows again


@pytest.mark.slow
def test_a_row_run_again_takes_its_place_and_the_others_stay(
    copy: Path, made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (copy / "data").symlink_to(made / "data")
    folder = copy / "results" / "tiny"
    for name in ("records", "timing"):
        shutil.rmtree(folder / name)  # as where a table was cloned
    # Made by an older version, on a processor that rounds the numbers of the dataset's tables otherwise.
    about = json.loads((folder / "records.json").read_text(encoding="utf-8"))
    for committed in about["datasets"].values():
        committed |= {"sha256": "0" * 64, "first_masks_sha256": committed.pop("first_sha256")}
    (folder / "records.json").write_text(json_text(about), encoding="utf-8")
    before = read_results(folder)
    run(copy, "--row", "noisy-joint", expect=2)
    assert "did you mean 'noisy-joints'?" in capsys.readouterr().err
    table = json.loads(json.dumps(TABLE))
    table["blocks"][0]["rows"][1]["readings"] = "none"  # the row is another one now
    (copy / "tiny.yaml").write_text(yaml.safe_dump(table), encoding="utf-8")
    run(copy, "--row", "noisy-joints")
    assert f"1 runs, {FRAMES} frames" in capsys.readouterr().err
    after = read_results(folder)
    assert after.rows[0] == before.rows[0]
    assert after.sequences[:2] == before.sequences[:2]
    assert (after.rows[1]["row_id"], after.rows[1]["readings"]) == ("noisy-joints", "none")
    assert list(after.about["records"]) == list(before.about["records"])
    run(copy, "--check")
    assert "confirmed" in capsys.readouterr().out


# --- recordings


@pytest.mark.slow
def test_rows_on_recordings_that_the_user_has(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A table whose dataset is imported: reference errors in all files, beside the article's, and the check."""
    source = tmp_path / "SurgPose"
    put_trajectory(source / "000000")
    put_jaw(source / "gripper_angle.yaml", {"000000": {arm: jaws_of(arm) for arm in ("PSM1", "PSM3")}})
    for arm, top in (("PSM1", 8), ("PSM3", 30)):
        for frame in range(SURGPOSE_FRAMES):
            put(tmp_path / f"sam/000000/{arm}/{frame:05d}.png", 255 * bar(frame, top).astype(np.uint8))
    table: dict[str, Any] = json.loads(json.dumps(TABLE))
    del table["figure"]
    (block,) = table["blocks"]
    options = {"trajectories": "0", "half": True}
    block |= {"dataset": {"importer": "surgpose", "name": "surgpose-0", "options": options}}
    block |= {"quick_sequences": ["000000"], "published_on": "surgpose-normal"}
    few = {"hypotheses": 50, "refined": 1, "shafts": 1, "redrawn": 50, "finalists": 1, "generations": [1, 1]}
    row = {"initialiser": "random", "options": {"random": few}, "keypoints": "none", "published": "cmaes-3"}
    block["rows"] = [{"row_id": "still", "label": "Still", "tracker": f"{STRANGERS}:Still", **row}]
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(table), encoding="utf-8")
    places = ("--out", tmp_path / "results", "--data", tmp_path / "data", "--jobs", 1)

    surgbench("reproduce", tmp_path / "own.yaml", *places, expect=2)
    assert "needs --surgpose DIR" in capsys.readouterr().err
    surgbench("reproduce", tmp_path / "own.yaml", "--surgpose", source, "--surgpose-masks", tmp_path / "sam", *places)
    surgbench("reproduce", tmp_path / "own.yaml", *places)  # it is there now
    results = read_results(tmp_path / "results/own")
    (ours,) = results.rows
    assert (ours["sequences"], ours["rotation_error_rad"]) == (2, None)
    for error in ("reference_tip_error_px", "reference_keypoint_error_px"):
        assert ours[error] == pytest.approx(np.mean([one[error] for one in results.sequences]))
    assert ours["absent_frames"] == sum(one["absent_frames"] for one in results.sequences)
    page = (tmp_path / "results/own/leaderboard.md").read_text(encoding="utf-8")
    assert "1 recording without truth" in page
    assert f"{ours['reference_keypoint_error_px']:.2f}" in page.partition("Beside")[2]
    assert "rotation" not in page.partition("## ")[2]
    surgbench("reproduce", tmp_path / "own.yaml", *places, "--check")
