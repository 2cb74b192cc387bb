"""``joints.csv``: unit and jaw as the columns are called, as is told, or doubted over the whole recording."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from commandline import surgbench
from hypothesis import given, settings
from hypothesis import strategies as st

from surgbench.dataset.open import open_as
from surgbench.dataset.validate import validate
from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument, load_instrument
from surgbench.recordings.arm_columns import Whose
from surgbench.recordings.names import number_files
from surgbench.recordings.readings import Readings, read_joints
from surgbench.tasks.instrument.dataset import InstrumentDataset

# Of a Large Needle Driver: wrist pitch, wrist yaw, half the opening, which is 0.698 rad at most.
TRUE = np.array([[0.78, -0.94, 0.27], [0.75, -0.9, 0.31], [0.7, -0.88, 0.42]])
ARM = np.array([[0.1, 0.2, 0.12, 1.0], [0.11, 0.2, 0.125, 1.1], [0.12, 0.21, 0.13, 1.2]])
DVRK = "outer_yaw,outer_pitch,outer_insertion,outer_roll,outer_wrist_pitch,outer_wrist_yaw,jaw"


@pytest.fixture(scope="module")
def driver() -> Instrument:
    return load_instrument("large_needle_driver")


def table(path: Path, header: str, values: FloatArray, delimiter: str = ",") -> Path:
    rows = [[str(frame), *map(repr, map(float, row))] for frame, row in enumerate(values)]
    path.write_text("\n".join([delimiter.join(["frame", *header.split(",")]), *map(delimiter.join, rows)]) + "\n")
    return path


def read(path: Path, driver: Instrument, **told: object) -> Readings:
    found = read_joints(path, range(len(TRUE)), driver, **told)  # type: ignore[arg-type]
    assert found is not None
    return found


def assert_close(found: FloatArray | None, expected: object, atol: float = 1e-15) -> None:
    assert found is not None
    np.testing.assert_allclose(found, np.asarray(expected), atol=atol)


def assert_same(found: FloatArray | None, expected: FloatArray) -> None:
    assert_close(found, expected, atol=0.0)


def six_and_jaw(whole: bool = True) -> FloatArray:
    """As the dVRK reports them: the arm's six joints, and the jaw."""
    return np.column_stack([ARM, TRUE[:, :2], TRUE[:, 2] * (2 if whole else 1)])


def test_our_own_columns_are_radians_and_half_the_opening(tmp_path: Path, driver: Instrument) -> None:
    found = read(table(tmp_path / "joints.csv", "q1,q2,q3", TRUE), driver)
    assert_same(found.joints, TRUE)
    assert found.arm is None
    assert "3 readings, rad; 'q3' is each jaw's angle from the midline (--jaw full if not)" in found.note
    assert "q1 0.7 to 0.78" in found.note


@pytest.mark.parametrize(
    "header",
    [
        DVRK,
        "q1,q2,q3,q4,q5,q6,jaw",
        "measured_q1,measured_q2,measured_q3,measured_q4,measured_q5,measured_q6,measured_jaw",
        "yaw,pitch,insertion,roll,wrist_pitch,wrist_yaw,jaw",
        "PSM1 Yaw, Pitch ,Insertion [m],Roll,Wrist Pitch,WRIST-YAW,Jaw",
    ],
)
def test_the_dvrks_names_are_known_and_its_jaw_is_the_whole_angle(
    tmp_path: Path, driver: Instrument, header: str
) -> None:
    path = table(tmp_path / "joints.csv", header, six_and_jaw())
    found = read(path, driver)
    assert_close(found.joints, TRUE, atol=1e-15)
    assert found.arm is None
    assert "--joints-arm keeps them" in found.note
    found = read(path, driver, arm=True)
    assert_close(found.arm, np.column_stack([ARM, TRUE[:, :2]]), atol=1e-15)


def test_six_joints_without_a_jaw_are_the_arms_and_no_readings(tmp_path: Path, driver: Instrument) -> None:
    path = table(tmp_path / "joints.csv", DVRK.removesuffix(",jaw"), six_and_jaw()[:, :6])
    found = read(path, driver, arm=True)
    assert found.joints is None
    assert_same(found.arm, six_and_jaw()[:, :6])
    with pytest.raises(DatasetError, match="no column 'q3' or 'jaw'"):
        read(path, driver)


