"""SurgPose's layout, made small: what each file says is where it belongs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from others import HEIGHT, WIDTH, bar, imported, put, refused
from surgpose_folder import CALIBRATION, FRAMES, jaws_of, joints_of, point_of, put_jaw, put_trajectory

from surgbench.errors import DatasetError
from surgbench.exchange.lags import move_readings
from surgbench.recordings.surgpose import read_keypoints
from surgbench.tasks.instrument.units import UnitData


@pytest.fixture
def source(tmp_path: Path) -> Path:
    for name in ("000000", "000031"):
        put_trajectory(tmp_path / "SurgPose" / name)
    # As published: of all trajectories in one file, one angle less than frames, the first one of frame 0.
    own = {arm: jaws_of(arm)[:-1] for arm in ("PSM1", "PSM3")}
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
        np.testing.assert_allclose(readings[:, 2], [*np.array(jaws_of(theirs)[:-1]) / 2, np.nan])
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


def test_the_other_eye_is_an_auxiliary_view(source: Path, tmp_path: Path) -> None:
    """Both keep the frames that both have masks of; its place is that of the stereo calibration."""
    for eye, frames in (("left", range(1, FRAMES)), ("right", range(FRAMES - 1))):
        for arm, top in (("PSM1", 8), ("PSM3", 30)):
            for frame in frames:
                shown = bar(frame, top + 2 * (eye == "right"))
                put(tmp_path / f"{eye}/000000/{arm}/{frame:05d}.png", 255 * shown.astype(np.uint8))
    options = ("--trajectories", "0", "--half")
    both = ("--masks", tmp_path / "left", "--other-masks", tmp_path / "right")
    dataset = imported("surgpose", source, *options, *both, out=tmp_path / "data")
    (sequence,) = dataset.sequences
    assert sequence.entry.source_frames == ("frame1", "frame2", "frame3")
    view = sequence.auxiliary("right-eye")
    assert (view.camera.width, view.camera.fx, view.entry.kinds) == (WIDTH // 2, 45.0, ("left", "right", "both"))
    assert np.array_equal(view.mask("right", 0), bar(1, 10)[::2, ::2])
    assert np.array_equal(view.mask("both", 0), view.mask("left", 0) | view.mask("right", 0))
    np.testing.assert_allclose(view.T_view_cam("both")[2][:3, 3], [-0.0055, 0.0001, 0.0])
    np.testing.assert_allclose(2 * view.keypoints("both", "left")[0, 0] + 0.5, point_of(11, 1, "right"))
    given = UnitData(dataset, dataset.units()[0], "none", view="right-eye").observation(0)
    assert np.array_equal(given.views[1].mask, view.mask("left", 0))
    other = ("--eye", "right", "--masks", tmp_path / "right", "--other-masks", tmp_path / "left")
    swapped = imported("surgpose", source, *options, *other, out=tmp_path / "swapped").sequences[0]
    back = swapped.auxiliary("left-eye").T_view_cam("left")[0]
    np.testing.assert_allclose(back @ view.T_view_cam("left")[0], np.eye(4), atol=1e-12)


def test_the_other_eye_needs_masks_of_the_same_arms(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for eye, arm in (("left", "PSM1"), ("left", "PSM3"), ("right", "PSM1")):
        put(tmp_path / f"{eye}/000000/{arm}/00000.png", 255 * bar(0).astype(np.uint8))
    folder, right = source / "000000", ("--other-masks", tmp_path / "right")
    assert "name them with --masks" in refused(capsys, "surgpose", folder, *right, out=tmp_path / "data")
    said = refused(capsys, "surgpose", folder, "--masks", tmp_path / "left", *right, out=tmp_path / "data")
    assert "has masks of PSM1, " in said
    assert "of PSM3 and PSM1; both need the same" in said


def test_labels_beyond_the_end_of_the_video_are_left_out_and_told(tmp_path: Path) -> None:
    """A video may lack its last frames; one at another rate has far less."""
    path, lines = tmp_path / "keypoints_left.yaml", list[str]()
    path.write_text(yaml.safe_dump({frame: {1: [1.0 + frame, 2.0]} for frame in range(101)}))
    points = read_keypoints(path, 100, lines.append)
    np.testing.assert_allclose(points["shaft"]["right"][99], [100.0, 2.0])
    assert [line for line in lines if "frames up to 100, the video 100" in line] == lines
    assert len(lines) == 1
    with pytest.raises(DatasetError, match="has frame 100, the video has 50 frames"):
        read_keypoints(path, 50)


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


def test_the_common_file_of_jaws_may_lack_a_trajectory(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    put_trajectory(source / "000008")
    (source / "000000").rename(source / "000010")
    # As a hand writes it: as YAML has it, 000010 is 8.
    jaws = f"000010: {{PSM1: {jaws_of('PSM1')}, PSM3: {jaws_of('PSM3')}}}"
    (source / "gripper_angle.yaml").write_text(jaws)
    dataset = imported("surgpose", source, out=tmp_path / "data")
    assert [one.readings("right") is not None for one in dataset.sequences] == [False, True, False]
    assert "000008: gripper_angle.yaml has no trajectory 000008, so no readings of q3" in capsys.readouterr().err


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
    (folder / "keypoints_left.yaml").write_text("0: {1: [0x1, 2]}")
    assert "keypoints_left.yaml: not valid YAML" in refused(capsys, "surgpose", folder, out=out)
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
