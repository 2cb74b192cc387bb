"""Estimates that another program made: a record like any other, and one line for a file that is wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commandline import records, surgbench
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from small_dataset import FRAMES, make_pair

from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray, look_at_rotation, rotation_angle
from surgbench.metrics import POSE_ERRORS
from surgbench.records.reader import read_record
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.estimates_file import read_estimates
from surgbench.tasks.instrument.pose_table import POSE_COLUMNS, PoseTable, pose_columns
from surgbench.tasks.instrument.records import REFERENCE_ERRORS


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> InstrumentDataset:
    return make_pair(tmp_path_factory.mktemp("data") / "pairs")


@pytest.fixture(scope="module")
def truth(dataset: InstrumentDataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "csv"
    surgbench("export", dataset.path, "--format", "csv", "--out", out)
    return out / "truth.csv"


def table(path: Path) -> pd.DataFrame:
    return pd.read_csv(path, dtype={"sequence": str})


@pytest.mark.parametrize("arms", ["single", "dual"])
def test_the_truth_handed_in_scores_zero_in_every_column(
    dataset: InstrumentDataset, truth: Path, tmp_path: Path, arms: str
) -> None:
    runs = tmp_path / "runs"
    surgbench("score", dataset.path, truth, "--name", "mine", "--arms", arms, "--out", runs)
    written = records(runs)
    assert len(written) == {"single": 4, "dual": 2}[arms]
    for record in written:
        assert record["status"] == "ok"
        for name in (*POSE_ERRORS, "mask_error", "mask_error_true", "translation_error_scaled_m", "lag_ms"):
            assert record["errors"][name] is not None, name
            np.testing.assert_allclose(np.array(record["errors"][name], float), 0.0, atol=1e-15, err_msg=name)
    surgbench("report", runs, "--format", "json", "--out", tmp_path / "board.json")
    (row,) = json.loads((tmp_path / "board.json").read_text())
    assert (row["row_id"], row["variant"], row["arms"], row["coverage"]) == ("mine", "from file", arms, 1.0)
    wrong = {key: value for key, value in row.items() if "error" in key and key != "error" and value not in (0.0, None)}
    assert not wrong
    assert row["tip_error_m"] == row["mask_error_true"] == row["keypoint_error_px"] == 0.0
    assert row["latency_ms"] is None
    assert row["start_lag_ms"] is None  # where its search began nobody knows


@pytest.mark.parametrize("arms", ["single", "dual"])
def test_so_it_does_where_frames_are_missing(tmp_path: Path, arms: str) -> None:
    dataset = make_pair(tmp_path / "gaps", sequences=1, steps=(0, 1, 5, 11))
    surgbench("export", dataset.path, "--format", "csv", "--out", tmp_path / "csv")
    assert sorted(set(table(tmp_path / "csv/truth.csv")["timestamp_s"])) == pytest.approx([0.0, 0.1, 0.5, 1.1])
    score = ("score", dataset.path, tmp_path / "csv/truth.csv", "--name", "mine", "--arms", arms)
    surgbench(*score, "--out", tmp_path / "runs")
    surgbench("report", tmp_path / "runs", "--format", "json", "--out", tmp_path / "board.json")
    (row,) = json.loads((tmp_path / "board.json").read_text())
    assert {key for key in row if "error" in key and row[key] not in (0.0, None)} == set()
    assert row["tip_error_m"] == row["mask_error"] == row["mask_error_true"] == 0.0


def test_records_say_where_they_are_from_and_are_sealed(
    dataset: InstrumentDataset, truth: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ("score", dataset.path, truth, "--name", "mine", "--out", tmp_path / "runs")
    surgbench(*command)
    capsys.readouterr()
    surgbench(*command)
    assert "4 recorded already" in capsys.readouterr().err
    path = sorted((tmp_path / "runs").rglob("*.json"))[0]
    content = json.loads(path.read_text())
    assert content["spec"]["tracker"]["source"].startswith("from file@")
    assert content["from_file"]["name"] == "truth.csv"
    path.write_text(json.dumps({**content, "variant": "default"}))
    with pytest.raises(DatasetError, match="altered"):
        read_record(path)


def test_a_run_that_is_exported_and_scored_has_the_same_figures(
    dataset: InstrumentDataset, truth: Path, tmp_path: Path
) -> None:
    off = table(truth).drop(columns=["qw", "qx", "qy", "qz"])
    off["x_m"] += 0.002
    off["beta_rad"] += 0.05
    off["q2_rad"] -= 0.1
    off["took"] = 10.0 + off["frame"]
    off["lost"] = (off["frame"] == 2).astype(int)
    off["confidence"] = 0.75
    for column in ("alpha", "beta", "gamma", "x", "y", "z", "q1", "q2", "q3"):
        off[f"sd_{column}_{'m' if column in 'xyz' else 'rad'}"] = 0.01 + 0.001 * off["frame"]
    off.to_csv(tmp_path / "off.csv", index=False)
    score = ("score", dataset.path)
    surgbench(*score, tmp_path / "off.csv", "--name", "mine", "--time-ms", "took", "--out", tmp_path / "first")
    surgbench("export", tmp_path / "first", "--format", "csv", "--out", tmp_path / "csv")
    again = tmp_path / "csv" / "mine.csv"
    surgbench(*score, again, "--name", "mine", "--time-ms", "latency_ms", "--out", tmp_path / "second")
    first, second = records(tmp_path / "first"), records(tmp_path / "second")
    assert len(first) == len(second) == 4
    for one, other in zip(first, second, strict=True):
        assert one["errors"] == other["errors"]
        assert one["frames"] == other["frames"]
        assert one["frames"]["latency_ms"] == [10.0, 11.0, 12.0, 13.0]
        assert one["frames"]["lost"] == [False, False, True, False]
        assert one["errors"]["translation_error_m"][0] == [pytest.approx(0.002)]
        assert one["errors"]["q2_error_rad"][0] == [pytest.approx(0.1)]
        assert one["errors"]["interval_coverage_q1"][0] == [1.0]


FORMS: dict[str, Callable[[FloatArray], dict[str, FloatArray]]] = {
    "quaternion": lambda R: dict(zip(("qx", "qy", "qz", "qw"), Rotation.from_matrix(R).as_quat().T, strict=True)),
    "vector": lambda R: dict(zip(("rx_rad", "ry_rad", "rz_rad"), Rotation.from_matrix(R).as_rotvec().T, strict=True)),
    "degrees": lambda R: dict(
        zip(("rx_deg", "ry_deg", "rz_deg"), np.degrees(Rotation.from_matrix(R).as_rotvec()).T, strict=True)
    ),
    "matrix": lambda R: {f"r{i + 1}{j + 1}": R[:, i, j] for i in range(3) for j in range(3)},
}


@given(
    angles=st.tuples(st.floats(-1.5, 1.5), st.floats(-3.1, 3.1), st.floats(-3.1, 3.1)),
    place=st.tuples(*(st.floats(-0.5, 0.5),) * 3),
    joints=st.tuples(*(st.floats(-1.5, 1.5),) * 3),
    form=st.sampled_from(sorted(FORMS)),
)
def test_any_form_and_unit_of_a_pose_means_the_same(
    angles: tuple[float, ...], place: tuple[float, ...], joints: tuple[float, ...], form: str
) -> None:
    state = np.array([[*angles, *place, *joints]])
    columns = {f"{name}_mm": 1e3 * state[:, 3 + number] for number, name in enumerate("xyz")}
    columns |= FORMS[form](look_at_rotation(state[:, :3]))
    columns |= {"q1_deg": np.degrees(state[:, 6]), "q2_rad": state[:, 7], "jaw_rad": 2.0 * state[:, 8]}
    read = PoseTable("x.csv", list(columns), np.stack(list(columns.values()), axis=1), [2]).states()
    apart = look_at_rotation(read[:, :3]).swapaxes(1, 2) @ look_at_rotation(state[:, :3])
    assert rotation_angle(apart).max() < 1e-7
    np.testing.assert_allclose(read[:, 3:], state[:, 3:], atol=1e-9)


@given(
    state=st.lists(st.floats(-1.5, 1.5), min_size=9, max_size=9),
)
def test_what_is_written_is_the_same_to_the_last_bit_when_read(state: list[float]) -> None:
    states = np.array([state])
    assert np.array_equal(PoseTable("x.csv", POSE_COLUMNS, pose_columns(states), [2]).states(), states)


def change(column: str, value: object, row: int = 1) -> Callable[[pd.DataFrame], pd.DataFrame]:
    def changed(frame: pd.DataFrame) -> pd.DataFrame:
        values = frame[column].tolist()
        values[row] = value
        return frame.assign(**{column: values})

    return changed


ROTATIONS = ["qw", "qx", "qy", "qz", "alpha_rad", "beta_rad", "gamma_rad"]
WRONG: dict[str, tuple[Callable[[pd.DataFrame], pd.DataFrame], str]] = {
    "a frame is missing": (lambda t: t.drop(index=2), "frame 2 of the left arm of '000' is missing.*--frames 2"),
    "a frame is there twice": (
        lambda t: change("frame", 0)(t).drop(columns="timestamp_s"),
        r"line 3: frame 0 .* is there twice \(line 2\)",
    ),
    "a frame too many": (change("frame", FRAMES), "'frame' is 4; '000' has 0 to 3"),
    "unknown arm": (change("arm", "lefft"), "line 3: unknown arm 'lefft'; did you mean 'left'"),
    "unknown sequence": (change("sequence", "007"), "line 3: unknown sequence '007'"),
    "no unit length": (change("qw", 3.0), "line 3: the quaternion qw, qx, qy, qz has the length 3.*; must be 1"),
    "degrees": (change("q1_rad", 45.0), "'q1' is 45 rad; for degrees name the column 'q1_deg'"),
    "degrees of the pose": (change("beta_rad", 120.0), "an angle is 120 rad; for degrees .* beta_deg"),
    "millimetres": (change("z_m", 130.0), "is 130 m away; for millimetres name the columns 'x_mm', 'y_mm', 'z_mm'"),
    "metres called millimetres": (
        lambda t: t.rename(columns={f"{axis}_m": f"{axis}_mm" for axis in "xyz"}),
        "no wrist is further than .* mm from the camera; for metres name the columns 'x_m', 'y_m', 'z_m'",
    ),
    "OpenGL's camera": (
        lambda t: t.assign(z_m=-t["z_m"], y_m=-t["y_m"]),
        "every wrist is behind the camera .* OpenCV's, z forward and y down",
    ),
    "two rotations": (change("beta_rad", 0.9), "its rotations differ by .* rad"),
    "no number": (change("x_m", "left"), "line 3: 'x_m' must be a number"),
    "nothing": (change("q3_rad", np.nan), "line 3: 'q3_rad' must be a number .*with lost 1"),
    "no rotation": (
        lambda t: t.drop(columns=["qw", "qx", "qy", "qz", "alpha_rad", "beta_rad", "gamma_rad"]),
        "no rota",
    ),
    "no joint": (lambda t: t.drop(columns="q3_rad"), "has no column 'q3_rad' or 'q3_deg'"),
    "no unit": (lambda t: t.rename(columns={"x_m": "x"}), "no column 'x_m' or 'x_mm' .not 'x': the name says the unit"),
    "no arm": (lambda t: t.drop(columns="arm"), "has no column 'arm', and 'pairs' has more than one"),
    "no frame": (lambda t: t.drop(columns=["frame", "timestamp_s"]), "has no column 'frame' .*, nor 'timestamp_s'"),
    "another frame's stamp": (change("timestamp_s", 0.2), "line 3: frame 1 has the timestamp_s of frame 2 of '000'"),
    "a stamp between two frames": (
        change("timestamp_s", 0.15),
        "line 3: 'timestamp_s' is 0.15, which is no frame's; the nearest of '000' is 1, at 0.1 s",
    ),
    "stamps since 1970": (
        lambda t: t.assign(timestamp_s=1.7e9 + t["timestamp_s"]),
        "which is no frame's; .*; a column that counts otherwise has another name",
    ),
    "a stamp twice": (
        lambda t: change("timestamp_s", 0.0)(t).drop(columns="frame"),
        r"line 3: frame 0 .* is there twice \(line 2\)",
    ),
    "no stamp": (
        lambda t: change("timestamp_s", np.nan)(t).drop(columns="frame"),
        "line 3: 'timestamp_s' must be a number, not ''",
    ),
    "too many rows": (
        lambda t: pd.concat([t, t.tail(1).assign(frame=FRAMES)]),
        "line 18: 'frame' is 4; '001' has 0 to 3",
    ),
    "both of the jaws": (lambda t: t.assign(jaw_rad=0.1), "has both 'q3' .* and 'jaw'"),
    "no matrix": (
        lambda t: t.drop(columns=ROTATIONS).assign(**{f"r{i}{j}": 1.0 for i in (1, 2, 3) for j in (1, 2, 3)}),
        "line 2: r11, r12, ... r33 is no rotation matrix",
    ),
    "half a quaternion": (lambda t: t.drop(columns="qw"), "has no column 'qw'"),
    "no rows": (lambda t: t.head(0), "holds no estimates"),
    "lost is no flag": (lambda t: t.assign(lost="maybe"), "line 2: 'lost' must be 0 or 1, not 'maybe'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_one_line_and_leaves_nothing(
    dataset: InstrumentDataset, truth: Path, tmp_path: Path, case: str, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil, message = WRONG[case]
    spoil(table(truth)).to_csv(tmp_path / "e.csv", index=False)
    with pytest.raises(DatasetError, match=message):
        read_estimates(tmp_path / "e.csv", dataset)
    surgbench("score", dataset.path, tmp_path / "e.csv", "--name", "x", "--out", tmp_path / "runs", expect=2)
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (tmp_path / "runs").exists()


def test_wrong_files_options_and_datasets_are_one_line(
    dataset: InstrumentDataset, truth: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, words in (
        ((tmp_path / "none.csv", "--name", "x"), "no such file"),
        ((truth, "--name", "a b"), "--name: must be letters, digits"),
        ((truth, "--name", "x", "--time-ms", "took"), "has no column 'took'"),
    ):
        surgbench("score", dataset.path, *arguments, "--out", tmp_path / "runs", expect=2)
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert words in line
    assert not (tmp_path / "runs").exists()


def test_stamps_may_stand_for_frames(dataset: InstrumentDataset, truth: Path, tmp_path: Path) -> None:
    """Rounded as programs write them."""
    rows = table(truth).drop(columns="frame")
    rows["timestamp_s"] += 0.004
    rows.sample(frac=1.0, random_state=1).to_csv(tmp_path / "e.csv", index=False)
    for (sequence, arm), estimates in read_estimates(tmp_path / "e.csv", dataset).arms.items():
        true = dataset.sequence(sequence).states(arm)
        assert true is not None
        np.testing.assert_allclose(estimates.states, true, rtol=1e-14, atol=1e-300)


def test_tables_of_other_programs_are_read_too(dataset: InstrumentDataset, truth: Path, tmp_path: Path) -> None:
    """Zeros that are lost, semicolons, a byte order mark, comments, blanks, columns nobody knows, any order of rows."""
    rows = table(truth)
    shuffled = rows.sample(frac=1.0, random_state=0)
    shuffled["sequence"] = shuffled["sequence"].astype(int)
    shuffled["note"] = "by hand"
    text = shuffled.to_csv(index=False, sep=";").replace(";", " ; ")
    (tmp_path / "e.csv").write_text(f"# made by a robot\n\n{text}", encoding="utf-8-sig")
    read = read_estimates(tmp_path / "e.csv", dataset)
    assert set(read.arms) == {(id_, arm) for id_ in ("000", "001") for arm in ("left", "right")}
    for (sequence, arm), estimates in read.arms.items():
        true = dataset.sequence(sequence).states(arm)
        assert true is not None
        np.testing.assert_allclose(estimates.states, true, rtol=1e-14, atol=1e-300)


def test_a_part_of_a_dataset_is_scored_as_a_part(dataset: InstrumentDataset, truth: Path, tmp_path: Path) -> None:
    rows = table(truth)
    rows[(rows["sequence"] == "000") & (rows["frame"] < 3)].to_csv(tmp_path / "e.csv", index=False)
    command = ("score", dataset.path, tmp_path / "e.csv", "--name", "x", "--out", tmp_path / "runs")
    surgbench(*command, expect=2)
    surgbench(*command, "--frames", 3)
    written = records(tmp_path / "runs")
    assert [record["spec"]["unit"] for record in written] == ["000-left", "000-right"]
    assert all(record["unit_frames"] == 3 and record["spec"]["frames_limit"] == 3 for record in written)


def test_recordings_without_truth_are_scored_by_their_masks(truth: Path, tmp_path: Path) -> None:
    recording = make_pair(tmp_path / "recording", truth=False)
    surgbench("score", recording.path, truth, "--name", "x", "--joints", "--out", tmp_path / "runs")
    for record in records(tmp_path / "runs"):
        assert record["errors"]["mask_error"] == [0.0] * FRAMES
        assert record["errors"]["tip_error_m"] is None
        assert record["spec"]["readings"] == "noisy"
        for name in REFERENCE_ERRORS:  # its tips and readings are those of the states
            np.testing.assert_allclose(np.array(record["errors"][name], float), 0.0, atol=1e-9, err_msg=name)


def test_estimates_from_a_file_are_drawn_as_any_others(
    dataset: InstrumentDataset, truth: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs"
    surgbench("score", dataset.path, truth, "--name", "mine", "--out", runs)
    surgbench("video", runs, "--unit", "000-left", "--out", tmp_path / "film")
    assert {path.name for path in (tmp_path / "film").iterdir()} == {"000-left.mp4", "000-left.png"}
    surgbench("video", runs, "--unit", "000-left", "--samples", "--out", tmp_path / "film", expect=2)
    assert "no tracker here shows its candidates" in capsys.readouterr().err  # nothing can be repeated
