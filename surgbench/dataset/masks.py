"""Masks and images of a dataset, as PNG files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.errors import DatasetError
from surgbench.files import read_whole
from surgbench.pictures import as_rgb, decode_picture, is_jpeg

Mask = NDArray[np.bool_]


def encode_mask(mask: Mask) -> bytes:
    """The bytes of a 1-bit PNG.

    Args:
        mask: ``(height, width)`` bool.
    """
    options = [cv2.IMWRITE_PNG_BILEVEL, 1, cv2.IMWRITE_PNG_COMPRESSION, 6]
    done, data = cv2.imencode(".png", mask.astype(np.uint8) * 255, options)
    if not done:
        raise DatasetError(f"a mask of shape {mask.shape} cannot be written as PNG")
    return data.tobytes()


def encode_image(image: NDArray[np.uint8]) -> bytes:
    """The bytes of an 8-bit PNG of an RGB image ``(height, width, 3)``."""
    done, data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 6])
    if not done:
        raise DatasetError(f"an image of shape {image.shape} cannot be written as PNG")
    return data.tobytes()


def encode_levels(levels: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """The bytes of a grey PNG of ``(height, width)`` numbers, 8 or 16 bits each."""
    done, data = cv2.imencode(".png", levels, [cv2.IMWRITE_PNG_COMPRESSION, 6])
    if not done:
        raise DatasetError(f"a picture of shape {levels.shape} cannot be written as PNG")
    return data.tobytes()


def read_bytes(path: Path) -> bytes:
    """A file's bytes.

    Raises:
        DatasetError: It is missing or cannot be read; one line that names it.
    """
    try:
        return read_whole(path)
    except (FileNotFoundError, NotADirectoryError):
        raise DatasetError(f"{path}: missing") from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None


def decode_mask(data: bytes, name: str, width: int, height: int) -> Mask:
    """Decode one of a dataset's masks.

    Returns:
        ``(height, width)`` bool.

    Raises:
        DatasetError: It is truncated, no picture, of another size, or has more than one channel.
    """
    if is_jpeg(data):
        raise DatasetError(f"{name}: not a PNG file")  # its edges are smeared
    image = decode_picture(data, name, width, height)
    if image.ndim != 2:
        raise DatasetError(f"{name}: has {image.shape[2]} channels; a mask has one")
    mask: Mask = image > 0
    return mask


def read_mask(path: Path, width: int, height: int) -> Mask:
    """Read one of a dataset's masks, ``(height, width)`` bool.

    Raises:
        DatasetError: It is missing, truncated, or of another size; one line that names it.
    """
    return decode_mask(read_bytes(path), str(path), width, height)


def read_image(path: Path, width: int, height: int) -> NDArray[np.uint8]:
    """Read one of a dataset's images, ``(height, width, 3)`` uint8 RGB.

    Raises:
        DatasetError: It is missing, truncated, or of another size; one line that names it.
    """
    return decode_image(read_bytes(path), str(path), width, height)


def decode_image(data: bytes, name: str, width: int, height: int) -> NDArray[np.uint8]:
    """Decode a colour image, ``(height, width, 3)`` uint8 RGB.

    Raises:
        DatasetError: It is truncated, no picture, or of another size.
    """
    return as_rgb(decode_picture(data, name, width, height))


def decode_levels(data: bytes, name: str, width: int, height: int, kind: type[np.generic]) -> NDArray[np.generic]:
    """Decode a grey picture of numbers.

    Args:
        data: The whole file.
        name: For the message.
        width: What it has to be, pixels.
        height: Likewise.
        kind: What each number has to be.

    Raises:
        DatasetError: It is a JPEG, truncated, of another size, has colours, or other numbers.
    """
    if is_jpeg(data):
        raise DatasetError(f"{name}: not a PNG file")
    picture = decode_picture(data, name, width, height)
    if picture.ndim != 2 or picture.dtype != kind:
        raise DatasetError(f"{name}: expected a grey picture of {np.dtype(kind).itemsize * 8} bits")
    return picture
