"""The one reader of pictures, and what is left over in folders."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgbench.errors import DatasetError
from surgbench.leftovers import is_leftover, without_leftovers
from surgbench.pictures import as_rgb, decode_picture

PICTURES: dict[str, Any] = {
    "grey": np.arange(30 * 40, dtype=np.uint8).reshape(30, 40),
    "colour": np.random.default_rng(0).integers(0, 255, (30, 40, 3), dtype=np.uint8),
    "alpha": np.random.default_rng(1).integers(0, 255, (30, 40, 4), dtype=np.uint8),
    "deep": np.random.default_rng(2).integers(0, 65535, (30, 40), dtype=np.uint16),
}


def encoded(picture: np.ndarray, suffix: str = ".png") -> bytes:
    return cv2.imencode(suffix, picture)[1].tobytes()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def turned(jpeg: bytes, orientation: int) -> bytes:
    """A JPEG that says in EXIF how it is to be turned."""
    entry = struct.pack(">HHIHH", 0x0112, 3, 1, orientation, 0)
    exif = b"Exif\0\0MM\0*\0\0\0\x08" + struct.pack(">H", 1) + entry + bytes(4)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]


@pytest.mark.parametrize("kind", PICTURES)
def test_what_was_written_is_read(kind: str) -> None:
    assert np.array_equal(decode_picture(encoded(PICTURES[kind]), "a.png", 40, 30), PICTURES[kind])


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@given(tail=st.binary(max_size=80), cut=st.integers(1, 100))
def test_bytes_after_the_end_do_not_matter_and_missing_ones_do(suffix: str, tail: bytes, cut: int) -> None:
    data = encoded(PICTURES["grey"], suffix)
    whole = decode_picture(data, "a")
    assert np.array_equal(decode_picture(data + tail, "a"), whole)
    with pytest.raises(DatasetError, match=r"^a: truncated or damaged (PNG|JPEG)$"):
        decode_picture(data[:-cut], "a")


def test_a_png_with_altered_bytes_is_damaged() -> None:
    data = bytearray(encoded(PICTURES["grey"]))
    data[len(data) // 2] ^= 1
    with pytest.raises(DatasetError, match="a: truncated or damaged PNG"):
        decode_picture(bytes(data), "a")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_never_followed(orientation: int) -> None:
    data = encoded(PICTURES["colour"], ".jpg")
    assert np.array_equal(decode_picture(turned(data, orientation), "a.jpg", 40, 30), decode_picture(data, "a.jpg"))


@pytest.mark.parametrize(
    ("size", "message"), [((40, 30), "camera.json says 40x30"), ((None, None), "at most 16384x16384")]
)
def test_a_size_is_refused_before_anything_is_decoded(size: tuple[Any, Any], message: str) -> None:
    """A few bytes may claim gigabytes."""
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 50000, 50000, 1, 0, 0, 0, 0))
    bomb = b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")
    with pytest.raises(DatasetError, match=rf"^b\.png: is 50000x50000 pixels; {message}"):
        decode_picture(bomb, "b.png", *size, "camera.json says")


def test_palettes_are_colours() -> None:
    rows = b"".join(b"\0" + bytes([0, 1, 2]) for _ in range(2))
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 3, 2, 8, 3, 0, 0, 0))
    palette = chunk(b"PLTE", bytes([0, 0, 0, 64, 0, 0, 0, 128, 0]))
    data = b"\x89PNG\r\n\x1a\n" + header + palette + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    assert as_rgb(decode_picture(data, "p.png"))[0].tolist() == [[0, 0, 0], [64, 0, 0], [0, 128, 0]]


@pytest.mark.parametrize(
    ("data", "message"), [(b"", "empty file"), (b"GIF89a", "not a PNG or JPEG"), (b"\xff\xd8\xff\xd9", "JPEG")]
)
def test_other_files_are_one_line(data: bytes, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        decode_picture(data, "a")


@pytest.mark.parametrize(
    "name",
    [
        ".DS_Store",
        "._000000.png",
        "Thumbs.db",
        "desktop.ini",
        "__MACOSX/x.png",
        ".ipynb_checkpoints/a.json",
        "@eaDir/b",
    ],
)
def test_what_systems_leave_is_passed_over(name: str) -> None:
    root = Path("/data/__MACOSX/set")  # names above the folder do not count
    assert is_leftover(root / name, root)
    assert list(without_leftovers([root / name, root / "000000.png"], root)) == [root / "000000.png"]


@pytest.mark.parametrize("name", ["000000.png", "dataset.json", "icon.png", ".hidden", "thumbs/a.png"])
def test_what_anybody_made_is_not(name: str) -> None:
    assert not is_leftover(Path(name), Path())
