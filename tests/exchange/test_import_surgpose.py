"""SurgPose's layout, made small: what each file says is where it belongs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from others import HEIGHT, WIDTH, bar, grey, imported, put, put_video, refused

from surgbench.exchange.lags import move_readings

FRAMES = 5
CALIBRATION = f"""\
[StereoLeft]
res_x={WIDTH}
res_y={HEIGHT}
fc_x=80.0
fc_y=81.0
cc_x=31.5
cc_y=23.5
kc_0={{k1}}
kc_1=0.0
kc_2=0.0
kc_3=0.0
kc_4=0.0
kc_5=0.0
kc_6=0.0
kc_7=0.0

[StereoRight]
res_x={WIDTH}
res_y={HEIGHT}
fc_x=90.0
fc_y=91.0
cc_x=30.5
cc_y=22.5
kc_0=0.0
kc_1=0.0
kc_2=0.0
kc_3=0.0
R_0=1.0
R_1=0.0
R_2=0.0
R_3=0.0
R_4=1.0
R_5=0.0
R_6=0.0
R_7=0.0
R_8=1.0
T_0=-5.5
T_1=0.1
T_2=0.0
"""


def joints_of(arm: str, frame: int) -> list[float]:
    sign = 1.0 if arm == "PSM1" else -1.0
    return [0.1, 0.2, 0.15, -2.8, sign * (0.3 + 0.01 * frame), sign * (-0.2 - 0.02 * frame)]


def point_of(identity: int, frame: int, eye: str = "left") -> list[float]:
    return [2.0 * identity + frame + (1.0 if eye == "right" else 0.0), 10.0 + identity]


def jaws_of(arm: str, count: int = FRAMES) -> list[float]:
    return [(0.4 if arm == "PSM1" else 0.2) + 0.1 * (frame + FRAMES - count) for frame in range(count)]


def put_trajectory(folder: Path, *, k1: float = 0.0, fps: float = 30.0) -> None:
    """All but the jaw."""
    folder.mkdir(parents=True)
    (folder / "StereoCalibrationDVRK.ini").write_text(CALIBRATION.format(k1=k1))
    for eye in ("left", "right"):
        put_video(folder / f"regular/{eye}_video.avi", map(grey, range(FRAMES)), fps=fps)
        (folder / f"regular/{eye}_video.avi").rename(folder / f"regular/{eye}_video.mp4")  # whatever is in it
        points: dict[int, Any] = {
            frame: {identity: point_of(identity, frame, eye) for identity in (*range(1, 6), *range(8, 13))}
            for frame in range(FRAMES)
        }
        points[1][4] = None
        points[2][6] = point_of(6, 2, eye)
        (folder / f"keypoints_{eye}.yaml").write_text(yaml.safe_dump(points))
    read = {str(frame): {arm: joints_of(arm, frame) for arm in ("PSM1", "PSM3")} for frame in range(FRAMES)}
    (folder / "api_jp_data.yaml").write_text(yaml.safe_dump(read))


def put_jaw(path: Path, content: object) -> None:
    path.write_text(yaml.safe_dump(content))


@pytest.fixture
def source(tmp_path: Path) -> Path:
    for name in ("000000", "000031"):
        put_trajectory(tmp_path / "SurgPose" / name)
    own = {arm: jaws_of(arm) for arm in ("PSM1", "PSM3")}
    put_jaw(tmp_path / "SurgPose/gripper_angle.yaml", {"000000": own, "000031": own})
    return tmp_path / "SurgPose"


def test_everything_is_where_it_belongs(source: Path, tmp_path: Path) -> None:
    dataset = imported("surgpose", source, out=tmp_path / "data")
    assert [(one.id, one.speed, one.frames) for one in dataset.sequences] == [
        ("000000", "nominal", FRAMES),
        ("000031", "fast", FRAMES),
    ]
    sequence = dataset.sequences[0]
    assert (sequence.arms, sequence.entry.kinds) == (("left", "right"), ())
    assert (sequence.camera.fx, sequence.camera.fy, sequence.camera.distortion) == (80.0, 81.0, ())
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(FRAMES) / 30)
    # PSM1 is the right instrument; q3 is half of the jaw.
    for arm, theirs, first in (("right", "PSM1", 1), ("left", "PSM3", 8)):
        readings, whole = sequence.readings(arm), sequence.arm_joints(arm)  # type: ignore[arg-type]
        assert readings is not None
        assert whole is not None
        np.testing.assert_allclose(whole, [joints_of(theirs, frame) for frame in range(FRAMES)])
        np.testing.assert_allclose(readings[:, :2], whole[:, 4:])
        np.testing.assert_allclose(readings[:, 2], np.array(jaws_of(theirs)) / 2)
        labels = sequence.labels(arm)  # type: ignore[arg-type]
        assert set(labels) == {"shaft", "wrist", "jaw_pivot", "left_tip", "right_tip", "joint_2"}
        np.testing.assert_allclose(labels["wrist"], [point_of(first + 1, frame) for frame in range(FRAMES)])
        tips = sequence.keypoints(arm)  # type: ignore[arg-type]
        np.testing.assert_allclose(tips[3], [point_of(first + 3, 3), point_of(first + 4, 3)])
    assert np.isnan(sequence.keypoints("right")[1, 0]).all()
    assert not np.isnan(sequence.keypoints("right")[1, 1]).any()
    image = sequence.image(2)
    assert image is not None
    assert image.mean() == pytest.approx(40, abs=2)
    turn = np.reshape(dataset.manifest.configuration["T_right_left"]["000000"], (4, 4))
    np.testing.assert_allclose(turn[:3, 3], [-0.0055, 0.0001, 0.0])  # millimetres in the file


def test_the_right_eye(source: Path, tmp_path: Path) -> None:
    options = ("--eye", "right", "--trajectories", "31")
    dataset = imported("surgpose", source, *options, out=tmp_path / "data")
    (sequence,) = dataset.sequences
    assert (sequence.camera.fx, sequence.camera.cx) == (90.0, 30.5)
    np.testing.assert_allclose(sequence.keypoints("right")[0, 0], point_of(4, 0, "right"))


def test_half_the_size_is_half_of_everything(source: Path, tmp_path: Path) -> None:
    sequence = imported("surgpose", source / "000000", "--half", out=tmp_path / "data").sequences[0]
    camera = sequence.camera
    assert (camera.width, camera.height, camera.fx, camera.cx) == (WIDTH // 2, HEIGHT // 2, 40.0, 15.5)
    image = sequence.image(0)
    assert image is not None
    assert image.shape == (HEIGHT // 2, WIDTH // 2, 3)
    # A pixel's area is halved, not its centre.
    np.testing.assert_allclose(2 * sequence.labels("right")["wrist"] + 0.5, [point_of(2, k) for k in range(FRAMES)])


@pytest.mark.parametrize("halved", [True, False])
def test_masks_of_a_segmenter_beside_it(source: Path, tmp_path: Path, halved: bool) -> None:
    for arm, top in (("PSM1", 8), ("PSM3", 30)):
        for frame in range(1, FRAMES):
            mask = 255 * bar(frame, top).astype(np.uint8)
            put(tmp_path / f"sam/000000/{arm}/{frame:05d}.png", mask[::2, ::2] if halved else mask)
    options = ("--trajectories", "0", "--masks", tmp_path / "sam", "--half")
    sequence = imported("surgpose", source, *options, out=tmp_path / "data").sequences[0]
    assert sequence.entry.kinds == ("left", "right", "both")
    assert sequence.entry.source_frames == ("frame1", "frame2", "frame3", "frame4")
    assert np.array_equal(sequence.mask("right", 1), bar(2, 8)[::2, ::2])
    assert np.array_equal(sequence.mask("left", 1), bar(2, 30)[::2, ::2])
    np.testing.assert_allclose(2 * sequence.labels("right")["wrist"][1] + 0.5, point_of(2, 2))


def test_points_and_pictures_lose_the_same_lens(tmp_path: Path) -> None:
    put_trajectory(tmp_path / "000000", k1=-0.3)
    sequence = imported("surgpose", tmp_path / "000000", out=tmp_path / "data").sequences[0]
    seen, straight = np.array(point_of(1, 0)), sequence.labels("right")["shaft"][0]
    ray = (straight - [31.5, 23.5]) / [80.0, 81.0]
    bent = ray * (1 - 0.3 * (ray**2).sum()) * [80.0, 81.0] + [31.5, 23.5]
    np.testing.assert_allclose(bent, seen, atol=0.02)


def test_a_jaw_in_the_trajectory_begins_with_the_second_frame(source: Path, tmp_path: Path) -> None:
    put_jaw(source / "000000/gripper_angle.yaml", {arm: jaws_of(arm, FRAMES - 1) for arm in ("PSM1", "PSM3")})
    readings = imported("surgpose", source / "000000", out=tmp_path / "data").sequences[0].readings("right")
    assert readings is not None
    assert np.isnan(readings[0, 2])
    np.testing.assert_allclose(readings[1:, 2], np.array(jaws_of("PSM1"))[1:] / 2)


def test_without_a_jaw_there_are_no_readings_but_joints(source: Path, tmp_path: Path) -> None:
    (source / "gripper_angle.yaml").unlink()
    sequence = imported("surgpose", source, out=tmp_path / "data").sequences[0]
    assert sequence.readings("left") is None
    assert sequence.arm_joints("left") is not None


def test_a_lag_moves_readings_and_is_kept(source: Path, tmp_path: Path) -> None:
    (tmp_path / "lags.csv").write_text("trajectory,arm,frames\n0,right,2\n000031,left,-1\n")
    dataset = imported("surgpose", source, "--lag", tmp_path / "lags.csv", out=tmp_path / "data")
    assert dataset.manifest.configuration["lag_frames_taken_out"] == {
        "000000": {"right": 2.0},
        "000031": {"left": -1.0},
    }
    first, last = dataset.sequences[0].readings("right"), dataset.sequences[1].readings("left")
    assert first is not None
    assert last is not None
    np.testing.assert_allclose(first[:3, 0], [joints_of("PSM1", frame)[4] for frame in (2, 3, 4)])
    assert np.isnan(first[3:]).all()
    np.testing.assert_allclose(last[1:, 0], [joints_of("PSM3", frame)[4] for frame in range(FRAMES - 1)])


@given(lag=st.integers(-48, 48).map(lambda sixteenths: sixteenths / 16), slope=st.floats(-2.0, 2.0))
def test_what_grows_evenly_is_moved_exactly(lag: float, slope: float) -> None:
    read = slope * np.arange(12.0)[:, None]
    moved = move_readings(read, lag)
    there = ~np.isnan(moved[:, 0])
    assert there.sum() == 12 - np.ceil(abs(lag))
    np.testing.assert_allclose(moved[there, 0], slope * (np.arange(12)[there] + lag), atol=1e-9)


def test_what_does_not_fit_is_one_line(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, folder = tmp_path / "data", source / "000000"
    assert "has no trajectory 000005" in refused(capsys, "surgpose", source, "--trajectories", "5", out=out)
    assert "has no trajectory" in refused(capsys, "surgpose", source, "--trajectories", "0-999999999999999", out=out)
    for numbers in ("a", "3-1", "²", "9" * 5000):
        assert "must be like 0-7,30-33" in refused(capsys, "surgpose", source, "--trajectories", numbers, out=out)
    assert "holds neither PSM1 nor PSM3" in refused(capsys, "surgpose", folder, "--masks", tmp_path, out=out)
    assert "no reading is left" in refused(capsys, "surgpose", folder, "--lag", FRAMES, out=out)
    assert "--lag: 'x' is no number" in refused(capsys, "surgpose", folder, "--lag", "x", out=out)
    put_jaw(folder / "gripper_angle.yaml", {"PSM1": jaws_of("PSM1"), "PSM3": [0.1]})
    assert "1 angles of PSM3; expected 5 or 4" in refused(capsys, "surgpose", folder, out=out)
    (folder / "keypoints_left.yaml").write_text(yaml.safe_dump({FRAMES: {1: [1.0, 2.0]}}))
    assert f"has frame {FRAMES}, the video has {FRAMES} frames" in refused(capsys, "surgpose", folder, out=out)
    (folder / "keypoints_left.yaml").write_text(yaml.safe_dump({0: {15: [1.0, 2.0]}}))
    assert "no point 15" in refused(capsys, "surgpose", folder, out=out)
    (folder / "StereoCalibrationDVRK.ini").write_text(CALIBRATION.format(k1=0.0).replace("fc_x=80.0\n", ""))
    assert "'fc_x' of [StereoLeft] is missing" in refused(capsys, "surgpose", folder, out=out)
    assert "holds no trajectories" in refused(capsys, "surgpose", tmp_path, out=out)


def test_another_frame_rate_is_refused_or_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    put_trajectory(tmp_path / "000000", fps=60.0)
    assert "--fps 60" in refused(capsys, "surgpose", tmp_path / "000000", out=tmp_path / "data")
    sequence = imported("surgpose", tmp_path / "000000", "--fps", 60, out=tmp_path / "data").sequences[0]
    assert sequence.dt_s == pytest.approx(1 / 60)
