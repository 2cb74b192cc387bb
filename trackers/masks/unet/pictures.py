"""Pictures of a dataset, with what shows in them of instruments."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surgbench.contract import Mask
from surgbench.dataset.open import open_as
from surgbench.errors import DatasetError
from surgbench.tasks.instrument.dataset import InstrumentDataset, Sequence


@dataclass(frozen=True)
class Picture:
    """A picture and what is to be found in it.

    Attributes:
        image: ``(height, width, 3)`` uint8 RGB.
        mask: ``(height, width)`` bool: where an instrument shows.
        name: Sequence and frame, for messages.
    """

    image: NDArray[np.uint8]
    mask: Mask
    name: str


def pictures(path: Path | str) -> Iterator[Picture]:
    """The pictures of a dataset, one after the other.

    Raises:
        DatasetError: It has no images, or a file is missing or damaged; one line.
    """
    dataset = open_as(InstrumentDataset, path)
    for sequence in dataset.sequences:
        yield from pictures_of(sequence)


def pictures_of(sequence: Sequence) -> Iterator[Picture]:
    """The pictures of one sequence.

    What shows of the instruments is the truth in generated data, where arms that are not rendered are left out; in a
    recording it is what somebody has marked.

    Raises:
        DatasetError: It has no images, or a file is missing or damaged; one line.
    """
    if not sequence.entry.images:
        raise DatasetError(f"{sequence.root}: sequence '{sequence.id}' has no images to learn from")
    read = sequence.clean_mask if sequence.entry.truth else sequence.mask
    look = sequence.look()
    shown = tuple(look["arms"]) if look is not None else sequence.arms
    kinds: tuple[str, ...] = shown
    if shown == sequence.arms:
        kinds = sequence.instance_kinds or (("both",) if "both" in sequence.entry.kinds else shown)
    for frame in range(sequence.frames):
        image = sequence.image(frame)
        assert image is not None
        masks = [read(kind, frame) for kind in kinds]
        yield Picture(image, np.logical_or.reduce(masks), f"sequence {sequence.id}, frame {frame}")
