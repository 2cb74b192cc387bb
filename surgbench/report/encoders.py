"""What writes videos: H.264, which everything plays, where there is an encoder; else VP9, which browsers play too."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from surgbench.errors import SurgbenchError
from surgbench.report.drawing import Picture

# Constant quality of x264: 18 is taken for visually lossless.
QUALITY = "18"
# Of a second that a frame's time is told in: 29.97 frames a second are 30000/1001.
MOST_PARTS = 1001
VP9, MPEG4 = "vp09", "mp4v"
NOT_PLAYED = (
    "videos are MPEG-4 Part 2 (mp4v), which browsers and VS Code do not play; for H.264: pip install 'surgbench[video]'"
)


class Encoder(Protocol):
    """Takes pictures of one even size and puts them into an MP4 file.

    Args:
        path: Ends in ``.mp4``.
        width: Pixels, even.
        height: The same.
        fps: Frames per second.

    Raises:
        SurgbenchError: It cannot be opened.
    """

    def __init__(self, path: Path, width: int, height: int, fps: float) -> None: ...

    def write(self, picture: Picture) -> None:
        """Append a picture, ``(height, width, 3)`` uint8 RGB."""
        ...

    def close(self) -> None:
        """Finish the file; once more does nothing."""
        ...


class H264Encoder:
    """H.264 by PyAV (extra ``video``), 4:2:0, its index at the beginning, so that browsers play it while it loads."""

    def __init__(self, path: Path, width: int, height: int, fps: float) -> None:
        import av

        self._av: Any = av
        try:
            self._file = av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"})
            self._stream = self._file.add_stream("libx264", rate=Fraction(fps).limit_denominator(MOST_PARTS))
        except (av.FFmpegError, ValueError) as error:
            raise SurgbenchError(f"{path}: cannot be written (PyAV: {error})") from None
        self._open = True
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = "yuv420p"
        # One thread, so that bytes do not depend on the machine.
        self._stream.options = {"crf": QUALITY, "threads": "1"}

    def write(self, picture: Picture) -> None:
        """Append a picture, ``(height, width, 3)`` uint8 RGB."""
        self._encode(self._av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24"))

    def close(self) -> None:
        """Finish the file; once more does nothing."""
        if self._open:
            self._open = False
            try:
                self._encode(None)
            finally:
                self._file.close()

    def _encode(self, frame: Any) -> None:
        """Write what comes of a frame; ``None`` ends the stream."""
        try:
            for packet in self._stream.encode(frame):
                self._file.mux(packet)
        except self._av.FFmpegError as error:  # as of any other writer
            raise OSError(error.errno, error.strerror) from None


class OpenCVEncoder:
    """VP9 by OpenCV, whose wheels have no encoder for H.264; where its build has none for VP9 either, MPEG-4 Part 2."""

    def __init__(self, path: Path, width: int, height: int, fps: float) -> None:
        codec = VP9 if has_vp9() else MPEG4
        self._writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, (width, height))
        if not self._writer.isOpened():
            raise SurgbenchError(f"{path}: cannot be written (OpenCV could not open it for MP4 video)")

    def write(self, picture: Picture) -> None:
        """Append a picture, ``(height, width, 3)`` uint8 RGB."""
        self._writer.write(picture[..., ::-1])

    def close(self) -> None:
        """Finish the file; once more does nothing."""
        self._writer.release()


@cache
def has_h264() -> bool:
    """Whether there is an encoder for H.264: PyAV, built with x264."""
    if find_spec("av") is None:
        return False
    try:
        import av

        return "libx264" in av.codecs_available
    except ImportError:  # a library that it is built with is missing
        return False


@cache
def has_vp9() -> bool:
    """Whether OpenCV has an encoder for VP9."""
    with tempfile.TemporaryDirectory() as folder:
        writer = cv2.VideoWriter(str(Path(folder, "a.mp4")), cv2.VideoWriter.fourcc(*VP9), 30.0, (64, 48))
        found = writer.isOpened()
        writer.release()
    return found


def browsers_play() -> bool:
    """Whether videos are such as browsers play."""
    return has_h264() or has_vp9()


def best_encoder() -> Callable[[Path, int, int, float], Encoder]:
    """What opens a video for writing: H.264 where it can be had."""
    return H264Encoder if has_h264() else OpenCVEncoder


def codec_note() -> str | None:
    """One line for the user where videos will not play in browsers; else ``None``."""
    return None if browsers_play() else NOT_PLAYED
