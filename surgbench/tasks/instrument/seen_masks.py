"""The masks that the tracker of a recorded run saw: the dataset's, or what its mask source made, made again."""

from __future__ import annotations

import json

import numpy as np
from numpy.typing import NDArray

from surgbench.contract import Mask
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.records import InstrumentRecord
from surgbench.tasks.instrument.replay import made_masks


class SeenMasks:
    """What one source made of the reference view; kept, since a source goes through the frames in turn.

    Args:
        dataset: The dataset of the run.
        record: The run, which has a mask source.
    """

    def __init__(self, dataset: InstrumentDataset, record: InstrumentRecord) -> None:
        camera = dataset.sequence(record.spec.sequence).camera
        self._shape = camera.height, camera.width
        self._made = made_masks(json.loads(record.path.read_text(encoding="utf-8")), dataset)
        self._kept: dict[int, NDArray[np.uint8]] = {}

    def mask(self, frame: int) -> Mask:
        """``(height, width)`` bool; empty in frames before tracking began, and in those that the run did not reach.

        Raises:
            SurgbenchError: The source cannot run here, or breaks down.
        """
        while frame not in self._kept:
            reached, view = next(self._made, (frame, None))
            self._kept[reached] = np.packbits(np.zeros(self._shape, dtype=bool) if view is None else view.mask)
        flat = np.unpackbits(self._kept[frame], count=self._shape[0] * self._shape[1])
        return flat.reshape(self._shape).view(np.bool_)


def source_of(record: InstrumentRecord) -> str | None:
    """What tells one run's masks of a unit from another's; ``None`` where they are the dataset's."""
    return None if record.spec.mask_source is None else str(record.path)
