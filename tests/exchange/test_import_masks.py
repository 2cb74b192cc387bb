"""Recordings as laboratories have them, imported by the command as a user types it, and tracked."""

from __future__ import annotations

import json
import subprocess
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from commandline import RUN, STRANGERS, records, surgbench

from surgbench.dataset.open import open_as
from surgbench.dataset.validate import validate
from surgbench.exchange.masks import import_masks
from surgbench.tasks.instrument.dataset import InstrumentDataset, Sequence

WIDTH, HEIGHT = 64, 48
CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": 80.0, "fy": 80.0, "cx": 31.5, "cy": 23.5}


def tool(frame: int, top: int = 8) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[top : top + 8, : 24 + frame] = 1
    return mask


def put(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(path.suffix, picture)[1].tobytes())


@pytest.fixture
def source(tmp_path: Path) -> Path:
    root = tmp_path / "recording"
    root.mkdir()
    (root / "camera.json").write_text(json.dumps(CAMERA))
    return root


def imported(source: Path, *options: object) -> Sequence:
    out = source.with_name("data")
    surgbench("import", "masks", source, *options, "--out", out)
    assert validate(out) == []
    return open_as(InstrumentDataset, out).sequences[0]


def test_instances_become_masks_of_two_arms(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for frame in range(3):
        put(source / f"masks/{frame:06d}.png", tool(frame) + 2 * tool(frame, 30))
    two = "frame,left_q1,left_q2,left_q3,right_q1,right_q2,right_q3\n" + "".join(
        f"{frame},0.1,0.2,0.3,0.4,0.5,0.6\n" for frame in range(3)
    )
    surgbench("import", "masks", source, "--out", source.with_name("data"), expect=2)
    error = capsys.readouterr().err
    assert "--instances 1=left,2=right" in error
    assert error.count("\n") == 1
    assert not source.with_name("data").exists()
    (source / "joints.csv").write_text(two)
    surgbench("import", "masks", source, "--out", source.with_name("data"), expect=2)
    assert "joints.csv: has columns of two arms; say --instances" in capsys.readouterr().err
    sequence = imported(source, "--instances", "1=left,2=right", "--jaw", "half")
    assert "3 masks, values {0, 1, 2}, 1=left,2=right, " in capsys.readouterr().err
    assert sequence.arms == ("left", "right")
    assert np.array_equal(sequence.mask("left", 1), tool(1) > 0)
    assert np.array_equal(sequence.mask("right", 1), tool(1, 30) > 0)
    assert np.array_equal(sequence.mask("both", 1), (tool(1) + tool(1, 30)) > 0)
    np.testing.assert_array_equal(sequence.readings("right"), np.tile([0.4, 0.5, 0.6], (3, 1)))
    dataset = open_as(InstrumentDataset, source.with_name("data"))
    assert [unit.kind for unit in dataset.units("single")] == ["left", "right"]
    assert [unit.kind for unit in dataset.units("dual")] == ["both"]


LAYOUTS = {
    "frame,PSM1_wrist_pitch,PSM1_wrist_yaw,PSM1_half_jaw,PSM3_wrist_pitch,PSM3_wrist_yaw,PSM3_half_jaw": "PSM1",
    "frame,q1_right,q2_right,q3_right,q1_left,q2_left,q3_left": "right",
    "frame,arm,q1,q2,q3": "PSM1",
    "frame,side,q1,q2,q3": "Right",
}


@pytest.mark.parametrize("header", LAYOUTS)
def test_tables_of_two_arms_say_whose_each_column_or_row_is(
    source: Path, capsys: pytest.CaptureFixture[str], header: str
) -> None:
    right = LAYOUTS[header]
    left = {"PSM1": "PSM3", "right": "left", "Right": "LEFT"}[right]
    lines: list[list[object]] = []
    for frame in range(3):
        put(source / f"masks/{frame:06d}.png", tool(frame) + 2 * tool(frame, 30))
        by_row = header.split(",")[1] in ("arm", "side")
        rows: list[list[object]] = [[frame, right, 0.4, 0.5, 0.6], [frame, left, 0.1, 0.2, 0.3]]
        lines += rows if by_row else [[frame, 0.4, 0.5, 0.6, 0.1, 0.2, 0.3]]
    (source / "joints.csv").write_text("\n".join([header, *(",".join(map(str, row)) for row in lines)]))
    instances = ("--instances", "1=left,2=right", "--jaw", "half")
    names: tuple[str, ...] = ()
    if right == "PSM1":
        names = ("--arm-names", "PSM1=right,PSM3=left")
        surgbench("import", "masks", source, *instances, "--out", source.with_name("data"), expect=2)
        said = capsys.readouterr().err.splitlines()[-1]
        assert "joints.csv: is of PSM1 and PSM3; which arm is which? for example --arm-names PSM1=left" in said
    sequence = imported(source, *instances, *names)
    np.testing.assert_array_equal(sequence.readings("right"), np.tile([0.4, 0.5, 0.6], (3, 1)))
    np.testing.assert_array_equal(sequence.readings("left"), np.tile([0.1, 0.2, 0.3], (3, 1)))


def test_of_a_table_of_two_arms_one_may_be_told(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for frame in range(3):
        put(source / f"masks/{frame:06d}.png", tool(frame))
    rows = [f"{frame},{arm},0.1,0.2,{0.1 * arm}" for frame in range(3) for arm in (1, 2)]
    (source / "joints.csv").write_text("\n".join(["frame,arm,q1,q2,q3", *rows]))
    (source / "tips.csv").write_text("frame,u1,v1,u2,v2\n0,10,11,12,13\n")  # of one arm, whose it is
    out = ("--out", source.with_name("data"))
    surgbench("import", "masks", source, *out, expect=2)
    assert "is of 1 and 2; which arm is which? for example --arm-names 1=left,2=right" in capsys.readouterr().err
    surgbench("import", "masks", source, "--arm-names", "1=up", *out, expect=2)
    assert "--arm-names: must be like PSM1=right,PSM3=left, not '1=up'" in capsys.readouterr().err
    surgbench("import", "masks", source, "--arm-names", "1=right", *out, expect=2)
    assert "joints.csv: is of 1 and 2; which arm is which?" in capsys.readouterr().err
    sequence = imported(source, "--arm-names", "2=left", "--jaw", "half")
    np.testing.assert_array_equal(sequence.readings("left"), np.tile([0.1, 0.2, 0.2], (3, 1)))
    np.testing.assert_array_equal(sequence.keypoints("left")[0], [[10, 11], [12, 13]])


def test_two_tools_in_one_mask_are_doubted_and_told(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for frame in range(3):
        put(source / f"masks/{frame:06d}.png", 255 * (tool(frame) + tool(frame, 30)))
    imported(source)
    assert "warning: 3 of 3 masks have two large parts at the border" in capsys.readouterr().err
    surgbench("import", "masks", source, "--arms", "both", "--out", source.with_name("pair"))
    assert "warning" not in capsys.readouterr().err
    dataset = open_as(InstrumentDataset, source.with_name("pair"))
    assert [(unit.arms, unit.kind) for unit in dataset.units("dual")] == [(("left", "right"), "both")]


def test_tips_that_lie_elsewhere_are_doubted(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for frame in range(3):
        put(source / f"masks/{frame:06d}.png", 255 * tool(frame))
    rows = [f"{frame},{24 + frame},10,{25 + frame},14" for frame in range(3)]
    (source / "tips.csv").write_text("\n".join(["frame,u1,v1,u2,v2", *rows]))
    imported(source)
    assert "warning" not in capsys.readouterr().err
    (source / "tips.csv").write_text("\n".join(["frame,v1,u1,v2,u2", *rows]))
    surgbench("import", "masks", source, "--out", source.with_name("exchanged"))
    assert "warning: tips.csv: 6 of 6 tips lie more than 4 pixels from the mask" in capsys.readouterr().err


def test_jpeg_masks_are_cut_with_a_warning(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for frame in range(3):
        put(source / f"masks/{frame:06d}.jpg", 255 * tool(frame))
    sequence = imported(source)
    assert "as JPEG smears edges: pixels of at least 128 are taken" in capsys.readouterr().err
    assert np.array_equal(sequence.mask("left", 2), tool(2) > 0)


@pytest.mark.parametrize(("name", "codec"), [("masks.avi", "MJPG"), ("masks.avi", "FFV1"), ("masks.mp4", "mp4v")])
def test_masks_of_a_video_are_read(source: Path, name: str, codec: str) -> None:
    size = (WIDTH, HEIGHT)
    writer = cv2.VideoWriter(str(source / name), cv2.VideoWriter.fourcc(*codec), 20.0, size)
    if not writer.isOpened():
        pytest.skip(f"this OpenCV has no encoder for {codec}")
    for frame in range(6):
        writer.write(np.repeat(255 * tool(2 * frame)[..., None], 3, axis=2))
    writer.release()
    sequence = imported(source)
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(6) / 20)
    assert sequence.dt_s == pytest.approx(1 / 20)
    for frame in range(6):
        seen, drawn = sequence.mask("left", frame), tool(2 * frame) > 0
        assert (seen ^ drawn).sum() <= (0 if codec == "FFV1" else 0.1 * drawn.sum())


def test_a_damaged_video_is_one_line(source: Path) -> None:
    """What the decoder prints of it besides is no second one."""
    (source / "masks.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(100))
    command = ["import", "masks", str(source), "--out", str(source.with_name("data"))]
    run = subprocess.run(
        [sys.executable, "-c", "from surgbench.cli import main; main()", *command],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 2
    assert run.stderr.rstrip("\n").endswith("masks.mp4: not a video that can be decoded, or truncated")
    assert run.stderr.count("\n") == 1


def test_runs_of_coco_are_read(source: Path) -> None:
    flat = tool(0).T.ravel()
    counts = np.diff(np.flatnonzero(np.diff(flat, prepend=1 - flat[0], append=1 - flat[-1]))).tolist()
    counts = counts if flat[0] == 0 else [0, *counts]
    (source / "masks.json").write_text(json.dumps([{"size": [HEIGHT, WIDTH], "counts": counts}]))
    assert np.array_equal(imported(source).mask("left", 0), tool(0) > 0)


def test_masks_of_every_third_frame_keep_their_time(source: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for frame in range(7):
        put(source / f"images/seq02_{frame:03d}.png", np.full((HEIGHT, WIDTH, 3), 10 * frame, np.uint8))
    for frame in (0, 3, 6):
        put(source / f"masks/seq02_{frame:03d}_mask.png", 255 * tool(frame))
    (source / "joints.csv").write_text(
        "frame,wrist_pitch,wrist_yaw,half_jaw\n" + "".join(f"{k},0,0,0.{k}\n" for k in range(7))
    )
    sequence = imported(source)
    said = capsys.readouterr().err
    assert "frames 0 to 6, one in 3, 0.1 s apart" in said
    assert "4 of 7 images have no mask, and are left out" in said
    np.testing.assert_allclose(sequence.timestamps_s, [0.0, 0.1, 0.2])
    image = sequence.image(1)
    assert image is not None
    assert image.max() == 30
    readings = sequence.readings("left")
    assert readings is not None
    np.testing.assert_array_equal(readings[:, 2], [0.0, 0.3, 0.6])


def test_memory_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    """Nor with the numbers in its names."""
    width, height = 640, 480
    picture = np.zeros((height, width), np.uint8)
    picture[100:180, :300] = 255

    def most(frames: int) -> int:
        root = tmp_path / f"of {frames}"
        for frame in range(frames):
            put(root / f"masks/{1403636579763555584 + 50_000_000 * frame}.png", picture)
        scale = {"width": width, "height": height, "fx": 800.0, "fy": 800.0, "cx": 319.5, "cy": 239.5}
        (root / "camera.json").write_text(json.dumps(scale))
        tracemalloc.start()
        import_masks(root, tmp_path / f"data of {frames}")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    most(2)  # what is loaded once
    assert most(40) < most(10) + 3 * width * height


def test_what_systems_leave_is_no_part_of_a_recording_or_dataset(source: Path) -> None:
    put(source / "masks/000000.png", 255 * tool(0))
    (source / "masks/._000000.png").write_bytes(b"\0\5\26\7")
    (source / "masks/Thumbs.db").write_bytes(b"x")
    out = source.with_name("data")
    out.mkdir()
    (out / ".DS_Store").write_bytes(b"x")  # of a folder that was looked at before
    imported(source)
    assert (out / ".DS_Store").exists()
    (out / "sequences/desktop.ini").write_bytes(b"x")
    surgbench("validate", out)
    (out / "sequences/mine.txt").write_bytes(b"x")
    surgbench("validate", out, expect=2)


def enter(source: Path, frames: int, first: int) -> Path:
    for frame in range(frames):
        put(source / f"masks/{frame:06d}.png", 255 * tool(frame) * (frame >= first))
    imported(source)
    return source.with_name("data")


AHEAD = """
import numpy as np

class Ahead:
    name = "ahead"
    needs_truth = False

    def initialise(self, scene, observation, rng, truth, progress):
        assert observation.mask.any(), "nothing to start from"
        return np.array([0, 0, 0, 0, 0, 0.1 + 0.01 * observation.index, 0, 0, 0])
"""


@pytest.mark.slow
def test_an_instrument_that_enters_late_is_waited_for(source: Path, tmp_path: Path) -> None:
    data = enter(source, 6, 3)
    (tmp_path / "ahead.py").write_text(AHEAD)
    plugins = ("--tracker", f"{STRANGERS}:Still", "--initialiser", f"{tmp_path / 'ahead.py'}:Ahead", "--filter", "none")
    surgbench(*RUN, "--dataset", data, *plugins, "--out", tmp_path / "runs")
    (record,) = records(tmp_path / "runs")
    frames = record["frames"]
    assert record["status"] == "ok"
    assert frames["index"] == list(range(6))
    assert frames["lost"][:3] == [True] * 3
    assert frames["state"][3][5] == pytest.approx(0.13)  # found in frame 3
    assert frames["latency_ms"][:3] == [None] * 3
    assert all(latency > 0 for latency in frames["latency_ms"][3:])
    assert record["errors"]["mask_error"][:3] == [None] * 3
    assert all(error is not None for error in record["errors"]["mask_error"][3:])
    (path,) = (tmp_path / "runs").rglob("*-r0.json")
    path.with_name("._000-r0.json").write_bytes(b"\0\5\26\7")
    (tmp_path / "runs/.DS_Store").write_bytes(b"x")
    surgbench("report", tmp_path / "runs")


@pytest.mark.slow
def test_where_nothing_ever_shows_the_run_fails_in_one_line(source: Path, tmp_path: Path) -> None:
    data = enter(source, 6, 5)
    still: Any = f"{STRANGERS}:Still"
    command = (*RUN, "--dataset", data, "--tracker", still, "--frames", 3, "--out", tmp_path / "runs")
    surgbench(*command, expect=1)
    (record,) = records(tmp_path / "runs")
    assert record["error"] == "frame 0: no instrument shows in any of 3 masks: nothing to start from"
