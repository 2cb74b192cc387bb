"""Contours, labels and panels: what the videos, contact sheets and sample pictures are made of.

Pictures are ``(height, width, 3)`` uint8 RGB.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.contract import Mask
from surgbench.errors import SurgbenchError
from surgbench.files import write_atomic
from surgbench.geometry import FloatArray

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]

REFERENCE_COLOUR: Colour = (60, 220, 60)
# Apart from each other and from the green reference, also for colour-blind eyes.
ESTIMATE_COLOURS: tuple[Colour, ...] = (
    (255, 80, 200),
    (255, 150, 30),
    (80, 170, 255),
    (250, 235, 80),
    (180, 120, 255),
    (255, 255, 255),
)
BACKGROUND_GREY, MASK_GREY = 26, 104
TINT = 0.4  # share of the colour where a mask is laid over a picture
PAPER: Colour = (255, 255, 255)
INK: Colour = (20, 20, 20)

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_FONT_HEIGHT = 21  # of capitals at scale 1
_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates
_FINER = 4  # contours are found on a grid finer by this
_SMOOTHING_PX = 0.6


def grey(mask: Mask) -> Picture:
    """A mask as a picture: grey on dark grey."""
    shade = np.where(mask, MASK_GREY, BACKGROUND_GREY).astype(np.uint8)
    return np.repeat(shade[..., None], 3, axis=2)


def scaled(picture: Picture, scale: float) -> Picture:
    """The picture at another size."""
    if scale == 1.0:
        return picture.copy()
    size = scaled_size(picture.shape[1], picture.shape[0], scale)
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(picture, size, interpolation=how), dtype=np.uint8)


def scaled_size(width: int, height: int, scale: float) -> tuple[int, int]:
    """Width and height after :func:`scaled`."""
    return max(1, round(width * scale)), max(1, round(height * scale))


def contours(mask: Mask) -> list[FloatArray]:
    """Smooth outlines of a mask, holes included.

    Args:
        mask: ``(H, W)`` bool.

    Returns:
        Closed polygons ``(n, 2)`` in pixels (u, v), centres at integer coordinates.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return []
    top, left = int(rows[0]), int(columns[0])
    # A border, since a contour needs an outside.
    part = np.pad(mask[top : rows[-1] + 1, left : columns[-1] + 1], 3).astype(np.uint8) * 255
    fine = cv2.resize(part, None, fx=_FINER, fy=_FINER, interpolation=cv2.INTER_LINEAR)
    fine = cv2.GaussianBlur(fine, (0, 0), _SMOOTHING_PX * _FINER)
    found, _ = cv2.findContours((fine > 127).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    origin = np.array([left - 3, top - 3], dtype=np.float64)
    return [(polygon[:, 0, :].astype(np.float64) + 0.5) / _FINER - 0.5 + origin for polygon in found]


def draw_contours(
    picture: Picture, mask: Mask, colour: Colour, thickness: int, scale: float = 1.0, origin: tuple[int, int] = (0, 0)
) -> None:
    """Draw the outline of a mask, anti-aliased, into a picture of it.

    Args:
        picture: Drawn into.
        mask: ``(H, W)`` bool.
        colour: Of the line.
        thickness: Of the line, pixels of the picture.
        scale: Pixels of the picture per pixel of the mask.
        origin: (u, v) of the mask's pixel in the picture's upper left corner.
    """
    polygons = [_fixed_point((polygon + 0.5 - origin) * scale - 0.5) for polygon in contours(mask)]
    if polygons:
        cv2.polylines(picture, polygons, True, colour, thickness, cv2.LINE_AA, _SHIFT)


def tint(picture: Picture, mask: Mask, colour: Colour) -> None:
    """Lay a mask over a picture, half transparent.

    Args:
        picture: Drawn into.
        mask: ``(h, w)`` bool, of another size than the picture's where that shows it scaled.
        colour: Of the mask.
    """
    height, width = picture.shape[:2]
    cover = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)[..., None] * TINT
    picture[:] = np.rint(picture * (1.0 - cover) + cover * np.array(colour, np.float32)).astype(np.uint8)


def draw_dots(picture: Picture, points: FloatArray, colour: Colour, radius: int) -> None:
    """Draw dots with a dark rim, anti-aliased, at ``(n, 2)`` pixels of the picture; those far outside are left out."""
    size = np.array([picture.shape[1], picture.shape[0]])
    for point in points[(np.abs(points - size / 2) < size).all(axis=1)]:
        centre = _fixed_point(point).tolist()
        for wide, shade in ((radius + 1, INK), (radius, colour)):
            cv2.circle(picture, centre, wide << _SHIFT, shade, cv2.FILLED, cv2.LINE_AA, _SHIFT)


def draw_segments(picture: Picture, segments: FloatArray, colour: Colour, thickness: int) -> None:
    """Draw anti-aliased line segments, ``(n, 2, 2)`` pixels of the picture; parts outside are cut off."""
    height, width = picture.shape[:2]
    for segment in segments:
        # Far ends would overflow OpenCV's integers.
        inside = clip_segment(segment, (-1.0 * width, -1.0 * height), (2.0 * width, 2.0 * height))
        if inside is not None:
            start, end = _fixed_point(inside).tolist()
            cv2.line(picture, start, end, colour, thickness, cv2.LINE_AA, _SHIFT)


