from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from surgbench.camera import Camera
from surgbench.dataset import tables
from surgbench.dataset.masks import decode_mask, encode_mask, read_mask
from surgbench.dataset.open import open_as
from surgbench.dataset.validate import validate
from surgbench.errors import DatasetError
from surgbench.generators.generate import generate, plan_dataset
from surgbench.generators.presets import Preset
from surgbench.geometry import is_rigid, look_at_rotation, rotation_angle
from surgbench.state import ANGLES, POSITION
from surgbench.tasks.instrument.asked import Readings
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.format import InstrumentManifest, SequenceEntry
from surgbench.tasks.instrument.units import UnitData

CAMERA = Camera(width=90, height=62, fx=113.0, fy=112.0, cx=36.3, cy=29.4)
MASK = "sequences/000/observed/left/000001.png"
OBSERVATIONS = "sequences/000/observations.parquet"
STATES = "truth/000/states.parquet"


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dataset") / "tiny"
    generate(plan_dataset(Preset(name="tiny", pairs=1, frames=4, camera=CAMERA)), out)
    return out


@pytest.fixture
def root(original: Path, tmp_path: Path) -> Path:
    """A copy to be damaged."""
    return shutil.copytree(original, tmp_path / "tiny")


def rehash(root: Path, path: str, data: bytes) -> None:
    """Write a file and make the manifest agree with it, as somebody who edits a dataset would."""
    (root / path).write_bytes(data)
    manifest = json.loads((root / "dataset.json").read_text())
    manifest["files"][path] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    (root / "dataset.json").write_text(json.dumps(manifest))


def edit_table(root: Path, path: str, change: Callable[[dict[str, Any]], None]) -> None:
    import pyarrow.parquet as parquet

    table = parquet.read_table(root / path)
    columns = {name: table.column(name).to_numpy().copy() for name in table.column_names if name != "frame"}
    change(columns)
    rehash(root, path, tables.encode_table(columns))


# Reading


def test_reader(original: Path) -> None:
    dataset = open_as(InstrumentDataset, original)
    assert dataset.hash == hashlib.sha256((original / "dataset.json").read_bytes()).hexdigest()
    assert dataset.name == "tiny"
    sequence = dataset.sequence("000")
    assert (sequence.frames, sequence.arms, sequence.speed) == (4, ("left", "right"), "nominal")
    assert sequence.camera == CAMERA
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(4) / 30)
    assert sequence.mask("both", 3).shape == (62, 90)
    assert sequence.mask("both", 3).dtype == np.bool_
    assert sequence.clean_mask("left", 0).any()
    assert sequence.image(0) is None
    assert sequence.keypoints("left").shape == (4, 2, 2)
    readings, states = sequence.readings("right"), sequence.states("right")
    assert readings is not None
    assert states is not None
    assert readings.shape == (4, 3)
    assert states.shape == (4, 9)
    assert dataset.instrument("large_needle_driver").name == "large_needle_driver"


def test_kinematics(original: Path) -> None:
    sequence = open_as(InstrumentDataset, original).sequence("000")
    poses, states = sequence.kinematics("right"), sequence.states("right")
    assert poses is not None
    assert states is not None
    assert poses.shape == (4, 4, 4)
    assert all(is_rigid(pose) for pose in poses)
    # No robot: its base is the camera, nominally.
    np.testing.assert_array_equal(sequence.T_cam_base("right"), np.eye(4))
    assert 0 < np.linalg.norm(poses[:, :3, 3] - states[:, POSITION], axis=1).max() < 0.03
    assert rotation_angle(np.swapaxes(poses[:, :3, :3], 1, 2) @ look_at_rotation(states[:, ANGLES])).max() < 0.15


def test_a_dataset_from_before_there_were_kinematics_is_read(root: Path) -> None:
    def forget(columns: dict[str, Any]) -> None:
        for name in [name for name in columns if "_base_" in name]:
            del columns[name]

    edit_table(root, OBSERVATIONS, forget)
    manifest = json.loads((root / "dataset.json").read_text())
    del manifest["sequences"][0]["T_cam_base"]
    (root / "dataset.json").write_text(json.dumps(manifest))
    assert validate(root) == []
    dataset = open_as(InstrumentDataset, root)
    sequence = dataset.sequence("000")
    assert sequence.kinematics("left") is None
    assert sequence.T_cam_base("left") is None
    data = UnitData(dataset, dataset.units("dual")[0], "noisy")
    assert data.scene().T_cam_base is None
    assert data.observation(0).kinematics is None


