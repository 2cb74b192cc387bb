from __future__ import annotations

import csv
import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from fabricate import as_written, failed, record, with_seed, write
from rich.console import Console
from typer.testing import CliRunner

from surgbench.cli.report import report
from surgbench.errors import DatasetError
from surgbench.processes.reference import REFERENCE_MS
from surgbench.records.reader import read_records
from surgbench.report import render
from surgbench.report.column import ROW, VARIANT
from surgbench.report.field import keys, number
from surgbench.report.field import text as field_text
from surgbench.report.frame import csv_text, read_csv, to_frame, to_rows
from surgbench.report.latex import escape, latex
from surgbench.report.leaderboard import set_columns
from surgbench.report.losses import LOSS_COLUMNS
from surgbench.report.row import Row
from surgbench.report.rows import read_rows
from surgbench.tasks.instrument.rows import ERRORS, INSTRUMENT_COLUMNS

GOLDEN_CSV = """\
row_id,task,dataset,tracker,variant,settings_hash,status,error,sequences,frames,repeats,coverage,latency_ms,\
latency_ms_p95,latency_optimise_ms,latency_keypoints_ms,latency_masks_ms,latency_filter_ms,calibration_ratio,arms,\
iterations,readings,initialiser,keypoints,filter,scored,floor,views,level,rotation_error_rad,rotation_error_rad_std,rotation_error_rad_sem,\
translation_error_m,translation_error_m_std,translation_error_m_sem,tip_error_m,tip_error_m_std,tip_error_m_sem,\
q1_error_rad,q1_error_rad_std,q1_error_rad_sem,q2_error_rad,q2_error_rad_std,q2_error_rad_sem,q3_error_rad,\
q3_error_rad_std,q3_error_rad_sem,mask_error,mask_error_std,mask_error_sem,mask_error_true,mask_error_true_std,\
mask_error_true_sem,keypoint_error_px,keypoint_error_px_std,keypoint_error_px_sem,translation_error_scaled_m,jitter,lag_ms,start_lag_ms,\
frames_to_recover,lost_frames,lost_precision,lost_recall,interval_coverage,interval_coverage_rotation,\
interval_coverage_translation,interval_coverage_q1,interval_coverage_q2,interval_coverage_q3,time_lost_share,losses,\
regained,frames_to_regain,mask_error_low,mask_error_high
cmaes,instrument,mini,cmaes,none/truth kalman,HASH,ok,,2,10,1,1.0,12.0,14.549999999999999,10.0,,2.0,,,single,3,none,\
truth,dataset,kalman,raw,False,1,,0.30000000000000004,0.157797338380595,0.05,0.003,0.0015779733838059502,0.0005,0.006,\
0.0031559467676119004,0.001,0.15000000000000002,0.0788986691902975,0.025,0.07500000000000001,0.03944933459514875,\
0.0125,0.037500000000000006,0.019724667297574376,0.00625,0.060000000000000005,0.031559467676119,0.010000000000000002,\
0.030000000000000002,0.0157797338380595,0.005000000000000001,3.0,1.5779733838059502,0.5,,0.5,,,,2,,,,,,,,,0.08333333333333333,1,0,1.0,0.05,0.07
stuck,instrument,mini,cmaes,none/truth kalman,HASH,failed,ValueError: step | returned (3\\,),1,0,1,0.0,,,,,,,,single,3,\
none,truth,dataset,kalman,raw,False,1,,,,,,,,,,,,,,,,,,,,,,,,,,,,,,,,,,0,,,,,,,,,,,,,,
"""

GOLDEN_MARKDOWN = """\
### mini, single arms

| row | variant | sequences | done [%] | mask error | mask error, 95 % interval | true mask error | rotation [rad] \
| translation [mm] | tips [mm] | q1 [rad] | q2 [rad] | q3 [rad] | keypoints [px] | time lost [%] | frames to regain \
| latency [ms] | p95 [ms] | status |
| --- | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: \
| ---: | --- |
| cmaes | none/truth kalman | 2 | 100 | 0.060 | 0.050–0.070 | 0.030 | 0.300 | 3.00 | 6.00 | 0.150 | 0.075 | 0.038 \
| 3.0 | 8.3 | 1.0 | 12.0 | 14.5 | ok |
| stuck | none/truth kalman | 1 | 0 | – | – | – | – | – | – | – | – | – | – | – | – | – | – | failed |

- stuck: failed: ValueError: step \\| returned (3,)
"""


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    return write(tmp_path / "runs", record(), record(unit="000-right", frames=6), failed(row_id="stuck"))


