"""Recorded poses: tables as people write them, put in order, and resampled without inventing anything."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray, rigid_transform, rotation_angle
from surgbench.recordings import poses as poses_module
from surgbench.recordings.pose_table import HEADER, count_rows, read_pose_table
from surgbench.recordings.poses import RecordedPoses, put_in_order
from surgbench.recordings.resampling import resample, usual_gap_s

ROWS = ["0,0.1,0.2,0.3,0,0,0,1", "0.01,0.101,0.2,0.3,0,0,0,1", "0.02,0.102,0.2,0.3,0,0,0.6,0.8"]


def table(folder: Path, *lines: str, encoding: str = "utf-8") -> Path:
    path = folder / "path.csv"
    path.write_text("\n".join(lines) + "\n", encoding=encoding)
    return path


def read(path: Path, **told: str) -> RecordedPoses:
    return put_in_order(read_pose_table(path), **told)  # type: ignore[arg-type]


def refused(path: Path) -> str:
    with pytest.raises(SurgbenchError) as raised:
        read(path)
    said = str(raised.value)
    assert str(path) in said
    assert "\n" not in said
    return said


@pytest.mark.parametrize(
    ("header", "rows"),
    [
        (HEADER, ROWS),
        ("# timestamp tx ty tz qx qy qz qw", [row.replace(",", " ") for row in ROWS]),
        ("# a comment that is no header\n", [row.replace(",", " ") for row in ROWS]),
        ("Time [s];X [m];Y [m];Z [m];Qx;Qy;Qz;Qw", [row.replace(",", ";").replace(".", ",") for row in ROWS]),
        ("sep=;\ntime;x;y;z;qx;qy;qz;qw", [row.replace(",", ";") for row in ROWS]),
        (
            "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.pose.position.x,"
            "field.pose.position.y,field.pose.position.z,field.pose.orientation.x,field.pose.orientation.y,"
            "field.pose.orientation.z,field.pose.orientation.w",
            [f"{5 * k},{k},{1700000000000000000 + k * 10**7},ECM,{row.split(',', 1)[1]}" for k, row in enumerate(ROWS)],
        ),
        (
            "jaw,/PSM1/measured_cp/transform/translation/x,/PSM1/measured_cp/transform/translation/y,"
            "/PSM1/measured_cp/transform/translation/z,/PSM1/measured_cp/transform/rotation/x,"
            "/PSM1/measured_cp/transform/rotation/y,/PSM1/measured_cp/transform/rotation/z,"
            "/PSM1/measured_cp/transform/rotation/w,t_ms",
            [f"0.4,{row.split(',', 1)[1]},{10 * k}" for k, row in enumerate(ROWS)],
        ),
    ],
    ids=["own", "tum", "tum without names", "decimal comma", "spreadsheet", "rostopic", "plot"],
)
def test_tables_of_all_kinds_say_the_same(header: str, rows: list[str], tmp_path: Path) -> None:
    found = read(table(tmp_path, header, *rows))
    np.testing.assert_allclose(found.times_s, [0.0, 0.01, 0.02], atol=1e-6)
    np.testing.assert_allclose(found.position_m, [[0.1, 0.2, 0.3], [0.101, 0.2, 0.3], [0.102, 0.2, 0.3]])
    np.testing.assert_allclose(found.quaternion[2], [0, 0, 0.6, 0.8])


def test_units_are_as_named_as_told_or_doubted(tmp_path: Path) -> None:
    rows = ["0,100,200,300,0,0,0,1", "10,101,200,300,0,0,0,1", "20,102,200,300,0,0,0,1"]
    named = read(table(tmp_path, "t_ms,x_mm,y_mm,z_mm,qx,qy,qz,qw", *rows))
    np.testing.assert_allclose(named.position_m[1], [0.101, 0.2, 0.3])
    np.testing.assert_allclose(named.times_s[1], 0.01)
    nameless = table(tmp_path, "t,x,y,z,qx,qy,qz,qw", *rows)
    assert "lines are 10 s apart (median), taken in s; are they in ms? --time-unit ms" in refused(nameless)
    with pytest.raises(SurgbenchError, match="did you give millimetres\\? --unit mm"):
        read(nameless, time_unit="ms")
    told = read(nameless, time_unit="ms", unit="mm")
    np.testing.assert_allclose(told.position_m, named.position_m)
    metres = read(table(tmp_path, HEADER.replace("_m", ""), *ROWS), unit="mm")
    assert any("extends over 0.002 mm only; are these metres? --unit m" in line for line in metres.lines)


def test_the_order_of_a_quaternion_without_a_name_is_told(tmp_path: Path) -> None:
    path = table(tmp_path, "0 0.1 0.2 0.3 1 0 0 0", "0.01 0.11 0.2 0.3 0.8 0 0 0.6")
    raw = read_pose_table(path, order="wxyz")
    assert raw.lines == [
        "no names of columns: taken as time x y z qw qx qy qz (--quaternion xyzw if the quaternion is so)"
    ]
    np.testing.assert_allclose(put_in_order(raw).quaternion, [[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.6, 0.8]])


def test_columns_may_be_told(tmp_path: Path) -> None:
    path = table(tmp_path, "time,x,y,z,a,b,c,d,e", *(row + ",7" for row in ROWS))
    assert "has no column for 'qx' (time, x, y, z, a, b, c, d, e); --columns qx=NAME" in refused(path)
    told = {"qx": "a", "qy": "b", "qz": "c", "qw": "d"}
    np.testing.assert_allclose(put_in_order(read_pose_table(path, columns=told)).quaternion[2], [0, 0, 0.6, 0.8])
    with pytest.raises(SurgbenchError, match="--columns: unknown column 'tiem'; did you mean 'time'"):
        read_pose_table(path, columns={"time": "tiem"})


def test_rows_without_a_pose_and_rows_of_one_time_are_told(tmp_path: Path) -> None:
    rows = [ROWS[0], ROWS[0], "0.005,nan,nan,nan,,,,", ROWS[1], "0.01,0.2,0.2,0.3,0,0,0,1", ROWS[2]]
    found = read(table(tmp_path, HEADER, *rows))
    np.testing.assert_allclose(found.times_s, [0, 0.01, 0.02])
    assert found.numbers.tolist() == [2, 5, 7]
    assert "1 of 6 lines have no pose, and are left out" in found.lines
    assert "2 lines have the time of the one before, and are left out" in found.lines
    assert "warning: 1 of those has another pose than the line before" in found.lines


def test_quaternions_are_made_of_unit_length(tmp_path: Path) -> None:
    found = read(table(tmp_path, HEADER, "0,0.1,0,0,0,0,3,4", "0.01,0.102,0,0,0,0,0.6,0.8"))
    np.testing.assert_allclose(found.quaternion, [[0, 0, 0.6, 0.8]] * 2)
    assert any("1 of 2 quaternions are not of unit length" in line for line in found.lines)


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ([], "line 1 must be 'time_s,x_m"),
        ([HEADER], "has 0 poses; a motion needs two"),
        ([HEADER, ROWS[0]], "has 1 pose; a motion needs two"),
        (["time_s,x_m,y_m,z_m", "0,0,0,0"], "has no column for 'qx'"),
        (["0,1,2", "1,2,3"], "line 1 must be"),
        ([HEADER, *ROWS, "0.03,0.1,0.2"], "line 5 has 3 values; expected 8"),
        ([HEADER, *ROWS, "0.03,0.1,0.2,O.3,0,0,0,1"], "line 5: 'z' must be a number, not 'O.3'"),
        ([HEADER, ROWS[0], ROWS[2], ROWS[1]], "line 4: time goes backwards, by 0.01"),
        ([HEADER, ROWS[0], "nan,0,0,0,0,0,0,1"], "line 3: its time is not a finite number"),
        ([HEADER, ROWS[0], "0.01,inf,0,0,0,0,0,1"], "line 3: its pose is not finite"),
        ([HEADER, ROWS[0], "0.01,0.1,0,0,0,0,0,0"], "line 3: its quaternion is zero"),
        (["time,x,x_m,y,z,qx,qy,qz,qw", "0"], "has 'x' and 'x_m' for 'x'"),
        (["time,x_mm,y_m,z_m,qx,qy,qz,qw", "0"], "must be in one unit"),
        (["x" * 200_000], "line 1 is longer than 100,000 characters; is it a table?"),
        (["time\0"], "line 1 holds zero bytes"),
    ],
)
def test_what_is_no_motion_is_one_line(lines: list[str], said: str, tmp_path: Path) -> None:
    path = tmp_path / "path.csv"
    path.write_text("\n".join(lines))
    assert said in refused(path)


def test_binary_and_missing_files_are_one_line(tmp_path: Path) -> None:
    path = tmp_path / "path.csv"
    assert "cannot be read (No such file" in refused(path)
    path.write_bytes(b"\xff\xfe\xfa" + bytes(range(256)))
    refused(path)
    path.write_bytes(b"time,x\xff\n")
    assert "cannot be read as text" in refused(path)


def test_a_file_of_any_size_takes_bounded_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows are counted as they come; no more are held than the limit."""
    monkeypatch.setattr(poses_module, "MOST_ROWS", 100)
    path = table(tmp_path, HEADER, *(f"{k},0,0,0,0,0,0,1" for k in range(200)))
    assert count_rows(path) == 200
    assert "has more than 100 lines; cut it into pieces" in refused(path)


