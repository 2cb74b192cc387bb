"""Tables of records as DataFrames: typed, without loss, and for notebooks."""

from __future__ import annotations

import csv
import io
import math
import re
from pathlib import Path

import pytest
from fabricate import failed, record, write
from hypothesis import given
from hypothesis import strategies as st

import surgbench
from surgbench.comparison.keypoints_report import FIELDS as ACCURACY
from surgbench.errors import DatasetError
from surgbench.report import render
from surgbench.report.field import count, flag, keys, number, text
from surgbench.report.frame import csv_text, read_csv, to_frame, to_rows
from surgbench.report.notebook import RECORD_COLUMNS
from surgbench.report.rows import read_rows
from surgbench.reproduce.files import LEADERBOARD_CSV, LEADERBOARD_MD, RECORDS_JSON, SEQUENCES_CSV, read_results
from surgbench.reproduce.load import load_table
from surgbench.task import Task, all_tasks, find_task

RESULTS = Path(__file__).parents[2] / "results"
# Tables that were made again have records.json beside them; the others were only reported.
REPRODUCED = sorted(path.parent.name for path in RESULTS.glob(f"*/{RECORDS_JSON}"))
REPORTED = sorted({path.parent.name for path in RESULTS.glob(f"*/{LEADERBOARD_CSV}")} - set(REPRODUCED))
ALL_TYPES = (*text("row_id"), *count("frames"), *number("error_m"), *flag("floor"))


@pytest.mark.slow
@pytest.mark.parametrize("name", REPRODUCED)
def test_a_committed_table_is_written_as_it_was_read(name: str) -> None:
    folder = RESULTS / name
    results, sheet = read_results(folder), find_task(load_table(name).table.task).sheet
    for file, rows, fields in (
        (LEADERBOARD_CSV, results.rows, sheet.leaderboard(results.rows)),
        (SEQUENCES_CSV, results.sequences, sheet.sequences(results.sequences)),
    ):
        assert csv_text(to_frame(rows, fields)).encode() == (folder / file).read_bytes()


@pytest.mark.parametrize("name", REPORTED)
def test_a_committed_report_is_written_as_it_was_read(name: str) -> None:
    content = (RESULTS / name / LEADERBOARD_CSV).read_text(encoding="utf-8")
    task = next(task for task in all_tasks() if ",".join(keys(task.columns)) == content.partition("\n")[0])
    assert csv_text(to_frame(to_rows(read_csv(content, task.columns)), task.columns)) == content


def test_the_committed_accuracy_of_keypoint_sources_is_written_as_it_was_read() -> None:
    content = (RESULTS / "keypoints" / "accuracy.csv").read_text(encoding="utf-8")
    assert csv_text(read_csv(content, ACCURACY)) == content


@pytest.mark.parametrize("name", REPRODUCED)
def test_a_committed_page_is_what_its_files_give(name: str) -> None:
    definition, folder = load_table(name), RESULTS / name
    page = find_task(definition.table.task).sheet.page(definition, read_results(folder))
    assert page == (folder / LEADERBOARD_MD).read_text(encoding="utf-8")


def test_committed_tables_are_there() -> None:
    assert set(REPRODUCED) >= {"table1", "autocam", "auxiliary-view"}
    assert REPORTED


ROWS = st.fixed_dictionaries(
    {
        "row_id": st.none()
        | st.text(st.characters(blacklist_categories=["Cs"], blacklist_characters="\0"), min_size=1),
        "frames": st.none() | st.integers(-(2**63), 2**63 - 1),
        "error_m": st.none() | st.floats(allow_nan=False),
        "floor": st.none() | st.booleans(),
    }
)


@pytest.mark.slow
@given(st.lists(ROWS))
def test_csv_is_what_pythons_own_writer_makes_and_is_read_back(rows: list[dict[str, object]]) -> None:
    frame = to_frame(rows, ALL_TYPES)
    assert to_rows(frame) == rows
    own = io.StringIO()
    writer = csv.DictWriter(own, keys(ALL_TYPES), lineterminator="\n")
    writer.writeheader()
    formulas = re.compile(r"'*[=+\-@\t\r]")  # not shown to a spreadsheet as they are
    writer.writerows(
        {key: f"'{cell}" if isinstance(cell, str) and formulas.match(cell) else cell for key, cell in row.items()}
        for row in rows
    )
    assert csv_text(frame) == own.getvalue()
    assert to_rows(read_csv(csv_text(frame), ALL_TYPES)) == rows


def test_types_are_the_declared_ones_whatever_the_values() -> None:
    kinds: list[list[dict[str, object]]] = [
        [],
        [{}],
        [{"row_id": 3, "frames": 2.0, "error_m": 1, "floor": True, "more": "x"}],
    ]
    for rows in kinds:
        frame = to_frame(rows, ALL_TYPES)
        assert [str(dtype) for dtype in frame.dtypes] == ["string", "Int64", "float64", "boolean"]
    assert to_rows(frame) == [{"row_id": "3", "frames": 2, "error_m": 1.0, "floor": True}]


