"""Videos that are there whole or not at all, and what is asked of them."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from surgbench.errors import SurgbenchError
from surgbench.files import PARTIAL_SUFFIX
from surgbench.report.drawing import Picture
from surgbench.report.encoders import Encoder, best_encoder


def write_video(path: Path, pictures: Iterable[Picture], fps: float) -> None:
    """Write an MP4, in H.264 where there is an encoder (:mod:`surgbench.report.encoders`).

    The file is there whole or not at all.

    Raises:
        SurgbenchError: It cannot be written.
    """
    # The container is chosen by the ending.
    partial = path.with_name(f"{path.stem}.{os.getpid()}{PARTIAL_SUFFIX}{path.suffix}")
    encoder: Encoder | None = None
    written = 0
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for picture in pictures:
            if encoder is None:
                height, width = picture.shape[:2]
                encoder = best_encoder()(partial, width, height, fps)
            encoder.write(picture)
            written += 1
        if encoder is not None:
            encoder.close()
            # OpenCV does not say when a write fails, as on a full disk: see whether it is whole.
            if _frames_in(partial) != written:
                raise SurgbenchError(f"{path}: cannot be written whole (is the disk full?)")
            partial.replace(path)
    except OSError as error:
        raise SurgbenchError(f"{path}: cannot be written ({error.strerror})") from None
    finally:
        if encoder is not None:
            with contextlib.suppress(OSError):  # of a full disk, which has been said
                encoder.close()
        with contextlib.suppress(NotADirectoryError):
            partial.unlink(missing_ok=True)


def _frames_in(path: Path) -> int:
    video = cv2.VideoCapture(str(path))
    try:
        count = int(video.get(cv2.CAP_PROP_FRAME_COUNT)) if video.isOpened() else 0
    finally:
        video.release()
    return count


def spread_frames(total: int, count: int) -> list[int]:
    """``count`` frame numbers spread evenly from the first to the last (fewer where there are fewer)."""
    return sorted({round(place) for place in np.linspace(0, total - 1, min(count, total))})