def turning(times_s: FloatArray, spin: FloatArray, velocity: FloatArray) -> FloatArray:
    """Poses of what turns and moves evenly."""
    rotation = Rotation.from_rotvec(times_s[:, None] * spin).as_matrix()
    return rigid_transform(rotation, times_s[:, None] * velocity)


def recorded(times_s: FloatArray, poses: FloatArray, sign: FloatArray | None = None) -> RecordedPoses:
    quaternion = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    if sign is not None:
        quaternion = quaternion * sign[:, None]
    rows = np.arange(len(times_s))
    return RecordedPoses("path.csv", "line", rows, times_s - times_s[0], poses[:, :3, 3], quaternion, ())


vectors = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)


@given(
    st.lists(st.floats(0.001, 0.05), min_size=3, max_size=40),
    vectors,
    vectors,
    st.floats(0.002, 0.03),
    st.integers(0, 2**32 - 1),
)
def test_what_turns_and_moves_evenly_stays_exact(
    steps: list[float], spin: FloatArray, velocity: FloatArray, dt_s: float, seed: int
) -> None:
    """Whenever its poses were taken, and whichever of the two quaternions of a rotation stands in each row."""
    times = np.cumsum(steps)
    times = times - times[0]
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], len(times))
    if times[-1] < dt_s:
        return
    even, lines = resample(recorded(times, turning(times, spin, velocity), signs), dt_s, 1.0)
    wanted = turning(np.minimum(dt_s * np.arange(len(even)), times[-1]), spin, velocity)
    assert not lines
    np.testing.assert_allclose(even[:, :3, 3], wanted[:, :3, 3], atol=1e-12)
    off = rotation_angle(np.swapaxes(even[:, :3, :3], 1, 2) @ wanted[:, :3, :3])
    assert off.max() < 1e-9