def clip_segment(segment: FloatArray, low: tuple[float, float], high: tuple[float, float]) -> FloatArray | None:
    """The part of a segment ``(2, 2)`` inside a box (Liang and Barsky's rule); ``None`` if there is none."""
    start, along = segment[0], segment[1] - segment[0]
    enter, leave = 0.0, 1.0
    for axis in range(2):
        if not np.isfinite(along[axis]):
            return None
        if along[axis] == 0:
            if not low[axis] <= start[axis] <= high[axis]:
                return None
            continue
        first, last = sorted(((low[axis] - start[axis]) / along[axis], (high[axis] - start[axis]) / along[axis]))
        enter, leave = max(enter, first), min(leave, last)
    return start + np.array([[enter], [leave]]) * along if enter <= leave else None


def _fixed_point(points: FloatArray) -> NDArray[np.int32]:
    return np.round(points * (1 << _SHIFT)).astype(np.int32)


def text_size(text: str, height_px: int) -> tuple[int, int]:
    """Width and height of a text whose capitals are ``height_px`` high, pixels."""
    (width, height), _ = cv2.getTextSize(_plain(text), _FONT, height_px / _FONT_HEIGHT, _stroke(height_px))
    return width, height


def write_text(picture: Picture, text: str, left: int, bottom: int, height_px: int, colour: Colour = INK) -> None:
    """Write a line of text with its baseline's left end at (left, bottom)."""
    scale = height_px / _FONT_HEIGHT
    cv2.putText(picture, _plain(text), (left, bottom), _FONT, scale, colour, _stroke(height_px), cv2.LINE_AA)


def write_note(picture: Picture, text: str, height_px: int) -> None:
    """Write a line of text on a dark ground into the lower left corner."""
    if text:
        note = strip(text_size(text, height_px)[0] + height_px, 2 * height_px, (0, 0, 0))[:, : picture.shape[1]]
        write_text(note, text, height_px // 2, round(1.5 * height_px), height_px, PAPER)
        picture[-note.shape[0] :, : note.shape[1]] = note


def fit_text(text: str, height_px: int, width: int) -> str:
    """The text, shortened at its end so that it is at most ``width`` pixels wide."""
    if text_size(text, height_px)[0] <= width:
        return text
    while text and text_size(f"{text}..", height_px)[0] > width:
        text = text[:-1]
    return f"{text}.."


def _stroke(height_px: int) -> int:
    return 1 if height_px < 18 else 2


def _plain(text: str) -> str:
    # OpenCV's fonts have no other characters.
    return text.encode("ascii", "replace").decode()


def strip(width: int, height: int, colour: Colour = PAPER) -> Picture:
    """A picture of one colour."""
    return np.full((height, width, 3), colour, dtype=np.uint8)


def heading(text: str, width: int, height_px: int, colour: Colour = INK, centred: bool = True) -> Picture:
    """A strip with one line of text."""
    picture = strip(width, round(1.9 * height_px))
    text = fit_text(text, height_px, width - 4)
    left = (width - text_size(text, height_px)[0]) // 2 if centred else height_px // 2
    write_text(picture, text, left, round(1.45 * height_px), height_px, colour)
    return picture


def legend(entries: Sequence[tuple[str, Colour]], width: int, height_px: int) -> Picture:
    """Strips that explain colours: a line in each colour and what it means, in as many lines as it takes."""
    sample, gap = 3 * height_px, height_px
    lines: list[list[tuple[str, Colour, int]]] = [[]]
    left = gap
    for text, colour in entries:
        needed = sample + gap // 2 + text_size(text, height_px)[0] + 2 * gap
        if lines[-1] and left + needed > width:
            lines.append([])
            left = gap
        lines[-1].append((text, colour, left))
        left += needed
    line_height = 2 * height_px
    picture = strip(width, line_height * len(lines))
    for number, line in enumerate(lines):
        bottom = number * line_height + round(1.5 * height_px)
        middle = bottom - height_px // 2
        for text, colour, left in line:
            # Light colours are for dark pictures: they need a dark ground here, too.
            box = (left, middle - height_px // 2 - 1), (left + sample, middle + height_px // 2 + 1)
            cv2.rectangle(picture, *box, (BACKGROUND_GREY,) * 3, cv2.FILLED)
            ends = (left + 3, middle), (left + sample - 3, middle)
            cv2.line(picture, *ends, colour, max(2, height_px // 5), cv2.LINE_AA)
            room = width - left - sample - gap // 2
            write_text(picture, fit_text(text, height_px, room), left + sample + gap // 2, bottom, height_px)
    return picture


def side_label(text: str, height: int, height_px: int) -> Picture:
    """A strip as high as a row of panels with a line of text that reads upwards."""
    return np.ascontiguousarray(np.rot90(heading(text, height, height_px)))


def beside(pictures: Sequence[Picture], gap: int = 0) -> Picture:
    """Pictures of one height in a row."""
    return _joined(pictures, gap, axis=1)


def below(pictures: Sequence[Picture], gap: int = 0) -> Picture:
    """Pictures of one width in a column."""
    return _joined(pictures, gap, axis=0)


def _joined(pictures: Sequence[Picture], gap: int, axis: int) -> Picture:
    parts: list[Picture] = []
    for picture in pictures:
        if parts and gap:
            height, width = parts[0].shape[:2]
            parts.append(strip(gap, height) if axis == 1 else strip(width, gap))
        parts.append(picture)
    return np.concatenate(parts, axis=axis)


def save_png(path: Path, picture: Picture) -> None:
    """Write a picture.

    Raises:
        SurgbenchError: The file cannot be written.
    """
    done, data = cv2.imencode(".png", picture[..., ::-1])
    try:
        if not done:
            raise OSError(None, "no PNG encoder")
        write_atomic(path, data.tobytes())
    except OSError as error:
        raise SurgbenchError(f"{path}: cannot be written ({error.strerror})") from None