@given(
    unit=st.sampled_from(["rad", "deg"]),
    whole=st.booleans(),
    named=st.booleans(),
    arm=st.booleans(),
    joints=st.lists(
        st.tuples(st.floats(-1.39, 1.39), st.floats(-1.39, 1.39), st.floats(-0.1, 0.69)), min_size=3, max_size=3
    ),
)
@settings(max_examples=60, deadline=None)
def test_what_is_told_or_named_comes_out_as_it_was(
    tmp_path_factory: pytest.TempPathFactory,
    driver: Instrument,
    unit: str,
    whole: bool,
    named: bool,
    arm: bool,
    joints: list[tuple[float, float, float]],
) -> None:
    """Whatever the coding: written in it and read back as told, or as the columns' names say."""
    true = np.array(joints)
    angles = np.column_stack([ARM[:, [0, 1, 3]], true * [1, 1, 2 if whole else 1]])
    angles = np.rad2deg(angles) if unit == "deg" else angles
    written = np.column_stack([angles[:, :2], ARM[:, 2], angles[:, 2:]]) if arm else angles[:, 3:]
    suffix = f"_{unit}" if named else ""
    names = ["outer_wrist_pitch", "outer_wrist_yaw", "jaw" if whole else "half_jaw"]
    names = [name + suffix for name in names]
    if arm:
        names = [f"outer_yaw{suffix}", f"outer_pitch{suffix}", "outer_insertion_m", f"outer_roll{suffix}", *names]
    path = table(tmp_path_factory.mktemp("told") / "joints.csv", ",".join(names), written)
    found = read(path, driver, unit=None if named else unit, jaw="full" if whole else "half", arm=arm)
    assert_close(found.joints, true, atol=1e-12)
    if arm:
        assert_close(found.arm, np.column_stack([ARM, true[:, :2]]), atol=1e-12)


@given(
    joints=st.lists(
        st.tuples(st.floats(-1.39, 1.39), st.floats(-1.39, 1.39), st.floats(0, 0.69)), min_size=3, max_size=3
    ).filter(lambda rows: np.abs(rows).max() > 0.2)
)
@settings(max_examples=40, deadline=None)
def test_degrees_are_never_taken_for_radians(
    tmp_path_factory: pytest.TempPathFactory, driver: Instrument, joints: list[tuple[float, float, float]]
) -> None:
    """One frame that shows it is enough for the whole recording."""
    path = table(tmp_path_factory.mktemp("deg") / "joints.csv", "q1,q2,q3", np.rad2deg(joints))
    with pytest.raises(DatasetError, match=r"far outside .* if the file is in degrees: --joints-unit deg$"):
        read(path, driver)
    assert_close(read(path, driver, unit="deg").joints, joints, atol=1e-12)


def test_jaws_that_open_further_than_the_instruments_are_asked_about(tmp_path: Path, driver: Instrument) -> None:
    path = table(tmp_path / "joints.csv", "q1,q2,q3", TRUE * [1, 1, 2])
    with pytest.raises(DatasetError, match=r"reach 0.84 rad from the midline, .* open to 0.698; .*: --jaw full, else"):
        read(path, driver)
    assert_close(read(path, driver, jaw="full").joints, TRUE)
    assert read(path, driver, jaw="half").joints is not None


def test_both_at_once_are_told_at_once(tmp_path: Path, driver: Instrument) -> None:
    path = table(tmp_path / "joints.csv", "q1,q2,q3", np.rad2deg(TRUE * [1, 1, 2]))
    with pytest.raises(DatasetError, match=r"--joints-unit deg --jaw full$"):
        read(path, driver)
    assert_close(read(path, driver, unit="deg", jaw="full").joints, TRUE)


def test_what_fits_nothing_is_named_by_its_frame(tmp_path: Path, driver: Instrument) -> None:
    spoilt = TRUE.copy()
    spoilt[1, 1] = -999.0
    path = table(tmp_path / "joints.csv", "q1,q2,q3", spoilt)
    with pytest.raises(DatasetError, match=r"frame 1: q2 is -999 rad, .* as in 1 of 3 frames; mend the file"):
        read(path, driver)
    with pytest.raises(DatasetError, match=r"\(read with --joints-unit rad\); mend the file"):
        read(path, driver, unit="rad")