def only(rows: list[Row]) -> Row:
    assert len(rows) == 1
    return rows[0]


def test_row_has_exactly_the_columns_of_the_design(runs: Path) -> None:
    for row in read_rows([runs]):
        assert tuple(row) == keys((*INSTRUMENT_COLUMNS, *LOSS_COLUMNS, *number("mask_error_low", "mask_error_high")))
    assert len(INSTRUMENT_COLUMNS) == len(set(INSTRUMENT_COLUMNS)) == 19 + 10 + 9 * 3 + 6 + 8


def test_golden_csv(runs: Path) -> None:
    rows = read_rows([runs])
    expected = GOLDEN_CSV.replace("ValueError: step | returned (3\\,)", '"ValueError: step | returned (3,)"')
    for row in rows:
        expected = expected.replace("HASH", row["settings_hash"], 1)
    assert render.csv(rows) == expected


def test_golden_markdown(runs: Path) -> None:
    assert render.markdown(read_rows([runs])) == GOLDEN_MARKDOWN


def test_csv_and_json_lose_nothing(runs: Path) -> None:
    rows = read_rows([runs])
    assert json.loads(render.json(rows)) == rows
    for row, cells in zip(rows, csv.DictReader(io.StringIO(render.csv(rows))), strict=True):
        for key, value in row.items():
            if isinstance(value, float):
                assert float(cells[key]) == value
            else:
                assert cells[key] == ("" if value is None else str(value))


def test_mean_of_sequence_means_and_spreads(tmp_path: Path) -> None:
    short, long = record(frames=2), record(unit="000-right", frames=8)
    row = only(read_rows([write(tmp_path, short, long)]))
    assert row["rotation_error_rad"] == pytest.approx((0.15 + 0.45) / 2)
    assert row["rotation_error_rad_std"] == pytest.approx(np.std([0.1, 0.2, *np.arange(1, 9) / 10]))
    assert row["rotation_error_rad_sem"] == pytest.approx(np.std([0.15, 0.45], ddof=1) / math.sqrt(2))
    assert (row["sequences"], row["frames"], row["repeats"], row["coverage"]) == (2, 10, 1, 1.0)


def test_repeats_do_not_count_as_sequences(tmp_path: Path) -> None:
    row = only(read_rows([write(tmp_path, record(frames=2), record(frames=4, repeat=1))]))
    assert (row["sequences"], row["repeats"], row["frames"]) == (1, 2, 6)
    assert row["rotation_error_rad"] == pytest.approx((0.15 + 0.25) / 2)
    assert row["rotation_error_rad_sem"] is None


def test_latency_is_the_median_over_all_frames(tmp_path: Path) -> None:
    row = only(read_rows([write(tmp_path, record(frames=3), record(unit="000-right", frames=50))]))
    pooled = [*range(10, 13), *range(10, 60)]
    assert row["latency_ms"] == np.median(pooled)
    assert row["latency_ms_p95"] == pytest.approx(np.percentile(pooled, 95))
    assert row["latency_keypoints_ms"] is None


def test_the_calibration_ratio_is_the_median_of_the_records_by_the_reference_machines_time(tmp_path: Path) -> None:
    assert only(read_rows([write(tmp_path / "old", record())]))["calibration_ratio"] is None
    times = {"000-left": 3.0, "000-right": 2.0, "001-left": 1.0, "001-right": 7.0, "002-left": None}
    records = [record(unit=unit, calibration_ms=ratio and ratio * REFERENCE_MS) for unit, ratio in times.items()]
    row = only(read_rows([write(tmp_path / "new", *records)]))
    assert row["calibration_ratio"] == pytest.approx(2.5)


def made_on(processor: str, ratio: float, **axes: Any) -> dict[str, Any]:
    machine = {"processor": processor, "cores": 2}
    return record(**axes) | {"environment": {"machine": machine}, "calibration_ms": ratio * REFERENCE_MS}


