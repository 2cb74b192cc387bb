"""What the pixels of all masks of a recording say, counted before anything is made of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray
from surgbench.recordings.labels import brightest, pixel_codes

Channel = Literal["auto", "colour", "alpha"]
# As many different pixels are told apart: all that 16 bits of grey can be.
MOST_CODES = 1 << 16


class MaskSource(Protocol):
    """The masks of a recording, one after another.

    Attributes:
        place: File or folder, for messages.
        numbers: Of the frames, increasing.
        names: Of the frames, as the recording calls them.
        times_s: ``(frames,)`` seconds since the first frame where the source itself tells, else ``None``.
        lossy: What smears the masks' edges, for messages: ``JPEG``, ``video``; ``None`` where nothing does.
        several: What tells that one frame has several objects of a kind, one line; ``None`` where none has.
    """

    place: Path
    numbers: list[int]
    names: list[str]
    times_s: FloatArray | None
    lossy: str | None
    several: str | None

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of all of them, pixels; ``None`` where neither the source nor who opened it says."""
        ...

    def pictures(self) -> Iterator[NDArray[Any]]:
        """Each mask as OpenCV decodes it, only one at a time in memory.

        Raises:
            DatasetError: One is damaged, or of another size than the first; one line.
        """
        ...


class Tally:
    """How many pixels there are of each kind.

    Attributes:
        pixels: Code to pixels in all masks together, see :func:`surgbench.recordings.labels.pixel_codes`.
        frames: Code to masks that it is in.
        first: Code to the number of the first of these masks.
        full: Largest value that the deepest mask could have.
        depths: How many depths there are, 8 and 16 bit.
    """

    def __init__(self) -> None:
        self.pixels: dict[int, int] = {}
        self.frames: dict[int, int] = {}
        self.first: dict[int, int] = {}
        self._types: set[Any] = set()
        self.complete = True

    @property
    def full(self) -> int:
        """Largest value that the deepest mask could have."""
        return max((int(np.iinfo(one).max) for one in self._types), default=255)

    @property
    def depths(self) -> int:
        """How many depths there are: 8 bit, 16 bit."""
        return len(self._types)

    @property
    def total(self) -> int:
        """All pixels."""
        return sum(self.pixels.values())

    def add(self, plane: NDArray[Any], number: int) -> None:
        """Count the pixels of one mask, ``(height, width)`` or ``(height, width, 3)``."""
        self._types.add(plane.dtype)
        codes = pixel_codes(plane)
        if codes.dtype.itemsize <= 2:
            counts = np.bincount(codes.ravel())
            kinds = np.flatnonzero(counts)
            counts = counts[kinds]
        else:
            kinds, counts = np.unique(codes, return_counts=True)
        for code, count in zip(kinds.tolist(), counts.tolist(), strict=True):
            if code not in self.pixels and len(self.pixels) >= MOST_CODES:
                self.complete = False
                code = brightest(code)
            self.pixels[code] = self.pixels.get(code, 0) + count
            self.frames[code] = self.frames.get(code, 0) + 1
            self.first.setdefault(code, number)


class Survey:
    """What all masks of a recording hold.

    Args:
        source: The masks.
        channel: Where they are coded; ``auto``: in colour, unless that is the same everywhere and transparency is not.
        progress: Takes a number of masks just looked at.

    Attributes:
        channel: Where they are coded.
        tally: Of that channel.

    Raises:
        ConfigError: Colour and transparency differ, and nothing says which counts; or there is no transparency.
        DatasetError: A mask is damaged or of another size.
    """

    def __init__(
        self, source: MaskSource, channel: Channel = "auto", progress: Callable[[float], None] = lambda masks: None
    ) -> None:
        colour, alpha = Tally(), Tally()
        same = True
        for number, picture in zip(source.numbers, source.pictures(), strict=True):
            colour.add(coded_plane(picture, "colour"), number)
            if has_alpha(picture):
                transparency = coded_plane(picture, "alpha")
                alpha.add(transparency, number)
                same = same and bool(np.array_equal(pixel_codes(coded_plane(picture, "colour")) > 0, transparency > 0))
            progress(1)
        if channel == "auto":
            if len(alpha.pixels) > 1 and len(colour.pixels) > 1 and not same:
                raise ConfigError(
                    f"{source.place}: the masks have colours and transparency, which differ; say which of them counts "
                    "with --channel alpha or --channel colour"
                )
            channel = "alpha" if len(alpha.pixels) > 1 and len(colour.pixels) == 1 else "colour"
        if channel == "alpha" and not alpha.pixels:
            raise ConfigError(f"--channel alpha: the masks in {source.place} have no transparency")
        self.channel: Literal["colour", "alpha"] = channel
        self.tally = alpha if channel == "alpha" else colour


def has_alpha(picture: NDArray[Any]) -> bool:
    """Whether a decoded picture has an alpha channel."""
    return picture.ndim == 3 and picture.shape[2] == 4


def coded_plane(picture: NDArray[Any], channel: str) -> NDArray[Any]:
    """What of a decoded picture codes a mask; of one without transparency, which is opaque, its largest value."""
    if channel == "alpha":
        if has_alpha(picture):
            return picture[..., 3]
        return np.full(picture.shape[:2], np.iinfo(picture.dtype).max, picture.dtype)
    return picture[..., :3] if picture.ndim == 3 else picture
