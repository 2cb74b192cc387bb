"""A recording's video as images, with masks beside it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from commandline import surgbench
from others import CAMERA, HEIGHT, WIDTH, bar, grey, imported, put, put_camera, put_video, refused

FRAMES = 6


@pytest.fixture
def source(tmp_path: Path) -> Path:
    put_camera(tmp_path / "rec")
    put_video(tmp_path / "rec/suturing.avi", map(grey, range(FRAMES)), fps=20.0)
    return tmp_path / "rec"


def brightness(picture: np.ndarray | None) -> float:
    assert picture is not None
    return float(picture.mean())


def test_frames_become_images_at_their_times(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset = imported("video", source, out=tmp_path / "data")
    sequence = dataset.sequences[0]
    assert (dataset.name, sequence.camera, sequence.arms, sequence.entry.kinds) == ("suturing", CAMERA, ("left",), ())
    assert sequence.dt_s == pytest.approx(0.05)
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(FRAMES) / 20)
    for frame in range(FRAMES):
        assert brightness(sequence.image(frame)) == pytest.approx(20 + 10 * frame, abs=2)
    capsys.readouterr()
    surgbench("run", "--dataset", tmp_path / "data", "--tracker", "hybrid", "--out", tmp_path / "runs", expect=2)
    assert "has no masks; import it again with --masks, or have them made from its images" in capsys.readouterr().err


def test_a_video_of_masks_beside_it(source: Path, tmp_path: Path) -> None:
    put_video(source / "masks.avi", map(bar, range(FRAMES)))
    sequence = imported("video", source / "suturing.avi", "--arms", "right", out=tmp_path / "data").sequences[0]
    assert sequence.entry.kinds == ("right",)
    for frame in range(FRAMES):
        assert np.array_equal(sequence.mask("right", frame), bar(frame))
    short = tmp_path / "short.avi"
    put_video(short, map(bar, range(FRAMES - 1)))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        surgbench("import", "video", source, "--masks", short, "--out", tmp_path / "other", expect=2)
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(("first", "option"), [(0, ()), (1, ("--masks-from", 1))])
def test_masks_of_some_frames_keep_those_frames(
    source: Path, tmp_path: Path, first: int, option: tuple[object]
) -> None:
    for frame in (1, 3):
        put(tmp_path / f"seg/{frame + first:04d}.png", 255 * bar(frame).astype(np.uint8))
    sequence = imported("video", source, "--masks", tmp_path / "seg", *option, out=tmp_path / "data").sequences[0]
    assert sequence.entry.source_frames == ("000001", "000003")
    np.testing.assert_allclose(sequence.timestamps_s, [0.0, 0.1])
    assert [brightness(sequence.image(k)) for k in range(2)] == pytest.approx([30, 50], abs=2)
    assert np.array_equal(sequence.mask("left", 1), bar(3))


def test_masks_that_count_from_one_to_the_last_are_understood(source: Path, tmp_path: Path) -> None:
    for frame in range(FRAMES):
        put(tmp_path / f"seg/{frame + 1:04d}.png", 255 * bar(frame).astype(np.uint8))
    sequence = imported("video", source, "--masks", tmp_path / "seg", "--every", 2, out=tmp_path / "data").sequences[0]
    assert sequence.entry.source_frames == ("000000", "000002", "000004")
    assert sequence.dt_s == pytest.approx(0.1)
    assert np.array_equal(sequence.mask("left", 1), bar(2))


def test_two_arms_of_a_label_map(source: Path, tmp_path: Path) -> None:
    for frame in range(FRAMES):
        put(source / f"masks/{frame}.png", bar(frame).astype(np.uint8) + 2 * bar(frame, 30).astype(np.uint8))
    told = ("--instances", "2=left,1=right")
    sequence = imported("video", source, *told, out=tmp_path / "data").sequences[0]
    assert sequence.entry.kinds == ("left", "right", "both")
    assert np.array_equal(sequence.mask("left", 2), bar(2, 30))
    assert np.array_equal(sequence.mask("both", 2), bar(2) | bar(2, 30))


def test_what_does_not_fit_is_one_line_with_the_option(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "data"
    put_video(tmp_path / "seg.avi", map(bar, range(FRAMES - 1)))
    line = refused(capsys, "video", source, "--masks", tmp_path / "seg.avi", out=out)
    assert f"has {FRAMES - 1} frames, the recording {FRAMES}" in line
    put(tmp_path / "far/000009.png", 255 * bar(0).astype(np.uint8))
    line = refused(capsys, "video", source, "--masks", tmp_path / "far", out=out)
    assert "no frame 9" in line
    assert "--masks-from" in line
    assert "--masks names a folder" in refused(capsys, "video", source, "--masks", tmp_path / "no", out=out)
    wide = put_camera(tmp_path / "wide", CAMERA.model_copy(update={"width": 2 * WIDTH}))
    assert f"{2 * WIDTH}x{HEIGHT}" in refused(capsys, "video", source, "--camera", wide, out=out)
    (source / "camera.json").unlink()
    assert "--camera FILE" in refused(capsys, "video", source, out=out)
    put_video(source / "second.avi", map(grey, range(2)))
    assert "say which is the recording: import video FILE" in refused(capsys, "video", source, out=out)
    (tmp_path / "cut.mp4").write_bytes(b"\0" * 100)
    assert "not a video that can be decoded" in refused(capsys, "video", tmp_path / "cut.mp4", out=out)


def test_a_frame_that_cannot_be_decoded_is_told(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shots = (np.random.default_rng(k).random((HEIGHT, WIDTH)) > 0.5 for k in range(20))
    put_video(source / "suturing.avi", shots, codec="MJPG")
    content = (source / "suturing.avi").read_bytes()
    # The begin of the last frame but one's own data, behind its tag and size (the first tag is in the head): decoders
    # give up there.
    begin = [found.start() for found in re.finditer(b"00dc", content)][19] + 8
    (source / "suturing.avi").write_bytes(content[:begin] + b"\0" * 2000 + content[begin + 2000 :])
    surgbench("import", "video", source, "--out", tmp_path / "data")
    said = capsys.readouterr().err
    assert "warning: suturing.avi: 18 frames can be decoded, the file claims 20" in said
