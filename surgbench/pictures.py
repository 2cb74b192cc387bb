"""The one reader of pictures: PNG and JPEG of any depth, as they lie on the sensor's grid.

Whatever is wrong with a file is one line. Its header is looked at before anything is decoded, so that no file takes
more memory than its size is allowed. Bytes after a picture's end are passed over, as all viewers do. Orientation tags
are never followed: masks, cameras and images are of the sensor's grid.
"""

from __future__ import annotations

import re
import zlib
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.errors import DatasetError

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_SIGNATURE = b"\xff\xd8\xff"
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
# As many pixels on a side as a camera may have.
MAX_SIDE = 16384

# JPEG: the markers that hold a size, those without a length, and the next marker in entropy-coded data, where 0xFF00 is
# a byte, 0xFFD0 to 0xFFD7 are restarts, and 0xFFFF is filling.
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_BARE = frozenset((0x01, *range(0xD0, 0xD9)))
_NEXT_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_SCAN, _END = 0xDA, 0xD9


class _Outline(NamedTuple):
    """What a file says before it is decoded."""

    kind: str
    width: int
    height: int
    end: int | None
    """Where the picture ends; ``None`` where the file does before."""


def is_jpeg(data: bytes) -> bool:
    """Whether a file's first bytes are those of a JPEG, whatever it is called."""
    return data.startswith(JPEG_SIGNATURE)


def decode_picture(
    data: bytes, name: str, width: int | None = None, height: int | None = None, owner: str = "its camera has"
) -> NDArray[Any]:
    """Decode a PNG or JPEG file.

    Args:
        data: The whole file.
        name: For the message.
        width: What it has to be, pixels; any size up to :data:`MAX_SIDE` unless told.
        height: Likewise.
        owner: Who says so, for the message.

    Returns:
        ``(height, width)`` or ``(height, width, channels)`` uint8 or uint16: grey, BGR or BGRA. Colours of a palette
        are put in; grey with alpha is BGRA.

    Raises:
        DatasetError: It is empty, truncated, damaged, another kind of file, or of another size; one line that names it.
    """
    outline = _known_outline(data, name)
    size = (outline.width, outline.height)
    if width is not None and height is not None and outline.width and size != (width, height):
        raise DatasetError(f"{name}: is {size[0]}x{size[1]} pixels; {owner} {width}x{height}")
    _check_side(outline, name)
    picture = None
    # Decoders fill in what is missing of a truncated file and say nothing.
    if outline.end is not None and outline.width and outline.height:
        try:
            picture = cv2.imdecode(np.frombuffer(data, np.uint8, outline.end), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            picture = None
    if picture is None or picture.shape[1::-1] != size or picture.dtype not in (np.uint8, np.uint16):
        raise DatasetError(f"{name}: truncated or damaged {outline.kind}")
    return np.asarray(picture)


def stated_size(data: bytes, name: str) -> tuple[int, int]:
    """Width and height that the header of a PNG or JPEG file says.

    Args:
        data: The whole file.
        name: For the message.

    Raises:
        DatasetError: It is empty, another kind of file, or larger than is read; one line.
    """
    outline = _known_outline(data, name)
    _check_side(outline, name)
    return outline.width, outline.height


def as_rgb(picture: NDArray[Any]) -> NDArray[np.uint8]:
    """A decoded picture as ``(height, width, 3)`` uint8 RGB; an alpha channel is left out."""
    if picture.dtype == np.uint16:
        picture = (picture // np.uint16(257)).astype(np.uint8)
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=2)
    return np.ascontiguousarray(picture[..., 2::-1], dtype=np.uint8)


def _known_outline(data: bytes, name: str) -> _Outline:
    outline = _outline(data)
    if outline is None:
        what = "not a PNG or JPEG file" if data else "empty file; expected a PNG or JPEG"
        raise DatasetError(f"{name}: {what}")
    return outline


def _check_side(outline: _Outline, name: str) -> None:
    if max(outline.width, outline.height) > MAX_SIDE:
        raise DatasetError(
            f"{name}: is {outline.width}x{outline.height} pixels; at most {MAX_SIDE}x{MAX_SIDE} are read"
        )


def _outline(data: bytes) -> _Outline | None:
    """What a PNG's or JPEG's header says; ``None`` for another kind of file."""
    if data.startswith(PNG_SIGNATURE):
        width, height = (int.from_bytes(data[at : at + 4], "big") for at in (16, 20))
        return _Outline("PNG", width, height, _png_end(data))
    return _jpeg_outline(data) if is_jpeg(data) else None


def _png_end(data: bytes) -> int | None:
    """Where the last chunk ends; ``None`` where one is cut off, or one that matters has another checksum."""
    at = len(PNG_SIGNATURE)
    while at + 12 <= len(data):
        kind = data[at + 4 : at + 8]
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if end > len(data):
            return None
        critical = kind[:1].isupper()
        if critical and zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return None
        if kind == b"IEND":
            return end
        at = end
    return None


def _jpeg_outline(data: bytes) -> _Outline:
    at, width, height, end = 2, 0, 0, None
    while at + 2 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # filling
            at += 1
            continue
        if marker == _END:
            end = at + 2
            break
        if marker in _BARE:
            at += 2
            continue
        following = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if marker in _FRAMES and at + 9 <= len(data):
            height, width = (int.from_bytes(data[place : place + 2], "big") for place in (at + 5, at + 7))
        if marker == _SCAN:
            found = _NEXT_MARKER.search(data, following)
            if found is None:
                break
            following = found.start()
        at = following
    return _Outline("JPEG", width, height, end)
