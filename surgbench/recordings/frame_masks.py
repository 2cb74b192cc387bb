"""Masks that lie beside the frames of a recording: which frame each is of, and what it shows."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.dataset.masks import read_bytes
from surgbench.errors import DatasetError
from surgbench.pictures import PICTURE_SUFFIXES, stated_size
from surgbench.recordings.coding import Told, read_coding
from surgbench.recordings.files import numbered_pictures
from surgbench.recordings.folder import open_masks
from surgbench.recordings.video import MaskVideo

Mask = NDArray[np.bool_]


class FrameMasks:
    """Masks of all frames of a recording, or of some.

    Args:
        place: Folder, video or JSON file.
        size: Width and height that they must have, pixels.
        told: What is known of how they are coded.
        numbers: Of the recording's frames, increasing.
        first: The number of the recording's first frame as the masks count, where that is told. Else what they count is
            what the recording counts, or one more where the last of them tells so.

    Attributes:
        frames: Places in ``numbers`` of the frames that have one, increasing.
        coding: What they mean.

    Raises:
        ConfigError: More must be told of how they are coded; one line.
        DatasetError: One is damaged, of another size, or of no frame of the recording; one line.
    """

    def __init__(
        self, place: Path, size: tuple[int, int], told: Told, numbers: Sequence[int], first: int | None = None
    ) -> None:
        if not place.exists():
            raise DatasetError(f"{place}: missing; --masks names a folder, a video or a JSON file of RLE")
        self.place = place
        self._source = open_masks(place, size)
        self.frames = self._places(numbers, first)
        self.coding = read_coding(self._source, told)

    def at(self, frames: Collection[int]) -> Iterator[dict[str, Mask]]:
        """What the masks of some of :attr:`frames` show, in order: see :meth:`Coding.masks`."""
        wanted = set(frames)
        for frame, picture in zip(self.frames, self._source.pictures(), strict=True):
            if frame in wanted:
                yield self.coding.masks(picture)

    def _places(self, numbers: Sequence[int], first: int | None) -> list[int]:
        own = self._source.numbers
        if isinstance(self._source, MaskVideo):
            if len(own) != len(numbers):
                raise DatasetError(
                    f"{self.place}: has {len(own)} frames, the recording {len(numbers)}; a video of masks needs one "
                    "for each (pictures with the frames' numbers in their names may be fewer)"
                )
            return list(range(len(numbers)))
        # ffmpeg counts from 1, and a recording's own count ends one earlier then.
        shift = numbers[0] - first if first is not None else -int(own[-1] == numbers[-1] + 1)
        places = {number: place for place, number in enumerate(numbers)}
        for number in own:
            if number + shift not in places:
                raise DatasetError(
                    f"{self.place}: there is no frame {number} in the recording (frames {numbers[0] - shift} to "
                    f"{numbers[-1] - shift}); --masks-from NUMBER says what the masks call its first one"
                )
        return [places[number + shift] for number in own]


def picture_size(place: Path) -> tuple[int, int] | None:
    """Width and height of a picture, the first one of a folder, or a video; ``None`` where nothing says so.

    Raises:
        DatasetError: It is damaged or missing; one line.
    """
    if place.is_dir() or place.suffix.lower() in PICTURE_SUFFIXES:
        path = next(iter(numbered_pictures(place, "pictures").values())) if place.is_dir() else place
        return stated_size(read_bytes(path), str(path))
    return open_masks(place).size


def picked(pictures: Iterator[Any], places: Collection[int]) -> Iterator[Any]:
    """Those of some items that are at the places, one at a time in memory."""
    wanted, last = set(places), max(places, default=-1)
    for place, picture in enumerate(pictures):
        if place > last:
            return
        if place in wanted:
            yield picture
