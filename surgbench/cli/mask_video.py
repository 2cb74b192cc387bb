"""Masks from a video of masks."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from surgbench.cli.progress import progress
from surgbench.errors import DatasetError

VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".webm")
# White is above this, of 255.
THRESHOLD = 127
# Lossy codecs blur edges; a picture has far more pixels that are neither black nor white.
BETWEEN, MOST_BETWEEN = (48, 208), 0.1


def extract_masks(video: Path, folder: Path) -> float:
    """Write every frame of a video of masks as a PNG of black and white.

    Args:
        video: White is instrument.
        folder: Is made.

    Returns:
        Frames per second.

    Raises:
        DatasetError: It cannot be read, or is a video of pictures.
    """
    capture = cv2.VideoCapture(str(video))
    try:
        if not capture.isOpened():
            raise DatasetError(f"{video}: cannot be read as a video")
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # masks are of the sensor's grid
        fps = capture.get(cv2.CAP_PROP_FPS)
        folder.mkdir(parents=True)
        frame = 0
        with progress("reading the video", max(1.0, capture.get(cv2.CAP_PROP_FRAME_COUNT))) as advance:
            while (read := capture.read())[0]:
                grey = np.asarray(read[1]).max(axis=2)
                between = float(np.mean((grey > BETWEEN[0]) & (grey < BETWEEN[1])))
                if between > MOST_BETWEEN:
                    raise DatasetError(
                        f"{video}: frame {frame}: {100 * between:.0f} % of it is neither black nor white, as of a "
                        "picture; expected a video of masks, white on black (segment the pictures first)"
                    )
                mask = np.where(grey > THRESHOLD, 255, 0).astype(np.uint8)
                (folder / f"{frame:06d}.png").write_bytes(cv2.imencode(".png", mask)[1].tobytes())
                frame += 1
                advance(1)
    finally:
        capture.release()
    if not frame:
        raise DatasetError(f"{video}: holds no frame that can be read")
    return fps if np.isfinite(fps) and fps > 0 else 30.0