@pytest.mark.parametrize("readings", ["noisy", "true"])
def test_kinematics_come_with_readings(root: Path, readings: Readings) -> None:
    def lose(columns: dict[str, Any]) -> None:
        for name in columns:
            if name.startswith("left_base_"):
                columns[name][1] = np.nan

    edit_table(root, OBSERVATIONS, lose)
    dataset = open_as(InstrumentDataset, root)
    sequence, unit = dataset.sequence("000"), dataset.units("dual")[0]
    data = UnitData(dataset, unit, readings)
    scene, seen = data.scene(), data.observation(0).kinematics
    assert scene.T_cam_base is not None
    assert scene.T_cam_base.shape == (2, 4, 4)
    assert seen is not None
    # True joints make no better robot.
    for index, arm in enumerate(unit.arms):
        poses = sequence.kinematics(arm)
        assert poses is not None
        np.testing.assert_array_equal(seen[index], poses[0])
    assert data.observation(1).kinematics is None
    assert UnitData(dataset, unit, "none").observation(0).kinematics is None
    alone = UnitData(dataset, dataset.units("single")[1], readings).observation(1).kinematics
    assert alone is not None
    assert alone.shape == (1, 4, 4)


def test_units(original: Path) -> None:
    dataset = open_as(InstrumentDataset, original)
    assert [(u.id, u.sequence, u.arms, u.kind) for u in dataset.units("single")] == [
        ("000-left", "000", ("left",), "left"),
        ("000-right", "000", ("right",), "right"),
    ]
    assert [(u.id, u.sequence, u.arms, u.kind) for u in dataset.units("dual")] == [
        ("000", "000", ("left", "right"), "both")
    ]


def test_a_sequence_with_one_arm_keeps_its_id(original: Path) -> None:
    dataset = open_as(InstrumentDataset, original)
    (entry,) = dataset.manifest.sequences
    changes = {"arms": ("right",), "kinds": ("right",), "instruments": {"right": "large_needle_driver"}}
    alone = entry.model_copy(update=changes)
    dataset = InstrumentDataset(original, dataset.manifest.model_copy(update={"sequences": (alone,)}), "")
    assert [(unit.id, unit.arms, unit.kind) for unit in dataset.units("single")] == [("000", ("right",), "right")]
    with pytest.raises(DatasetError, match=r"no sequence has two arms in one mask \('both'\); try --arms single"):
        dataset.units("dual")


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda s: s.mask("lefty", 0), "unknown mask kind 'lefty'; did you mean 'left'?"),
        (lambda s: s.mask("left", 4), "has frames 0 to 3, not 4"),
        (lambda s: s.mask("left", -1), "has frames 0 to 3, not -1"),
        (lambda s: s.states("middle"), "unknown arm 'middle'"),
    ],
)
def test_asking_for_what_is_not_there(original: Path, ask: Callable[[Any], Any], message: str) -> None:
    with pytest.raises(DatasetError) as caught:
        ask(open_as(InstrumentDataset, original).sequence("000"))
    assert message in str(caught.value)


