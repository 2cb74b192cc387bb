"""From masks to poses in one go."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from commandline import MASK_MAKERS, STRANGERS, surgbench
from others import put_video
from small_dataset import CAMERA, DRIVER, FRAMES, paint, states_of

from surgbench.camera import Camera
from surgbench.instrument import load_instrument
from surgbench.report.movie import write_video
from surgbench.silhouette import SilhouetteEvaluator

# What this is about is the way: the tracker that stays where it begins, and a search that is over at once.
STILL = f"{STRANGERS}:Still"
SEARCH = {"hypotheses": 64, "refined": 1, "shafts": 1, "redrawn": 16, "finalists": 1, "generations": "[1, 1]"}
QUICK = [word for key, value in SEARCH.items() for word in ("--set", f"random.{key}={value}")]


@pytest.fixture(scope="module")
def masks() -> list[np.ndarray]:
    evaluator = SilhouetteEvaluator([load_instrument(DRIVER)], CAMERA)
    return [evaluator.mask(state) for state in states_of("left")]


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    path = tmp_path / "endoscope.json"
    path.write_text(CAMERA.model_dump_json(exclude={"distortion"}))
    return path


def write_masks(folder: Path, masks: list[np.ndarray]) -> Path:
    folder.mkdir(parents=True)
    for frame, mask in enumerate(masks):
        assert cv2.imwrite(str(folder / f"{frame:06d}.png"), mask.astype(np.uint8) * 255)
    return folder


def track(source: Path, out: Path, *more: object, expect: int = 0) -> None:
    surgbench("track", source, "--out", out, "--tracker", STILL, *QUICK, *more, expect=expect)


@pytest.mark.slow
def test_a_folder_of_masks_becomes_poses_and_a_video(
    masks: list[np.ndarray], camera: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write_masks(tmp_path / "masks of today", masks)
    out = tmp_path / "poses.csv"
    out.write_text("of yesterday")
    track(source, out, "--camera", camera, "--fps", 20)
    assert capsys.readouterr().out.split() == [str(out), str(out.with_suffix(".mp4"))]
    poses = pd.read_csv(out)
    assert poses["frame"].tolist() == list(range(FRAMES))
    np.testing.assert_allclose(poses["timestamp_s"], np.arange(FRAMES) / 20)
    assert {"x_m", "qw", "q3_rad", "tip1_x_m", "lost", "latency_ms"} <= set(poses.columns)
    video = cv2.VideoCapture(str(out.with_suffix(".mp4")))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == FRAMES
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(20)
    assert {path.name for path in tmp_path.iterdir()} == {source.name, camera.name, "poses.csv", "poses.mp4"}


@pytest.mark.slow
def test_a_video_of_masks_and_a_whole_recording_are_tracked_alike(
    masks: list[np.ndarray], camera: Path, tmp_path: Path
) -> None:
    pictures = [np.repeat(mask[..., None] * np.uint8(255), 3, axis=2) for mask in masks]
    write_video(tmp_path / "masks.mp4", pictures, 12.5)
    track(tmp_path / "masks.mp4", tmp_path / "a.csv", "--camera", camera, "--no-video", "--arm", "right")
    poses = pd.read_csv(tmp_path / "a.csv")
    np.testing.assert_allclose(poses["timestamp_s"], np.arange(FRAMES) / 12.5)
    assert set(poses["arm"]) == {"right"}
    recording = tmp_path / "recording"
    write_masks(recording / "masks", masks)
    (recording / "camera.json").write_bytes(camera.read_bytes())
    rows = [",".join(str(value) for value in (frame, *state[6:])) for frame, state in enumerate(states_of("left"))]
    (recording / "joints.csv").write_text("\n".join(["frame,q1,q2,q3", *rows]))
    track(recording, tmp_path / "b.csv", "--no-video", "--joints")
    np.testing.assert_allclose(pd.read_csv(tmp_path / "b.csv")["q1_rad"], states_of("left")[:, 6], atol=1e-12)
    assert not (tmp_path / "b.mp4").exists()


@pytest.mark.slow
def test_who_says_nothing_else_gets_the_poses_of_a_video(tmp_path: Path) -> None:
    """With the tracker and the search that are there unless told."""
    camera = Camera(width=264, height=186, fx=340.0, fy=339.0, cx=109.0, cy=88.0)
    evaluator, states = SilhouetteEvaluator([load_instrument(DRIVER)], camera), states_of("left")
    put_video(tmp_path / "seg.avi", map(evaluator.mask, states), fps=20.0)
    (tmp_path / "camera.json").write_text(camera.model_dump_json())
    surgbench("track", tmp_path / "seg.avi", "--camera", tmp_path / "camera.json", "--out", tmp_path / "poses.csv")
    poses = pd.read_csv(tmp_path / "poses.csv")
    np.testing.assert_allclose(poses["timestamp_s"], np.arange(FRAMES) / 20)
    off = np.abs(poses[["x_m", "y_m", "z_m"]].to_numpy() - states[:, 3:6])
    assert (off < [0.0005, 0.0005, 0.003]).all()
    assert not poses["lost"].any()
    assert (tmp_path / "poses.mp4").stat().st_size > 0


@pytest.mark.slow
def test_two_instruments_in_one_mask_are_tracked_as_a_pair(
    masks: list[np.ndarray], camera: Path, tmp_path: Path
) -> None:
    pairs = [mask | np.roll(mask[:, ::-1], 2, axis=1) for mask in masks]
    source = write_masks(tmp_path / "masks", pairs)
    track(source, tmp_path / "poses.csv", "--camera", camera, "--no-video", "--arms", "both")
    poses = pd.read_csv(tmp_path / "poses.csv")
    assert poses.groupby("arm")["frame"].apply(list).to_dict() == {
        arm: list(range(FRAMES)) for arm in ("left", "right")
    }


def test_what_is_interrupted_leaves_nothing_and_says_so(
    camera: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("surgbench.cli.tracking.Tracking.read", interrupted)
    before = sorted(tmp_path.iterdir())
    surgbench("track", tmp_path, "--camera", camera, "--out", tmp_path / "poses.csv", expect=130)
    said = capsys.readouterr().err.splitlines()[-1]
    assert said == "surgbench: interrupted; the same command again begins anew, nothing is left"
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.slow
def test_what_is_wrong_is_one_line_and_leaves_nothing(
    masks: list[np.ndarray], camera: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write_masks(tmp_path / "masks", masks)
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("no video")
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    wrong = {**json.loads(camera.read_text()), "width": 640}
    (tmp_path / "wrong.json").write_text(json.dumps(wrong))
    pictures = [np.full((62, 88, 3), 100, np.uint8)] * 3
    write_video(tmp_path / "pictures.mp4", pictures, 10.0)
    before = {path.name for path in tmp_path.iterdir()}
    out = tmp_path / "poses.csv"
    given = ("--camera", camera, "--no-video")
    for arguments, words in (
        ((source, out, "--no-video"), "--camera FILE"),
        ((source, out, "--camera", tmp_path / "none.json"), "none.json"),
        ((source, out, "--camera", tmp_path / "wrong.json"), "another aspect ratio"),
        ((tmp_path / "empty", out, *given), "missing; expected a folder of masks"),
        ((tmp_path / "notes.txt", out, *given), "must be a folder, a video"),
        ((tmp_path / "broken.mp4", out, *given), "not a video that can be decoded"),
        ((tmp_path / "pictures.mp4", out, *given), "no instrument in any of 3 masks"),
        ((source, tmp_path / "poses", *given), "must end in .csv"),
        ((source, out, *given, "--tracker", "hybird"), "did you mean 'hybrid'"),
        ((source, out, *given, "--instrument", "large_needle"), "large_needle_driver"),
        ((source, out, *given, "--joints"), "no joint readings"),
        ((source, out, *given, "--tracker", f"{STRANGERS}:Raises"), "frame 1: RuntimeError: no instrument anywhere"),
    ):
        capsys.readouterr()
        track(*arguments, expect=2)
        error = [line for line in capsys.readouterr().err.splitlines() if line.startswith("surgbench:")]
        assert len(error) == 1
        assert words in error[0], (words, error[0])
        assert "recording/" not in error[0]
        assert {path.name for path in tmp_path.iterdir()} == before


@pytest.mark.slow
def test_a_camera_s_video_is_tracked_by_masks_made_of_it(
    masks: list[np.ndarray], camera: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    put_video(tmp_path / "suturing.avi", map(paint, masks))
    bright = ("--masks", f"{MASK_MAKERS}:Bright")
    track(tmp_path / "suturing.avi", tmp_path / "poses.csv", "--camera", camera, *bright, "--no-video")
    # The pictures are painted with the masks, so that nothing differs from tracking these.
    track(write_masks(tmp_path / "suturing", masks), tmp_path / "given.csv", "--camera", camera, "--no-video")
    made, given = (pd.read_csv(tmp_path / name).drop(columns="latency_ms") for name in ("poses.csv", "given.csv"))
    assert len(made) == FRAMES
    pd.testing.assert_frame_equal(made, given)
    capsys.readouterr()
    track(tmp_path / "suturing.avi", tmp_path / "x.csv", "--camera", camera, *bright, "--jaw", "half", expect=2)
    assert "--jaw: is for recordings with masks, not for --masks" in capsys.readouterr().err
