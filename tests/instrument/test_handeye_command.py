"""Recordings without truth judged by the readings of their arm: the command, the columns, the readings set right."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
from commandline import AMPLE_S, records, surgbench
from fabricate import record, write

from surgbench.camera import Camera
from surgbench.dataset import tables
from surgbench.dataset.manifest import MANIFEST_NAME, observations_path
from surgbench.dataset.masks import encode_mask
from surgbench.dataset.open import open_as
from surgbench.dataset.storage import file_entry
from surgbench.dataset.writer import write_files
from surgbench.geometry import (
    FloatArray,
    inverse_transform,
    look_at_angles,
    rigid_transform,
    rotation_from_vector,
    rotation_vector,
)
from surgbench.instrument import load_instrument, save_instrument
from surgbench.instrument.arm import CLASSIC_400006
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.format import Arm, InstrumentManifest, SequenceEntry, observed_path
from surgbench.tasks.instrument.judge import judged_columns
from surgbench.tasks.instrument.records import JUDGED
from surgbench.tasks.instrument.tables import KINEMATICS_COLUMNS, READING_COLUMNS, arm_columns

FRAMES, DT_S, LAG = 150, 1 / 30, 4
ARM: Arm = "left"
CAMERA = Camera(width=16, height=12, fx=20.0, fy=20.0, cx=8.0, cy=6.0)
T_CAM_BASE = rigid_transform(rotation_from_vector(np.array([2.9, 0.3, 0.2])), np.array([0.0, 0.02, 0.0]))
# Answers what lies beside it in a file; the other is given, and reads, where the robot says that its arm is.
TRACKERS = """
from pathlib import Path
import numpy as np

class Good:
    name = "good"

    def reset(self, scene, state, rng):
        self.states, self.rng = np.load(Path(__file__).with_name("states.npy")), rng

    def step(self, observation):
        state = self.states[observation.index].copy()
        state[3:6] += 0.0005 * self.rng.standard_normal(3)
        return state
"""
CHEAT = (
    TRACKERS.replace("Good", "Cheat").replace("good", "cheat")
    + """
    def unused(self, observation):
        return observation.kinematics
