"""Masks as a video: MP4, AVI, MKV and what else OpenCV's FFmpeg decodes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray

VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg")
# Containers tell their number of frames, some roughly. With fewer than this share a file was cut off.
_WHOLE = 0.9


class MaskVideo:
    """A video of masks; see :class:`surgbench.recordings.survey.MaskSource`. It is read as often as it is asked for.

    Args:
        path: The file.
        size: Width and height that it must have, pixels; its own unless told.

    Attributes:
        doubt: One line where the file claims a few frames more than can be decoded; many more are refused.

    Raises:
        DatasetError: It is missing, no video, of another size, cut off, or a frame inside it cannot be decoded; one
            line.
    """

    doubt: str | None

    def __init__(self, path: Path, size: tuple[int, int] | None = None) -> None:
        self.place = path
        self._wanted = size
        self.lossy: str | None = "video"
        self.several: str | None = None
        capture = self._open()
        self.size: tuple[int, int] = _size(capture)
        claimed, rate = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
        times = []
        while capture.grab():
            times.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3)
        capture.release()
        if not times or len(times) < _WHOLE * claimed:
            raise DatasetError(f"{path}: truncated or damaged video ({len(times)} of {claimed:.0f} frames)")
        missing = _first_missing(np.array(times), rate) if len(times) < claimed else None
        if missing is not None:
            raise DatasetError(f"{path}: frame {missing} cannot be decoded ({len(times)} of {claimed:.0f} frames can)")
        self.doubt = None
        if len(times) < claimed:
            self.doubt = (
                f"{path.name}: {len(times)} frames can be decoded, the file claims {claimed:.0f}; if some are damaged, "
                "whatever counts frames beside it is out of step from there on"
            )
        self.numbers = list(range(len(times)))
        self.names = [f"{number:06d}" for number in self.numbers]
        self.times_s: FloatArray | None = _regular(np.array(times), rate)

    def pictures(self) -> Iterator[NDArray[Any]]:
        """Each frame as it is decoded, ``(height, width, 3)`` uint8 BGR."""
        capture = self._open()
        try:
            for number in self.numbers:
                whole, picture = capture.read()
                if not whole:
                    raise DatasetError(f"{self.place}: frame {number} cannot be decoded")
                if picture.shape[1::-1] != self.size:
                    raise DatasetError(self._wrong_size(*picture.shape[1::-1]))
                yield picture
        finally:
            capture.release()

    def _open(self) -> cv2.VideoCapture:
        if not self.place.is_file():
            raise DatasetError(f"{self.place}: missing")
        with _quiet():
            capture = cv2.VideoCapture(str(self.place), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            raise DatasetError(f"{self.place}: not a video that can be decoded, or truncated")
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # masks are of the sensor's grid
        found = _size(capture)
        if self._wanted not in (None, found):
            capture.release()
            raise DatasetError(self._wrong_size(*found))
        return capture

    def _wrong_size(self, width: int, height: int) -> str:
        wanted = self._wanted or self.size
        return f"{self.place}: is {width}x{height} pixels, not {wanted[0]}x{wanted[1]}"


@contextmanager
def _quiet() -> Iterator[None]:
    """What FFmpeg and OpenCV print of a damaged file is said in one line of our own."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # it is read when the first video is opened
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _size(capture: cv2.VideoCapture) -> tuple[int, int]:
    return int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))


def _first_missing(times_s: FloatArray, rate: float) -> int | None:
    """Number of the first frame that was passed over, by the gap that it leaves; ``None`` where there is none.

    Args:
        times_s: Of the frames that can be decoded.
        rate: Frames per second that the file claims.
    """
    if not (np.isfinite(rate) and rate > 0) or len(times_s) < 2:
        return None
    gaps = np.flatnonzero(np.diff(times_s) * rate >= 1.5)
    return int(gaps[0]) + 1 if len(gaps) else None


def _regular(times_s: FloatArray, rate: float) -> FloatArray | None:
    """Times since the first frame, even where the file's ticks tell no more; ``None`` where it tells none."""
    if not (np.isfinite(rate) and rate > 0):
        return times_s - times_s[0] if (np.diff(times_s) > 0).all() else None
    even = np.arange(len(times_s)) / rate
    told: FloatArray = times_s - times_s[0]
    # Milliseconds are the coarsest ticks of usual containers.
    if not (np.diff(told) > 0).all() or np.abs(told - even).max() <= 1.5e-3:
        return np.asarray(even)
    return told