def test_latencies_of_two_machines_stand_beside_each_other(tmp_path: Path) -> None:
    slow, fast = made_on("Old", 2.0, row_id="a", frames=3), made_on("New", 0.5, row_id="b", frames=3)
    rows = read_rows([write(tmp_path / "both", slow, fast)])
    assert {row["row_id"]: row["latency_reference_ms"] for row in rows} == {"a": 5.5, "b": 22.0}
    assert {row["row_id"]: row["processor"] for row in rows} == {"a": "Old", "b": "New"}
    assert "latency_reference_ms,processor\n" in render.csv(rows)
    assert "| latency [ms] | latency on the reference machine [ms] | processor |" in render.markdown(rows)
    assert "| **11.0** | 5.5 | Old |" in render.markdown(rows)
    assert "Old" in render.table(rows, width=40)
    # Of one machine there is nothing to compare.
    alone = read_rows([write(tmp_path / "one", slow)])
    assert "reference machine" not in render.markdown(alone)
    mixed = only(read_rows([write(tmp_path / "mixed", slow, made_on("New", 1.0, row_id="a", unit="001-left"))]))
    assert mixed["processor"] == "New and Old"


@pytest.mark.parametrize("environment", [None, [], {"machine": 3}, {"machine": {"processor": ["x"]}}])
def test_whatever_a_record_says_of_its_machine(tmp_path: Path, environment: Any) -> None:
    row = only(read_rows([write(tmp_path, record() | {"environment": environment})]))
    assert "processor" not in row


def test_lags_and_the_filters_time_are_in_rows_of_new_records_only(tmp_path: Path) -> None:
    old = only(read_rows([write(tmp_path / "old", record())]))
    assert (old["latency_filter_ms"], old["lag_ms"], old["start_lag_ms"]) == (None, None, None)
    new = []
    for unit, lag in (("000-left", 10.0), ("001-left", 20.0)):
        content = record(unit=unit, frames=3)
        content["frames"]["latency_filter_ms"] = [0.1, 0.2, 0.3]
        content["errors"] |= {"lag_ms": [lag], "start_lag_ms": [None]}
        new.append(content)
    row = only(read_rows([write(tmp_path / "new", *new)]))
    assert (row["latency_filter_ms"], row["lag_ms"], row["start_lag_ms"]) == (0.2, 15.0, None)


def test_a_start_lag_stands_in_markdown_and_in_terminals(tmp_path: Path) -> None:
    content = record()
    content["errors"]["start_lag_ms"] = [12.34]
    rows = read_rows([write(tmp_path, content)])
    assert "| start lag [ms] |" in render.markdown(rows)
    assert "12.3" in render.table(rows, width=140)
    assert "12.3" in render.table(rows, width=40)


def test_without_truth_only_the_mask_error_is_left(tmp_path: Path) -> None:
    row = only(read_rows([write(tmp_path, record(truth=False))]))
    assert row["mask_error"] == pytest.approx(0.05)
    assert [error for error in ERRORS if row[error] is not None] == ["mask_error"]
    assert row["jitter"] == 0.5
    assert row["lost_frames"] == 1
    text = render.table([row], width=80)
    assert "rot." not in text
    assert "0.050" in text


def test_null_values_of_single_frames_are_left_out(tmp_path: Path) -> None:
    content = record(frames=3)
    content["errors"]["keypoint_error_px"] = [[1.0], [None], [3.0]]
    assert only(read_rows([write(tmp_path, content)]))["keypoint_error_px"] == 2.0


def test_failed_record_is_a_row_with_coverage(tmp_path: Path) -> None:
    late = {"status": "timeout", "error": "no answer in 60 s", "unit_frames": 16}
    stopped = record(unit="000-right", frames=4) | late
    row = only(read_rows([write(tmp_path, record(frames=4), stopped)]))
    assert (row["status"], row["error"]) == ("timeout", "no answer in 60 s")
    assert row["coverage"] == 8 / 20
    assert row["mask_error"] is not None
    nothing = only(read_rows([write(tmp_path / "b", failed())]))
    assert (nothing["status"], nothing["coverage"], nothing["mask_error"]) == ("failed", 0.0, None)