"""
)


def poses(frame: FloatArray, moves: float = 1.0) -> FloatArray:
    yaw = 0.15 * np.sin(0.091 * frame) + 0.08 * np.cos(0.153 * frame)
    pitch = 0.12 * np.cos(0.073 * frame) + 0.07 * np.sin(0.139 * frame)
    joints = [moves * yaw, moves * pitch, 0.14 + moves * 0.01 * np.sin(0.08 * frame), moves * np.sin(0.1 * frame)]
    return CLASSIC_400006.forward(np.stack(joints, axis=-1))


def make_recording(folder: Path, *, moves: float = 1.0, kinematics: bool = True) -> Path:
    """One arm, without truth; its readings are ``LAG`` frames late."""
    frame = np.arange(float(FRAMES))
    read = poses(frame - LAG, moves)
    columns = {tables.TIMESTAMP: frame * DT_S}
    joints = np.stack([0.1 * np.sin(0.1 * (frame - LAG) + place) for place in range(3)])
    columns |= dict(zip(arm_columns(ARM, READING_COLUMNS), joints, strict=True))
    if kinematics:
        pose = np.hstack([rotation_vector(read[:, :3, :3]), read[:, :3, 3]])
        columns |= dict(zip(arm_columns(ARM, KINEMATICS_COLUMNS), pose.T, strict=True))
    mask = np.zeros((CAMERA.height, CAMERA.width), dtype=bool)
    mask[4:8, 4:12] = True
    contents = {observations_path("000"): tables.encode_table(columns)}
    contents |= {observed_path("000", ARM, index): encode_mask(mask) for index in range(FRAMES)}
    instrument = load_instrument("large_needle_driver")
    written = save_instrument(instrument, folder / "instruments" / instrument.name)
    files = {path.relative_to(folder).as_posix(): file_entry(path.read_bytes()) for path in written}
    entry = SequenceEntry(
        id="000", frames=FRAMES, dt_s=DT_S, camera="camera", arms=(ARM,), instruments={ARM: instrument.name},
        kinds=(ARM,), readings=True, T_cam_base={ARM: tuple(np.eye(4).ravel())} if kinematics else {},
    )  # fmt: skip
    manifest = InstrumentManifest(
        name="theatre",
        created_by="a test",
        origin="imported",
        configuration={},
        cameras={"camera": CAMERA},
        instruments={instrument.name: f"instruments/{instrument.name}/instrument.yaml"},
        sequences=(entry,),
        files=files | write_files(folder, contents),
    )
    (folder / MANIFEST_NAME).write_bytes(manifest.to_bytes())
    seen = T_CAM_BASE @ poses(frame, moves)
    states = np.hstack([look_at_angles(seen[:, :3, :3]), seen[:, :3, 3], np.zeros((FRAMES, 3))])
    np.save(folder.with_name("states.npy"), states)
    return folder


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_recording(tmp_path_factory.mktemp("data") / "theatre")


def recorded(dataset: Path, out: Path, **noise_m: float) -> Path:
    """Records of trackers that are off by so much, as the suite writes them."""
    opened = open_as(InstrumentDataset, dataset)
    truth = np.load(dataset.with_name("states.npy"))
    for index, (name, size) in enumerate(noise_m.items()):
        rng = np.random.default_rng(index)
        states = truth.copy()
        states[:, 3:6] += size * rng.standard_normal((FRAMES, 3))
        content = record(name, "000", frames=FRAMES, truth=False, dataset=("theatre", opened.hash))
        content["spec"] |= {"arms": [ARM], "mask_kind": ARM, "tracker": {"name": name, "options": {}, "source": ""}}
        content["frames"]["state"] = content["frames"]["start"] = states.tolist()
        content["errors"]["jitter"] = [0.5]
        content["errors"] |= judged_columns(
            opened.sequences[0],
            (ARM,),
            (opened.instrument(opened.sequences[0].entry.instruments[ARM]),),
            states[:, None],
            np.ones(FRAMES, dtype=bool),
            "none",
            {},
        )
        write(out, content | {"dataset_path": str(dataset), "settings_hash": f"{index}" * 16})
    return out


@pytest.fixture(scope="module")
def runs(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(recording, tmp_path_factory.mktemp("runs"), good=0.0005, poor=0.003)


def test_the_leaderboard_has_what_the_arm_says(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("report", runs, "--format", "csv")
    good, poor = sorted(csv.DictReader(io.StringIO(capsys.readouterr().out)), key=lambda row: row["tracker"])
    assert (good["tracker"], poor["tracker"]) == ("good", "poor")
    for row, metres in ((good, 0.0005), (poor, 0.003)):
        assert float(row["lag_frames"]) == pytest.approx(LAG, abs=0.3)
        assert float(row["handeye_translation_m"]) == pytest.approx(1.538 * metres, rel=0.25)
        assert float(row["handeye_rotation_rad"]) < 0.01
        assert row["rotation_error_rad"] == ""
    surgbench("report", runs, "--format", "markdown")
    assert "hand-eye translation [mm]" in capsys.readouterr().out


def test_the_command_shows_lag_and_hand_eye(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("handeye", runs, "--format", "json", "--row", "good")
    (row,) = json.loads(capsys.readouterr().out)
    assert row["lag_low_frames"] < row["lag_frames"] < row["lag_high_frames"]
    assert row["lag_s"] == pytest.approx(row["lag_frames"] * DT_S)
    vector = np.array([row[f"cam_base_r{axis}_rad"] for axis in "xyz"])
    place = np.array([row[f"cam_base_{axis}_m"] for axis in "xyz"])
    change = rigid_transform(rotation_from_vector(vector), place) @ inverse_transform(T_CAM_BASE)
    assert np.linalg.norm(rotation_vector(change[:3, :3])) < 0.01
    assert row["translation_m"] < row["translation_p90_m"] < 0.003
    one = next(path for path in sorted(runs.rglob("*-r0.json")) if "good" in path.as_posix())
    surgbench("handeye", one)
    shown = capsys.readouterr().out
    assert "good" in shown
    assert "poor" not in shown
    assert "readings are late" in shown


def test_readings_are_set_right(
    recording: Path, runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "aligned"
    surgbench("handeye", runs, "--fix-lag", out)
    surgbench("validate", out)
    before, after = (open_as(InstrumentDataset, place).sequences[0] for place in (recording, out))
    poses_now, joints_now = after.kinematics(ARM), after.readings(ARM)
    assert poses_now is not None
    assert joints_now is not None
    frame = np.arange(FRAMES - LAG - 1.0)
    np.testing.assert_allclose(poses_now[: len(frame)], poses(frame), atol=0.01)
    np.testing.assert_allclose(joints_now[: len(frame), 0], 0.1 * np.sin(0.1 * frame), atol=0.003)
    assert np.isnan(poses_now[-LAG + 1 :]).all()
    assert np.isnan(joints_now[-LAG + 1 :]).all()
    np.testing.assert_array_equal(after.mask(ARM, 3), before.mask(ARM, 3))
    configuration = json.loads((out / MANIFEST_NAME).read_text())["configuration"]
    assert configuration["lag_frames_taken_out"]["000"][ARM] == pytest.approx(LAG, abs=0.3)
    capsys.readouterr()
    surgbench("handeye", runs, "--fix-lag", out, expect=2)
    assert "aligned: holds something already; --fix-lag needs a new or empty folder" in capsys.readouterr().err
    surgbench("handeye", runs, "--dataset", out, expect=2)
    assert "not the dataset of the run" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_that_was_given_the_answer_is_not_judged(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is told by the code of the tracker: one that reads no kinematics is judged with joint readings too."""
    out, path = tmp_path / "runs", recording.with_name("trackers.py")
    path.write_text(TRACKERS)
    recording.with_name("cheat.py").write_text(CHEAT)
    trackers = ("--tracker", f"{path}:Good", "--tracker", f"{recording.with_name('cheat.py')}:Cheat")
    how = ("--joints", "--initialiser", "random", "--keypoints", "none", "--timeout", AMPLE_S, "--jobs", 1)
    surgbench("run", "--dataset", recording, *trackers, *how, "--out", out)
    cheat, good = (
        next(one for one in records(out) if one["spec"]["tracker"]["name"] == name) for name in ("cheat", "good")
    )
    assert cheat["status"] == good["status"] == "ok"
    assert not set(JUDGED) & set(cheat["errors"])
    assert good["errors"]["lag_frames"][0] == pytest.approx(LAG, abs=0.3)
    surgbench("handeye", out, "--row", "cheat-joints", expect=2)
    assert (
        "was given the arm's readings (--joints) and names them in its code: it can't be judged by them"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ({"moves": 0.001}, "sequence '000', left arm: the arm moves too little to judge by: "),
        ({"kinematics": False}, "sequence '000' has no readings of the arm's pose to judge by"),
    ],
)
def test_what_cannot_judge_says_so_in_one_line(
    how: dict[str, float], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = make_recording(tmp_path / "theatre", **how)  # type: ignore[arg-type]
    out = recorded(dataset, tmp_path / "runs", good=0.0005)
    (written,) = records(out)
    assert [written["errors"].get(name) for name in JUDGED] in ([None] * 3, [[None]] * 3)
    surgbench("handeye", out, expect=2)
    said = capsys.readouterr().err.strip().splitlines()
    assert says in said[-1]
    surgbench("report", out, "--format", "csv")
    assert "handeye" not in capsys.readouterr().out


def test_a_file_that_is_no_record_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.json").write_text("{}")
    surgbench("handeye", tmp_path / "x.json", expect=2)
    assert "x.json: not a record" in capsys.readouterr().err
    surgbench("handeye", tmp_path / "nothing", expect=2)
    assert "no such folder of records" in capsys.readouterr().err
