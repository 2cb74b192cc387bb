"""Masks as 1-bit PNG files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.errors import DatasetError

Mask = NDArray[np.bool_]

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
# The last twelve bytes of every whole PNG file. Decoders fill in what is missing of a truncated one and say nothing.
PNG_END = b"\x00\x00\x00\x00IEND\xaeB`\x82"


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


def decode_png(data: bytes, name: str) -> NDArray[Any]:
    """Decode a PNG file of any depth.

    Args:
        data: The whole file.
        name: For the message.

    Returns:
        ``(height, width)`` or ``(height, width, channels)``, channels in OpenCV's order.

    Raises:
        DatasetError: It is empty, truncated, or no PNG; one line that names it.
    """
    if not data:
        raise DatasetError(f"{name}: empty file; expected a PNG")
    if not data.startswith(PNG_SIGNATURE):
        raise DatasetError(f"{name}: not a PNG file")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data.endswith(PNG_END) else None
    if image is None:
        raise DatasetError(f"{name}: truncated or damaged PNG")
    return image


def read_bytes(path: Path) -> bytes:
    """A file's bytes.

    Raises:
        DatasetError: It is missing or cannot be read; one line that names it.
    """
    try:
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise DatasetError(f"{path}: missing") from None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None


def decode_mask(data: bytes, name: str, width: int, height: int) -> Mask:
    """Decode one of a dataset's masks.

    Returns:
        ``(height, width)`` bool.

    Raises:
        DatasetError: It is truncated, no PNG, of another size, or has more than one channel.
    """
    image = decode_png(data, name)
    if image.ndim != 2:
        raise DatasetError(f"{name}: has {image.shape[2]} channels; a mask has one")
    if image.shape != (height, width):
        raise DatasetError(f"{name}: is {image.shape[1]}x{image.shape[0]} pixels; its camera has {width}x{height}")
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
        DatasetError: It is truncated, no PNG, or of another size.
    """
    image = decode_png(data, name)
    if image.shape[:2] != (height, width):
        raise DatasetError(f"{name}: is {image.shape[1]}x{image.shape[0]} pixels; its camera has {width}x{height}")
    if image.dtype == np.uint16:
        image = image >> 8
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., 2::-1], dtype=np.uint8)