def test_folders_are_merged_and_a_run_counts_once(runs: Path, tmp_path: Path) -> None:
    other = write(tmp_path / "other", record(), record(row_id="gd-10"))
    rows = read_rows([runs, other])
    assert [(row["row_id"], row["frames"]) for row in rows] == [("gd-10", 4), ("cmaes", 10), ("stuck", 0)]
    assert read_rows([other, runs]) == rows
    assert read_rows([runs, runs]) == read_rows([runs])


def test_a_sound_record_replaces_a_failed_one_of_the_same_run(tmp_path: Path) -> None:
    first, second = write(tmp_path / "a", failed()), write(tmp_path / "b", record())
    for order in ([first, second], [second, first]):
        assert only(read_rows(order))["status"] == "ok"


@pytest.mark.parametrize(
    "other",
    [
        record(unit="000"),
        record(dataset=("mini", "cd" * 32)),
        with_seed(1, record()),
    ],
    ids=["arms", "dataset", "settings"],
)
def test_what_is_not_one_row(tmp_path: Path, other: dict[str, Any]) -> None:
    write(tmp_path / "a", record())
    write(tmp_path / "b", other)
    assert len(read_rows([tmp_path])) == 2


def test_two_datasets_of_one_name_can_be_told_apart(tmp_path: Path) -> None:
    write(tmp_path / "a", record())
    write(tmp_path / "b", record(dataset=("mini", "cd" * 32)))
    assert {row["dataset"] for row in read_rows([tmp_path])} == {"mini@abababab", "mini@cdcdcdcd"}


def test_order_of_files_does_not_matter(tmp_path: Path) -> None:
    records = [record(row_id=name, unit=unit) for name in "cab" for unit in ("000-left", "001-left")]
    first = read_rows([write(tmp_path / "a", *records)])
    assert [row["row_id"] for row in first] == ["a", "b", "c"]
    assert read_rows([write(tmp_path / "b", *reversed(records))]) == first


def test_dual_arms_count_both(tmp_path: Path) -> None:
    content = record(unit="000", frames=2)
    content["errors"]["rotation_error_rad"] = [[0.1, 0.3], [0.2, 0.6]]
    row = only(read_rows([write(tmp_path, content)]))
    assert row["arms"] == "dual"
    assert row["rotation_error_rad"] == pytest.approx(0.3)


def test_other_json_files_are_not_records(runs: Path) -> None:
    (runs / "dataset.json").write_text('{"format": "surgbench-dataset-1"}', encoding="utf-8")
    (runs / "list.json").write_text("[1, 2]", encoding="utf-8")
    assert len(read_records([runs])) == 3


def test_truncated_record_is_named(runs: Path) -> None:
    path = next(runs.rglob("000-left-r0.json"))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DatasetError, match="truncated") as caught:
        read_rows([runs])
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def _drop_settings(content: dict[str, Any]) -> None:
    del content["settings_hash"]


def _drop_row_id(content: dict[str, Any]) -> None:
    del content["spec"]["row_id"]


def _shorten_errors(content: dict[str, Any]) -> None:
    content["errors"]["q1_error_rad"].pop()


def _shorten_states(content: dict[str, Any]) -> None:
    content["frames"]["state"].pop()


def _spoil_error(content: dict[str, Any]) -> None:
    content["errors"]["mask_error"] = ["much"]


def _newer(content: dict[str, Any]) -> None:
    content["format"] = "surgbench-record-9"


@pytest.mark.parametrize(
    ("spoil", "names"),
    [
        (_drop_settings, "settings_hash"),
        (_drop_row_id, "spec.row_id"),
        (_shorten_errors, "errors.q1_error_rad"),
        (_shorten_states, "state"),
        (_spoil_error, "errors.mask_error"),
        (_newer, "surgbench-record-9"),
    ],
)
def test_spoilt_record_is_named_with_its_key(tmp_path: Path, spoil: Any, names: str) -> None:
    content = record()
    path = write(tmp_path, content) and next(tmp_path.rglob("*.json"))
    spoil(content)
    path.write_text(json.dumps(as_written(content)), encoding="utf-8")
    with pytest.raises(DatasetError) as caught:
        read_rows([tmp_path])
    assert str(path) in str(caught.value)
    assert names in str(caught.value)
    assert "\n" not in str(caught.value)


