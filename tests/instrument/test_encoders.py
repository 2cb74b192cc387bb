"""Videos that browsers play where there is an encoder, and a line that says so where there is none."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from surgbench.errors import SurgbenchError
from surgbench.report import encoders
from surgbench.report.drawing import Picture
from surgbench.report.movie import write_video


def pictures(count: int) -> list[Picture]:
    """Red that becomes lighter."""
    made = []
    for number in range(count):
        picture = np.zeros((48, 64, 3), np.uint8)
        picture[..., 0] = 100 + 20 * number
        made.append(picture)
    return made


def look_at(path: Path) -> tuple[str, list[np.ndarray], float]:
    """Codec, frames (RGB) and rate of a video."""
    capture = cv2.VideoCapture(str(path))
    codec = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode()
    rate = capture.get(cv2.CAP_PROP_FPS)
    frames = []
    while (read := capture.read())[0]:
        frames.append(np.asarray(read[1])[..., ::-1])
    return codec, frames, rate


@pytest.mark.extras
def test_videos_are_h264_with_their_index_first(tmp_path: Path) -> None:
    pytest.importorskip("av")
    assert encoders.codec_note() is None
    write_video(tmp_path / "a.mp4", pictures(5), 29.97)
    codec, frames, rate = look_at(tmp_path / "a.mp4")
    assert codec in ("h264", "avc1")
    assert len(frames) == 5
    assert rate == pytest.approx(29.97)
    for number, frame in enumerate(frames):
        assert frame[24, 32, 0] == pytest.approx(100 + 20 * number, abs=6)
        assert frame[24, 32, 1:].max() < 12
    data = (tmp_path / "a.mp4").read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")  # played while it loads


@pytest.mark.extras
def test_the_same_pictures_are_the_same_bytes(tmp_path: Path) -> None:
    pytest.importorskip("av")
    for name in ("a", "b"):
        write_video(tmp_path / f"{name}.mp4", pictures(5), 30.0)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


@pytest.mark.extras
def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("av")

    def on_full_disk(path: Path, width: int, height: int, fps: float) -> encoders.Encoder:
        path.symlink_to("/dev/full")
        return encoders.H264Encoder(path, width, height, fps)

    monkeypatch.setattr("surgbench.report.movie.best_encoder", lambda: on_full_disk)
    with pytest.raises(SurgbenchError, match=r"a\.mp4: cannot be written"):
        write_video(tmp_path / "a.mp4", pictures(5), 30.0)
    assert list(tmp_path.iterdir()) == []


def test_without_h264_videos_are_vp9_which_browsers_play(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encoders, "has_h264", lambda: False)
    assert encoders.codec_note() is None
    write_video(tmp_path / "a.mp4", pictures(5), 29.97)
    codec, frames, rate = look_at(tmp_path / "a.mp4")
    assert (codec.lower(), len(frames)) == ("vp90", 5)
    assert rate == pytest.approx(29.97, abs=0.01)
    for number, frame in enumerate(frames):
        assert frame[24, 32, 0] == pytest.approx(100 + 20 * number, abs=6)
        assert frame[24, 32, 1:].max() < 12


def test_without_either_encoder_it_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("has_h264", "has_vp9"):
        monkeypatch.setattr(encoders, name, lambda: False)
    note = encoders.codec_note()
    assert note is not None
    assert "pip install 'surgbench[video]'" in note
    write_video(tmp_path / "a.mp4", pictures(5), 10.0)
    codec, frames, rate = look_at(tmp_path / "a.mp4")
    assert (codec, len(frames)) == ("FMP4", 5)
    assert rate == pytest.approx(10.0)