def test_opening_what_is_no_dataset(root: Path, tmp_path: Path) -> None:
    def refusal(path: Path) -> str:
        with pytest.raises(DatasetError) as caught:
            open_as(InstrumentDataset, path)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    assert "no such folder" in refusal(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    assert "dataset.json: missing" in refusal(tmp_path / "empty")
    manifest = root / "dataset.json"
    text = manifest.read_text()
    manifest.write_text(text[: len(text) // 2])
    assert "not valid JSON" in refusal(root)
    manifest.write_text(text.replace("surgbench-dataset-1", "surgbench-dataset-9"))
    assert "'format' is 'surgbench-dataset-9'; this version of surgbench reads 'surgbench-dataset-1'" in refusal(root)
    manifest.write_text(text.replace('"dt_s"', '"dt"'))
    assert "dataset.json: 'sequences.0.dt" in refusal(root)
    manifest.write_text(text.replace(f'"{MASK}"', '"../outside.png"'))
    assert "'../outside.png' is not a path inside the dataset" in refusal(root)
    manifest.write_text(text.replace('"camera": "endoscope"', '"camera": "other"'))
    assert "sequence '000' names the unknown camera 'other'" in refusal(root)


def test_manifest_survives_a_round_trip_and_is_sorted(original: Path) -> None:
    data = (original / "dataset.json").read_bytes()
    assert InstrumentManifest.model_validate(json.loads(data)).to_bytes() == data
    files = list(json.loads(data)["files"])
    assert files == sorted(files)


def test_sequence_entry_refuses_nonsense() -> None:
    sound: dict[str, Any] = {
        "id": "000",
        "frames": 1,
        "dt_s": 0.1,
        "camera": "c",
        "arms": ["left"],
        "instruments": {"left": "i"},
        "kinds": ["left"],
    }
    SequenceEntry.model_validate(sound)
    wrong: list[dict[str, Any]] = [
        {"arms": ["right", "left"]},
        {"instruments": {"right": "i"}},
        {"kinds": ["left", "left"]},
        {"id": "../x"},
        {"frames": 0},
        {"T_cam_base": {"right": np.eye(4).ravel().tolist()}},
        {"T_cam_base": {"left": np.eye(3).ravel().tolist()}},
        {"T_cam_base": {"left": (2 * np.eye(4)).ravel().tolist()}},
        {"T_cam_base": {"left": [float("nan")] * 16}},
    ]
    for change in wrong:
        with pytest.raises(ValueError, match=r"."):
            SequenceEntry.model_validate({**sound, **change})


# Files


def test_masks_are_one_bit_png_and_come_back(tmp_path: Path) -> None:
    mask = np.random.default_rng(0).random((31, 45)) > 0.5
    data = encode_mask(mask)
    assert data[24:26] == b"\x01\x00"  # bit depth 1, greyscale
    assert data == encode_mask(mask)
    (tmp_path / "m.png").write_bytes(data)
    assert np.array_equal(read_mask(tmp_path / "m.png", 45, 31), mask)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: b"", "m.png: empty file"),
        (lambda data: b"GIF89a" + data, "m.png: not a PNG or JPEG file"),
        (lambda data: data[:-20], "m.png: truncated or damaged PNG"),
        (lambda data: data[:60] + data[-12:], "m.png: truncated or damaged PNG"),
    ],
)
def test_damaged_masks_are_named(damage: Callable[[bytes], bytes], message: str) -> None:
    mask = np.random.default_rng(0).random((31, 45)) > 0.5
    with pytest.raises(DatasetError, match=message):
        decode_mask(damage(encode_mask(mask)), "m.png", 45, 31)


def test_a_mask_of_the_wrong_size_or_in_colour_is_named() -> None:
    data = encode_mask(np.ones((31, 45), bool))
    with pytest.raises(DatasetError, match=r"m.png: is 45x31 pixels; its camera has 46x31"):
        decode_mask(data, "m.png", 46, 31)
    colour = cv2.imencode(".png", np.zeros((31, 45, 3), np.uint8))[1].tobytes()
    with pytest.raises(DatasetError, match="has 3 channels; a mask has one"):
        decode_mask(colour, "m.png", 45, 31)


def test_tables_keep_nan_and_their_bytes() -> None:
    columns = {"a": np.array([1.0, np.nan, -3.0]), "b": np.array([0.1, 0.2, 0.3])}
    data = tables.encode_table(columns)
    assert data == tables.encode_table(columns)
    assert b"pandas" not in data
    back = tables.decode_table(data, "t", 3, ["a", "b"])
    for name, values in columns.items():
        np.testing.assert_array_equal(back[name], values)
    for wrong, message in (((4, ["a"]), "has 3 rows; expected one per frame, 4"), ((3, ["c"]), "lacks the column 'c'")):
        with pytest.raises(DatasetError, match=message):
            tables.decode_table(data, "t", *wrong)
    with pytest.raises(DatasetError, match="t: truncated or damaged Parquet file"):
        tables.decode_table(data[:-30], "t", 3, ["a"])


# Validation


def test_a_sound_dataset_has_no_problems(original: Path) -> None:
    checked: list[float] = []
    assert validate(original, checked.append) == []
    assert sum(checked) == len(open_as(InstrumentDataset, original).manifest.files)


def the_problem(root: Path) -> str:
    problems = validate(root)
    assert len(problems) == 1, problems
    assert "\n" not in problems[0]
    return problems[0]


def test_missing_truncated_altered_and_extra_files(root: Path) -> None:
    path = root / MASK
    data = path.read_bytes()
    path.unlink()
    assert the_problem(root) == f"{path}: missing"
    path.write_bytes(data[:-7])
    assert the_problem(root).startswith(f"{path}: truncated, {len(data) - 7} bytes; dataset.json says {len(data)}")
    path.write_bytes(data[:-20] + b"x" + data[-19:])
    assert the_problem(root) == f"{path}: altered, its SHA-256 is not the one in dataset.json"
    path.write_bytes(data)
    (root / "sequences/000/notes.txt").write_text("mine")
    assert the_problem(root) == f"{root}/sequences/000/notes.txt: extra, not listed in dataset.json"