def _zero_errors(content: dict[str, Any]) -> None:
    content["errors"]["mask_error"] = [0.0] * len(content["errors"]["mask_error"])


def _rename_variant(content: dict[str, Any]) -> None:
    content["variant"] = "better"


def _change_option(content: dict[str, Any]) -> None:
    content["spec"]["tracker"]["options"]["iterations"] = 1


def _unseal(content: dict[str, Any]) -> None:
    del content["seal"]


@pytest.mark.parametrize("edit", [_zero_errors, _rename_variant, _change_option, _unseal])
def test_an_edited_record_is_not_believed(runs: Path, edit: Any) -> None:
    path = next(runs.rglob("000-left-r0.json"))
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(DatasetError) as caught:
        read_rows([runs])
    assert str(caught.value).startswith(f"{path}: altered: ")
    assert "run it again with: surgbench run … --again" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_how_a_record_is_laid_out_is_no_alteration(runs: Path) -> None:
    rows = read_rows([runs])
    for path in runs.rglob("*.json"):
        path.write_text(json.dumps(json.loads(path.read_text()), indent=1), encoding="utf-8")
    assert read_rows([runs]) == rows


def test_records_without_a_seal_are_still_read_and_their_spec_is_checked(tmp_path: Path) -> None:
    write(tmp_path, record())
    path = next(tmp_path.rglob("*.json"))
    old = {key: value for key, value in json.loads(path.read_text()).items() if key != "seal"}
    path.write_text(json.dumps(old | {"format": "surgbench-record-1"}), encoding="utf-8")
    assert only(read_rows([tmp_path]))["mask_error"] is not None
    path.write_text(json.dumps(old | {"format": "surgbench-record-1", "spec": {**old["spec"], "seed": 7}}))
    with pytest.raises(DatasetError, match="altered: its 'spec'"):
        read_rows([tmp_path])


def test_folder_without_records_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="holds no records"):
        read_rows([tmp_path])
    with pytest.raises(DatasetError, match="no such folder"):
        read_rows([tmp_path / "nowhere"])


@pytest.mark.parametrize("width", [40, 60, 80, 120, 140])
def test_a_table_of_any_width_has_all_columns_each_with_the_rows_name(runs: Path, width: int) -> None:
    rows = read_rows([runs])
    text = render.table(rows, width=width)
    tables, failures = text.split("stuck: failed: ")
    assert max(len(line) for line in tables.splitlines()) <= width
    assert failures == "ValueError: step | returned (3,)\n"
    named = [line for line in tables.splitlines() if line.split()[:1] == ["cmaes"]]
    cells = [column.cell(rows[0]) for column in set_columns(rows) if column not in (ROW, VARIANT)]
    assert " ".join(" ".join(line.split()[1:]) for line in named) == " ".join([*cells, "none/truth kalman"])
    assert len(named) == len([line for line in tables.splitlines() if line.split()[:1] == ["stuck"]])


def test_table_shows_variants_where_names_are_the_same(tmp_path: Path) -> None:
    write(tmp_path / "a", record())
    other = with_seed(1, record(), variant="readings")
    write(tmp_path / "b", other)
    assert "readings" in render.table(read_rows([tmp_path]), width=80)


def test_two_plugins_of_one_name_can_be_told_apart(tmp_path: Path) -> None:
    for folder, source in (("a", "a.py:Still@1a2b3c4d"), ("b", "b.py:Still@5e6f7a8b")):
        content = record()
        tracker = content["spec"]["tracker"] | {"source": source}
        content |= {"spec": content["spec"] | {"tracker": tracker}, "settings_hash": source[-8:]}
        write(tmp_path / folder, content)
    rows = read_rows([tmp_path])
    assert {row["variant"] for row in rows} == {f"none/truth kalman, cmaes@{digits}" for digits in ("1a2b3c", "5e6f7a")}
    assert "cmaes@1a2b3c" in render.table(rows, width=80).replace("\n", "")
    # What is only there once needs no hash.
    assert only(read_rows([tmp_path / "a"]))["variant"] == "none/truth kalman"


