"""Motions out of bags of ROS 1 and 2, by the topic that CRTK calls so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from commandline import surgbench
from others import refused
from trajectories import feature, put_bag

from surgbench.dataset.open import open_as
from surgbench.tasks.viewpoint.dataset import ViewpointDataset

pytest.importorskip("rosbags")
pytestmark = [pytest.mark.extras]


@pytest.mark.parametrize(
    ("name", "ros", "kind", "storage"),
    [
        ("path.bag", 1, "PoseStamped", ""),
        ("path.bag", 1, "TransformStamped", ""),
        ("path", 2, "PoseStamped", "SQLITE3"),
        ("path", 2, "TransformStamped", "MCAP"),
    ],
)
def test_both_kinds_of_bags_hold_the_motion(
    name: str, ros: int, kind: str, storage: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """To what a stamp can tell: nanoseconds. When a message was recorded does not count."""
    times, poses = feature()
    bag = put_bag(tmp_path / name, times, poses, ros=ros, kind=kind, storage=storage or "SQLITE3")
    surgbench("import", "trajectory", bag, "--of", "feature", "--out", tmp_path / "data")
    assert "poses are in frame 'PSM1_base', taken as the world's (--frame says otherwise)" in capsys.readouterr().err
    trial = open_as(ViewpointDataset, tmp_path / "data").trial("path")
    np.testing.assert_allclose(trial.T_world_feature, poses, atol=1e-9)


def test_a_file_of_a_recording_is_that_recording(tmp_path: Path) -> None:
    times, poses = feature()
    bag = put_bag(tmp_path / "path", times, poses, ros=2)
    (file,) = bag.glob("*.db3")
    surgbench("import", "trajectory", file, "--of", "feature", "--out", tmp_path / "data")
    (trial,) = open_as(ViewpointDataset, tmp_path / "data").trials
    assert trial.frames == len(times)


def test_messages_without_a_time_were_when_they_were_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    times, poses = feature()
    bag = put_bag(tmp_path / "path.bag", times, poses, ros=1, kind="Pose")
    surgbench("import", "trajectory", bag, "--of", "feature", "--out", tmp_path / "data")
    assert "messages have no time of their own" in capsys.readouterr().err


def test_which_topic_is_told_or_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    times, poses = feature()
    topics = ("/PSM1/measured_cp", "/PSM2/measured_cp", "/PSM1/setpoint_cp")
    bag = put_bag(tmp_path / "path.bag", times, poses, ros=1, topics=topics)
    out = tmp_path / "data"
    said = refused(capsys, "trajectory", bag, out=out)
    assert "2 topics end in 'measured_cp'; --topic says which" in said
    assert "/PSM1/measured_cp, /PSM2/measured_cp" in said
    said = refused(capsys, "trajectory", bag, "--topic", "/PSM3/measured_cp", out=out)
    assert "unknown topic '/PSM3/measured_cp'; did you mean '/PSM" in said
    said = refused(capsys, "trajectory", bag, "--topic", "/PSM1/note", out=out)
    assert "holds std_msgs/msg/String, no poses" in said
    surgbench("import", "trajectory", bag, "--topic", "/PSM1/setpoint_cp", "--out", out)
    other = put_bag(tmp_path / "other.bag", times, poses, ros=1, topics=("/tool",))
    said = refused(capsys, "trajectory", other, out=tmp_path / "more")
    assert "no topic ends in 'measured_cp'; --topic says which holds the poses (those that could: /tool)" in said


@pytest.mark.parametrize("ros", [1, 2])
def test_damaged_bags_are_one_line(ros: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    times, poses = feature()
    bag = put_bag(tmp_path / ("path.bag" if ros == 1 else "path"), times, poses, ros=ros)
    file = bag if ros == 1 else next(bag.glob("*.db3"))
    whole = file.read_bytes()
    for share in (0.0, 0.3, 0.9):
        file.write_bytes(whole[: int(share * len(whole))])
        said = refused(capsys, "trajectory", bag, out=tmp_path / "data")
        assert "cannot be read as a bag, truncated or damaged" in said
        assert str(bag) in said
    file.write_bytes(b"\x00" * 10_000)
    assert "truncated or damaged" in refused(capsys, "trajectory", bag, out=tmp_path / "data")


def test_without_rosbags_the_line_says_what_to_install(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = tmp_path / "path.bag"
    bag.write_bytes(b"#ROSBAG V2.0\n")
    monkeypatch.setattr("surgbench.recordings.pose_bags.missing", lambda modules: "rosbags is not installed: pip")
    assert "is a bag, and rosbags is not installed: pip" in refused(capsys, "trajectory", bag, out=tmp_path / "data")