@given(st.lists(st.floats(0.001, 0.3), min_size=2, max_size=60), st.floats(0.02, 0.2), st.floats(0.002, 0.03))
def test_nothing_is_invented_in_gaps(steps: list[float], gap_s: float, dt_s: float) -> None:
    """A sample is there exactly where the rows around it are no farther apart than told, or where it is one of them."""
    times = np.concatenate([[0.0], np.cumsum(steps)])
    if times[-1] < dt_s:
        return
    even, lines = resample(recorded(times, turning(times, np.zeros(3), np.ones(3))), dt_s, gap_s)
    wanted = dt_s * np.arange(len(even))
    missing = np.asarray(np.isnan(even).any(axis=(1, 2)))
    for time, lacks in zip(wanted, missing, strict=True):
        after = min(int(np.searchsorted(times, time)), len(times) - 1)
        distance = np.abs(times - time).min()
        if distance > 1e-5 and abs(times[after] - times[after - 1] - gap_s) > 1e-6:
            assert lacks == (times[after] - times[after - 1] > gap_s)
    assert bool(lines) == bool((np.diff(times) > gap_s + 1e-6 * dt_s).any())


def test_samples_at_rows_are_rows() -> None:
    times: FloatArray = 0.0126 * np.arange(50, dtype=np.float64)
    poses = turning(times, np.array([1.0, 2.0, -0.5]), np.array([0.01, 0.0, 0.02]))
    even, _ = resample(recorded(times, poses), 0.0126, 0.1)
    np.testing.assert_allclose(even, poses, atol=1e-12)


def test_the_longest_gap_hangs_on_how_often_there_is_a_pose() -> None:
    poses = turning(np.linspace(0, 0.9, 10), np.zeros(3), np.ones(3))
    assert usual_gap_s(recorded(np.linspace(0, 0.009, 10), poses)) == 0.1
    assert usual_gap_s(recorded(np.linspace(0, 0.9, 10), poses)) == pytest.approx(0.5)


def test_a_stray_time_does_not_fill_the_memory() -> None:
    times = np.array([0.0, 0.01, 0.02, 1.7e9])
    with pytest.raises(SurgbenchError, match=r"a trial has 2 to 1,000,000 \(.* is 1.7e\+09 s, after line 2"):
        resample(recorded(times, turning(times, np.zeros(3), np.zeros(3))), 0.0126, 0.1)
