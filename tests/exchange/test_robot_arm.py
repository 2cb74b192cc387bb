"""All joints of a robot's arm in a recording: which arm they are of is told, and kept in the dataset."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from commandline import surgbench

from surgbench.dataset.open import open_as
from surgbench.instrument.arms import load_arm
from surgbench.tasks.instrument.aligned import write_aligned
from surgbench.tasks.instrument.dataset import InstrumentDataset

CAMERA = {"width": 64, "height": 48, "fx": 80.0, "fy": 80.0, "cx": 31.5, "cy": 23.5}
FRAMES = 4
JOINTS = np.array([0.1, -0.2, 0.12, 0.4, 0.3, -0.1]) + 0.01 * np.arange(FRAMES)[:, None]


@pytest.fixture
def source(tmp_path: Path) -> Path:
    root = tmp_path / "recording"
    (root / "masks").mkdir(parents=True)
    for frame in range(FRAMES):
        mask = np.zeros((48, 64), np.uint8)
        mask[8:16, : 24 + frame] = 255
        (root / "masks" / f"{frame:06d}.png").write_bytes(cv2.imencode(".png", mask)[1].tobytes())
    (root / "camera.json").write_text(json.dumps(CAMERA))
    rows = [",".join(map(str, [frame, *joints, 0.4])) for frame, joints in enumerate(JOINTS.tolist())]
    (root / "joints.csv").write_text("\n".join(["frame,q1,q2,q3,q4,q5,q6,jaw", *rows]))
    return root


def imported(source: Path, *options: object) -> InstrumentDataset:
    surgbench("import", "masks", source, "--joints-arm", *options, "--out", source.with_name("data"))
    return open_as(InstrumentDataset, source.with_name("data"))


@pytest.mark.slow
def test_readings_put_the_wrist_where_the_arm_has_it(source: Path) -> None:
    (sequence,) = imported(source).sequences
    np.testing.assert_array_equal(sequence.arm_joints("left"), JOINTS)
    np.testing.assert_array_equal(sequence.arm_poses("left"), load_arm("classic_400006").forward(JOINTS))
    assert sequence.kinematics("left") is None  # where the arm's base is, nobody knows


@pytest.mark.slow
def test_an_arm_of_ones_own_is_kept_in_the_dataset(source: Path) -> None:
    mine = source / "mine.yaml"
    mine.write_text(json.dumps(load_arm("classic_420006").model_dump(mode="json")))  # which is YAML, too
    (sequence,) = imported(source, "--robot-arm", mine).sequences
    mine.unlink()
    poses = sequence.arm_poses("left")
    assert poses is not None
    np.testing.assert_array_equal(poses, load_arm("classic_420006").forward(JOINTS))
    assert not np.allclose(poses, load_arm("classic_400006").forward(JOINTS))


def test_an_unknown_arm_is_one_line(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = source.with_name("data")
    surgbench("import", "masks", source, "--joints-arm", "--robot-arm", "classic_40006", "--out", out, expect=2)
    assert "classic_400006" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.slow
@pytest.mark.parametrize("missing", [(), (1,)], ids=["even", "a frame is missing"])
def test_late_readings_are_moved_with_all_six_joints(source: Path, missing: tuple[int, ...]) -> None:
    """What was read a thirtieth of a second later belongs here: every joint, and what trackers are given of them."""
    for frame in missing:
        (source / "masks" / f"{frame:06d}.png").unlink()
    dataset = imported(source)
    (before,) = dataset.sequences
    write_aligned(dataset, {("000", "left"): 1 / 30 / before.dt_s}, source.with_name("aligned"))
    (sequence,) = open_as(InstrumentDataset, source.with_name("aligned")).sequences
    six, three, given = sequence.arm_joints("left"), sequence.readings("left"), before.readings("left")
    assert six is not None
    assert three is not None
    assert given is not None
    frames = [frame for frame in range(FRAMES) if frame not in missing]
    late = np.array(frames) + 1
    inside = late < FRAMES
    np.testing.assert_allclose(six[inside], JOINTS[0] + 0.01 * late[inside, None], atol=1e-12)
    np.testing.assert_array_equal(three[inside, :2], six[inside, 4:])
    np.testing.assert_allclose(three[inside, 2], given[0, 2], atol=1e-12)
    assert np.isnan(six[~inside]).all()
    assert np.isnan(three[~inside]).all()