@pytest.mark.parametrize(
    ("header", "told", "says"),
    [
        ("q1_deg,q2_deg,q3_deg", {"unit": "rad"}, "'q1_deg' says deg, but --joints-unit says rad"),
        ("q1,q2,jaw", {}, "has q1, q2"),
        ("wrist_pitch,q2,q4", {}, "line 1 must be 'frame,q1,q2,q3'"),
        ("wrist_pitch,wrist_pitch,jaw", {}, "'wrist_pitch' and 'wrist_pitch' are the same joint"),
        ("time,speed,force", {}, "it has no joint"),
        ("q1,q2,q3", {"arm": True}, "--joints-arm needs all six joints of the arm; there is no 'yaw'"),
    ],
)
def test_columns_that_cannot_be_told_are_refused(
    tmp_path: Path, driver: Instrument, header: str, told: dict[str, object], says: str
) -> None:
    with pytest.raises(DatasetError) as caught:
        read(table(tmp_path / "joints.csv", header, TRUE), driver, **told)
    assert says in str(caught.value)


def test_an_insertion_in_millimetres_says_so_or_is_refused(tmp_path: Path, driver: Instrument) -> None:
    millimetres = six_and_jaw() * [1, 1, 1000, 1, 1, 1, 1]
    with pytest.raises(DatasetError, match=r"reaches 130 m, .*call the column 'outer_insertion_mm'"):
        read(table(tmp_path / "joints.csv", DVRK, millimetres), driver, arm=True)
    named = DVRK.replace("insertion", "insertion_mm")
    found = read(table(tmp_path / "joints.csv", named, millimetres), driver, arm=True)
    assert found.arm is not None
    assert_close(found.arm[:, 2], ARM[:, 2])


@pytest.mark.parametrize(
    "text",
    [
        "\ufefffra,q1,q2,q3\n".replace("fra", "frame") + "0,0.1,0.2,0.3\n1,0.1,0.2,0.3\n2,0.1,0.2,0.3\n",
        " Frame ; Q1 (rad) ;q2 [RAD];Q3\n0;0,1;0,2;0,3\n1;0,1;0,2;0,3\n2;0,1;0,2;0,3\n",
        "sep=;\nframe;q1;q2;q3\n0;0.1;0.2;0.3\n1;0.1;0.2;0.3\n2;0.1;0.2;0.3\n",
        "# frame\tq3\tq2\tq1\n0\t0.3\t0.2\t0.1\n\n1.0\t0.3\t0.2\t0.1\n000002\t0.3\t0.2\t0.1\n",
        '"frame","note","q1","q2","q3"\n0,"a, b",0.1,0.2,0.3\n1,,0.1,0.2,0.3\n2,,0.1,0.2,0.3\n',
    ],
    ids=["mark", "semicolons", "spreadsheet", "tabs", "quoted"],
)
def test_tables_as_people_write_them(tmp_path: Path, driver: Instrument, text: str) -> None:
    for encoding in ("utf-8", "utf-16"):
        path = tmp_path / "joints.csv"
        path.write_bytes(text.removeprefix("\ufeff" if encoding == "utf-16" else "").encode(encoding))
        assert_close(read(path, driver).joints, np.tile([0.1, 0.2, 0.3], (3, 1)))


def test_rows_between_masks_are_left_out(tmp_path: Path, driver: Instrument) -> None:
    """Readings of every frame beside masks of every other."""
    path = table(tmp_path / "joints.csv", "q1,q2,q3", TRUE)
    found = read_joints(path, [0, 2], driver)
    assert found is not None
    assert_same(found.joints, TRUE[[0, 2]])
    with pytest.raises(DatasetError, match="line 4: there is no mask of frame 2"):
        read_joints(path, [0, 1], driver)


def test_frames_without_a_reading_have_rows_without_numbers(tmp_path: Path, driver: Instrument) -> None:
    path = tmp_path / "joints.csv"
    path.write_text("frame,q1,q2,q3\n0,0.1,0.2,0.3\n1,,,\n2,nan,NaN,\n")
    found = read(path, driver)
    assert_close(found.joints, [[0.1, 0.2, 0.3], [np.nan] * 3, [np.nan] * 3])
    assert "1 readings, rad; 2 frames without one" in found.note
    for rows, says in [
        ("0,0.1,0.2,0.3\n1,,0.2,0.3\n2,,,\n", "line 3: 'q1' must be a finite number"),
        ("0,,,\n1,,,\n2,,,\n", "holds no reading of any frame"),
        ("0,0.1,0.2,0.3\n2,,,\n", "frame 1 is missing; every mask needs a row, with empty cells where nothing"),
        ("0,46,0.2,0.3\n1,,,\n2,,,\n", "--joints-unit deg"),
        ("0,0.1,0.2,0.9\n1,,,\n2,,,\n", "--jaw full"),
    ]:
        path.write_text("frame,q1,q2,q3\n" + rows)
        with pytest.raises(DatasetError) as caught:
            read(path, driver)
        assert says in str(caught.value)