@pytest.mark.parametrize(
    ("spoilt", "says"),
    [
        ("", "truncated"),
        ("row_id,frames,error_m,floor\na,1,0.", "truncated"),
        ("row_id,frames,error_m\na,1,0.5\n", "other columns"),
        ("row_id,frames,error_m,floor\na,1.5,0.5,True\n", "'1.5' is not a count"),
        ("row_id,frames,error_m,floor\na,1,much,True\n", "'much' is not a number"),
        ("row_id,frames,error_m,floor\na,1,0.5,perhaps\n", "'perhaps' is not a flag"),
        ("row_id,frames,error_m,floor\na,1,0.5,True,7\n", "more cells"),
        ("row_id,frames,error_m,floor\na,1,0.5,True\na,1,0.5,True,7\n", "saw 5"),
    ],
)
def test_a_spoilt_table_is_refused(spoilt: str, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        read_csv(spoilt, ALL_TYPES)


def test_a_row_may_be_called_nan() -> None:
    rows = [{"row_id": name, "frames": None, "error_m": None, "floor": None} for name in ("NA", "nan", "null", "1e5")]
    assert to_rows(read_csv(csv_text(to_frame(rows, ALL_TYPES)), ALL_TYPES)) == rows
    assert math.isnan(to_frame(rows, ALL_TYPES)["error_m"][0])


@pytest.mark.parametrize("task", all_tasks(), ids=lambda task: task.name)
def test_columns_are_declared_once(task: Task) -> None:
    declared = (*task.columns, *task.further_columns)
    assert len(set(keys(declared))) == len(declared)
    assert {column.key for column in task.shown} <= set(keys(declared))


# --- for notebooks


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    return write(tmp_path / "runs", record(), record(unit="000-right", frames=6), failed(row_id="stuck"))


def test_a_leaderboard_is_what_report_writes(runs: Path) -> None:
    frame = surgbench.leaderboard(runs)
    assert csv_text(frame) == render.csv(read_rows([runs]))
    assert frame["frames"].tolist() == [10, 0]
    assert str(frame["frames"].dtype) == "Int64"


def test_records_are_lines(runs: Path) -> None:
    frame = surgbench.load_records(str(runs))
    assert len(frame) == len(list(runs.rglob("*-r*.json")))
    assert tuple(frame.columns)[: len(RECORD_COLUMNS)] == keys(RECORD_COLUMNS)
    first, second, stuck = to_rows(frame)
    assert (first["row_id"], first["unit"], first["repeat"], first["frames"]) == ("cmaes", "000-left", 0, 4)
    assert (second["unit"], second["frames"]) == ("000-right", 6)
    assert first["rotation_error_rad"] == pytest.approx((0.1 + 0.2 + 0.3 + 0.4) / 4)
    assert first["latency_ms"] == 11.5
    assert (first["filter"], first["readings"], first["arms"], first["view"]) == ("kalman", "none", "left", None)
    assert first["option.iterations"] == 3
    assert str(frame["option.iterations"].dtype) == "Int64"
    assert (stuck["status"], stuck["mask_error"], stuck["latency_ms"]) == ("failed", None, None)
    assert "returned" in stuck["error"]
    assert Path(first["path"]).is_file()


def test_options_are_flat_and_of_the_narrowest_type(tmp_path: Path) -> None:
    options: list[dict[str, object]] = [
        {"iterations": 3, "rate": 1, "mean": "last", "robust": True, "loss": {"tolerance_px": 10.0}, "mixed": 1},
        {"iterations": 5, "rate": 0.5, "robust": False, "mixed": "auto"},
    ]
    for place, one in enumerate(options):
        content = record(row_id=f"r{place}") | {"settings_hash": f"{place}" * 16, "spec_hash": f"{place}" * 16}
        content["spec"]["tracker"]["options"] = one
        write(tmp_path / f"{place}", content)
    frame = surgbench.load_records(tmp_path / "0", tmp_path / "1")
    found = {key: str(frame[f"option.{key}"].dtype) for key in ("iterations", "rate", "mean", "robust", "mixed")}
    assert found == {"iterations": "Int64", "rate": "float64", "mean": "string", "robust": "boolean", "mixed": "string"}
    assert to_rows(frame)[0]["option.loss.tolerance_px"] == 10.0
    assert [row["option.mean"] for row in to_rows(frame)] == ["last", None]


def test_a_folder_without_records_is_named(tmp_path: Path) -> None:
    for load in (surgbench.load_records, surgbench.leaderboard):
        with pytest.raises(DatasetError, match="holds no records"):
            load(tmp_path)