def test_rows_that_nothing_tells_apart_get_the_hash_of_their_settings(tmp_path: Path) -> None:
    for seed in (1, 2):
        write(tmp_path / str(seed), with_seed(seed, record()))
    variants = {row["variant"] for row in read_rows([tmp_path])}
    assert variants == {"none/truth kalman, settings 111111", "none/truth kalman, settings 222222"}


def test_brackets_in_names_are_not_markup(tmp_path: Path) -> None:
    console = Console(file=io.StringIO(), width=100)
    render.print_leaderboard(read_rows([write(tmp_path, record(row_id="a[b]"))]), console)
    assert "a[b]" in console.file.getvalue()  # type: ignore[attr-defined]


FORMULAS = ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "'=1", "''-1"]


@pytest.mark.parametrize("text", [*FORMULAS, "'quoted'", "a=1", "5 - 3"])
def test_no_cell_of_text_is_a_formula_and_none_is_lost(text: str) -> None:
    fields = (*field_text("row_id"), *number("error"))
    written = csv_text(to_frame([{"row_id": text, "error": -1.5}, {"row_id": None, "error": None}], fields))
    cells = list(csv.reader(io.StringIO(written)))[1]
    assert cells == [f"'{text}" if text in FORMULAS else text, "-1.5"]
    assert to_rows(read_csv(written, fields)) == [{"row_id": text, "error": -1.5}, {"row_id": None, "error": None}]


GOLDEN_LATEX = r"""% \usepackage{booktabs}; best in bold, second best underlined, floors and failed runs not ranked

\begin{table}
  \centering
  \caption{mini, single arms}
  \label{tab:mini-single-arms}
  \begin{tabular}{llrrrrrrrrrrr}
    \toprule
    row & sequences & mask error & true mask error & rotation & translation & tips & q1 & q2 & q3 & keypoints & latency & p95 \\
     &  &  &  & [rad] & [mm] & [mm] & [rad] & [rad] & [rad] & [px] & [ms] & [ms] \\
    \midrule
    ours\_1 & 1 & \textbf{0.020} & \textbf{0.010} & \textbf{0.100} & \textbf{1.00} & \textbf{2.00} & \textbf{0.050} & \textbf{0.025} & \textbf{0.013} & \textbf{1.0} & \textbf{10.0} & 10.0 \\
    theirs & 1 & \underline{0.030} & \underline{0.015} & \underline{0.150} & \underline{1.50} & \underline{3.00} & \underline{0.075} & \underline{0.038} & \underline{0.019} & \underline{1.5} & \underline{10.5} & 10.9 \\
    third & 1 & 0.040 & 0.020 & 0.200 & 2.00 & 4.00 & 0.100 & 0.050 & 0.025 & 2.0 & 11.0 & 11.9 \\
    \bottomrule
  \end{tabular}
\end{table}
"""  # noqa: E501


def test_a_table_for_a_paper(tmp_path: Path) -> None:
    rows = read_rows([
        write(tmp_path, record("third", frames=3), record("theirs", frames=2), record("ours_1", frames=1))
    ])  # fmt: skip
    assert latex(rows) == GOLDEN_LATEX


def test_names_are_no_commands_of_latex() -> None:
    assert escape(r"\input{a} $%&#_^~ 5°" + "\n\x1b") == (
        r"\textbackslash{}input\{a\} \$\%\&\#\_\textasciicircum{}\textasciitilde{} 5$^\circ$"
    )


def run_cli(*arguments: str) -> str:
    app = typer.Typer()
    app.command()(report)
    result = CliRunner().invoke(app, list(arguments), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def test_command_writes_every_format(runs: Path, tmp_path: Path) -> None:
    rows = read_rows([runs])
    assert "mini, single arms" in run_cli(str(runs))
    for name, how in {"csv": render.csv, "markdown": render.markdown, "json": render.json, "latex": latex}.items():
        text = how(rows)
        assert run_cli(str(runs), "--format", name) == text
        assert run_cli(str(runs), "--format", name, "--out", str(tmp_path / name)) == ""
        assert (tmp_path / name).read_text(encoding="utf-8") == text