def test_columns_may_name_the_only_arm(tmp_path: Path, driver: Instrument) -> None:
    path = table(tmp_path / "joints.csv", "right_q1,right_q2,right_q3", TRUE)
    assert_same(read(path, driver, whose=Whose("right")).joints, TRUE)
    with pytest.raises(
        DatasetError, match=r"columns of the right arm, and the masks are of the left one; .* --arms right"
    ):
        read(path, driver, whose=Whose("left"))


def test_frames_are_called_as_the_masks_are(tmp_path: Path, driver: Instrument) -> None:
    """Names that are times in seconds, of which a table has the same numbers."""
    (tmp_path / "masks").mkdir()
    stamps = [f"1403636579.{763 + 40 * frame:03d}" for frame in range(len(TRUE))]
    numbers = list(number_files(tmp_path / f"masks/{stamp}.png" for stamp in stamps))
    rows = [",".join([stamp, *map(repr, map(float, row))]) for stamp, row in zip(stamps, TRUE, strict=True)]
    (tmp_path / "joints.csv").write_text("\n".join(["frame,q1,q2,q3", *rows]))
    found = read_joints(tmp_path / "joints.csv", numbers, driver)
    assert found is not None
    assert_same(found.joints, TRUE)


# --- as a user types it


@pytest.fixture
def source(tmp_path: Path) -> Path:
    root = tmp_path / "recording"
    (root / "masks").mkdir(parents=True)
    for frame in range(len(TRUE)):
        mask = np.zeros((30, 40), np.uint8)
        mask[10:16, : 20 + frame] = 255
        (root / "masks" / f"{frame:06d}.png").write_bytes(cv2.imencode(".png", mask)[1].tobytes())
    camera = {"width": 40, "height": 30, "fx": 60.0, "fy": 61.0, "cx": 19.0, "cy": 14.5}
    (root / "camera.json").write_text(json.dumps(camera))
    return root


def test_all_six_joints_are_kept_when_asked_for(
    source: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    table(source / "joints.csv", DVRK, six_and_jaw())
    surgbench("import", "masks", source, "--out", tmp_path / "arm", "--joints-arm")
    assert "all six joints of the arm are kept" in capfd.readouterr().err
    assert validate(tmp_path / "arm") == []
    sequence = open_as(InstrumentDataset, tmp_path / "arm").sequences[0]
    assert_close(sequence.arm_joints("left"), np.column_stack([ARM, TRUE[:, :2]]))
    assert_close(sequence.readings("left"), TRUE)
    assert sequence.kinematics("left") is None
    surgbench("import", "masks", source, "--out", tmp_path / "plain")
    plain = open_as(InstrumentDataset, tmp_path / "plain")
    assert plain.sequences[0].arm_joints("left") is None
    assert b"arm_joints" not in (tmp_path / "plain" / "dataset.json").read_bytes()


def test_frames_without_a_reading_stay_so(source: Path, tmp_path: Path) -> None:
    (source / "joints.csv").write_text("frame,q1 (°),q2 (°),q3 (°)\n0,,,\n1,10,20,30\n2,10,20,30\n")
    surgbench("import", "masks", source, "--jaw", "half", "--out", tmp_path / "out")
    assert validate(tmp_path / "out") == []
    sequence = open_as(InstrumentDataset, tmp_path / "out").sequences[0]
    assert_close(sequence.readings("left"), [[np.nan] * 3, *[np.deg2rad([10, 20, 30])] * 2])


def test_degrees_are_one_line_with_the_option_that_makes_them_right(
    source: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    table(source / "joints.csv", "q1,q2,q3", np.rad2deg(TRUE))
    surgbench("import", "masks", source, "--out", tmp_path / "out", expect=2)
    line = capfd.readouterr().err.strip()
    assert "--joints-unit deg" in line
    assert len(line.splitlines()) == 1
    assert not (tmp_path / "out").exists()
    surgbench("import", "masks", source, "--out", tmp_path / "out", "--joints-unit", "deg")
    dataset = open_as(InstrumentDataset, tmp_path / "out")
    assert_close(dataset.sequences[0].readings("left"), TRUE)
    assert dataset.manifest.configuration["joints_unit"] == "deg"
