"""Masks and images as one file per frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from surgbench.dataset.masks import read_bytes
from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray
from surgbench.leftovers import without_leftovers
from surgbench.pictures import JPEG_SIGNATURE, PICTURE_SUFFIXES, decode_picture, stated_size
from surgbench.recordings.names import number_files

# Pictures that are not read: where there are others, a frame must not be missing without a word.
_OTHER_PICTURES = (".bmp", ".tif", ".tiff", ".gif", ".webp", ".pgm", ".ppm", ".jp2", ".npy", ".exr")


def numbered_pictures(folder: Path, what: str) -> dict[int, Path]:
    """Pictures of a folder by the numbers in their names, in order.

    Args:
        folder: Holds them; leftovers, and what is no picture, do not count.
        what: What they are, for the message, for example ``masks``.

    Raises:
        DatasetError: There are none, one cannot be read, a name has no number, or two have the same.
    """
    entries = sorted(without_leftovers(folder.iterdir()))
    pictures = [path for path in entries if path.suffix.lower() in PICTURE_SUFFIXES]
    other = next((path for path in entries if path.suffix.lower() in _OTHER_PICTURES), None)
    if pictures and other is not None:
        raise DatasetError(f"{other}: is neither PNG nor JPEG, as others there are; convert it or move it away")
    broken = next((path for path in pictures if not path.is_file()), None)
    if broken is not None:
        raise DatasetError(
            f"{broken}: {'leads nowhere' if broken.is_symlink() else 'is no file'}; {what} must be files"
        )
    if not pictures:
        found = f"; '{entries[0].name}' is neither PNG nor JPEG" if entries else ""
        raise DatasetError(f"{folder}: holds no {what}; expected 000000.png, 000001.png, ...{found}")
    return number_files(pictures)


def read_picture(path: Path, width: int, height: int) -> NDArray[Any]:
    """A picture of a recording, as :func:`surgbench.pictures.decode_picture` has it.

    Raises:
        DatasetError: It is missing, damaged, or of another size than the masks; one line.
    """
    return decode_picture(read_bytes(path), str(path), width, height, "the first mask is")


class MaskFiles:
    """A folder of masks; see :class:`surgbench.recordings.survey.MaskSource`.

    Args:
        folder: Holds them.
        size: Width and height that they must have, pixels; the first one's unless told.

    Raises:
        DatasetError: There are none, or their names cannot be told apart.
    """

    def __init__(self, folder: Path, size: tuple[int, int] | None = None) -> None:
        self.place = folder
        self.paths = numbered_pictures(folder, "masks")
        first = next(iter(self.paths.values()))
        self.size = size or stated_size(read_bytes(first), str(first))
        self.numbers = list(self.paths)
        self.names = [path.stem for path in self.paths.values()]
        self.times_s: FloatArray | None = None
        self.lossy = "JPEG" if any(_is_jpeg(path) for path in self.paths.values()) else None
        self.several: str | None = None

    def pictures(self) -> Iterator[NDArray[Any]]:
        """Each mask as it is decoded."""
        return (read_picture(path, *self.size) for path in self.paths.values())


def _is_jpeg(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(len(JPEG_SIGNATURE)) == JPEG_SIGNATURE
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