def test_a_file_that_the_manifest_forgot(root: Path) -> None:
    manifest = json.loads((root / "dataset.json").read_text())
    del manifest["files"][MASK]
    (root / "dataset.json").write_text(json.dumps(manifest))
    assert any(problem.startswith(f"{root / MASK}: not listed") for problem in validate(root))


def test_a_mask_of_the_wrong_shape(root: Path) -> None:
    rehash(root, MASK, encode_mask(np.ones((62, 91), bool)))
    assert the_problem(root) == f"{root / MASK}: is 91x62 pixels; its camera has 90x62"


def test_an_altered_instrument(root: Path) -> None:
    path = "instruments/large_needle_driver/instrument.yaml"
    rehash(root, path, (root / path).read_bytes().replace(b"tips:", b"tops:"))
    assert "instrument.yaml" in the_problem(root)


@pytest.mark.parametrize(
    ("path", "column", "value", "message"),
    [
        (STATES, "left_x_m", np.nan, "frame 2: 'left_x_m' is not a finite number"),
        (STATES, "right_q1_rad", 1.5, "frame 2: 'right_q1_rad' is 1.5, outside its limits [-1.3963, 1.3963]"),
        (STATES, "left_q3_rad", -0.01, "frame 2: 'left_q3_rad' is -0.01, outside its limits [0, "),
        (STATES, "left_alpha_rad", 1.6, "frame 2: 'left_alpha_rad' is 1.6, outside its limits [-1.5708, 1.5708]"),
        (STATES, "left_beta_rad", 3.2, "frame 2: 'left_beta_rad' is 3.2, outside"),
        (STATES, "right_z_m", -0.1, "frame 2: the right arm's wrist is behind the camera"),
        (OBSERVATIONS, "timestamp_s", 0.0, "'timestamp_s' must be finite and increase"),
        (OBSERVATIONS, "timestamp_s", np.nan, "'timestamp_s' must be finite and increase"),
        (OBSERVATIONS, "left_u1_px", 4000.0, "frame 2: a keypoint of the left arm lies outside the image"),
        (OBSERVATIONS, "left_base_x_m", np.inf, "frame 2: the left arm's tool pose is not finite, or its rotation"),
        (OBSERVATIONS, "right_base_y_m", np.nan, "frame 2: the right arm's tool pose is not finite, or its rotation"),
        (OBSERVATIONS, "right_base_rz_rad", 3.5, "or its rotation vector is longer than pi"),
        (OBSERVATIONS, "left_q2_rad", 7.0, "frame 2: a joint reading of the left arm is outside [-pi, pi]"),
    ],
)
def test_wrong_numbers(root: Path, path: str, column: str, value: float, message: str) -> None:
    def change(columns: dict[str, Any]) -> None:
        for name in (column, column.replace("u1", "v1")):
            if np.isnan(columns[name][2]):
                columns[name][2] = 1.0
        columns[column][2] = value

    edit_table(root, path, change)
    problem = the_problem(root)
    assert problem.startswith(f"{root / path}: ")
    assert message in problem


def test_half_a_keypoint(root: Path) -> None:
    def change(columns: dict[str, Any]) -> None:
        columns["right_u2_px"][1], columns["right_v2_px"][1] = 5.0, np.nan

    edit_table(root, OBSERVATIONS, change)
    assert "frame 1: a keypoint of the right arm has one coordinate without the other" in the_problem(root)


def test_missing_keypoints_and_readings_are_no_problem(root: Path) -> None:
    def change(columns: dict[str, Any]) -> None:
        for name in columns:
            if name in ("left_u1_px", "left_v1_px", "left_q1_rad") or name.startswith("right_base_"):
                columns[name][0] = np.nan

    edit_table(root, OBSERVATIONS, change)
    assert validate(root) == []


@pytest.mark.parametrize("column", ["left_q1_rad", "right_v2_px", "timestamp_s", "left_base_z_m"])
def test_a_missing_column(root: Path, column: str) -> None:
    edit_table(root, OBSERVATIONS, lambda columns: columns.pop(column))
    assert f"lacks the column '{column}'" in the_problem(root)


def test_a_table_with_a_frame_too_few(root: Path) -> None:
    def change(columns: dict[str, Any]) -> None:
        for name in columns:
            columns[name] = columns[name][:-1]

    edit_table(root, STATES, change)
    assert the_problem(root) == f"{root / STATES}: has 3 rows; expected one per frame, 4"


def test_no_dataset_is_one_problem(tmp_path: Path) -> None:
    assert "no such folder" in the_problem(tmp_path / "none")
