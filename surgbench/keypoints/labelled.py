"""Masks whose tips are known: what keypoint detectors are trained on and measured with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from surgbench.camera import Camera
from surgbench.contract import Mask
from surgbench.geometry import FloatArray


@dataclass(frozen=True)
class LabelledMask:
    """One arm's mask, and where its tips are.

    Attributes:
        mask: ``(H, W)`` bool, corrupted as a tracker sees it.
        camera: The camera that sees it.
        tips_px: ``(2, 2)`` true tips (u, v), pixels; inside the image or not.
        shows: ``(2,)`` bool: the tip can be seen in the mask. It is inside the image, sticks out of the silhouette of
            shaft and wrist by at least 1 mm and out of its own hinge, is not in that of the other jaw, and the
            corruption has neither eaten nor buried it.
        opening_rad: q3, the angle of each jaw from the midline.
        corruption: How the mask was corrupted, by name.
    """

    mask: Mask
    camera: Camera
    tips_px: FloatArray
    shows: np.ndarray
    opening_rad: float
    corruption: str

    @property
    def apart_px(self) -> float:
        """Distance of the two tips, pixels."""
        return float(np.linalg.norm(self.tips_px[0] - self.tips_px[1]))

    @property
    def both_show(self) -> bool:
        """Whether both tips can be seen in the mask."""
        return bool(self.shows.all())


class LabelledMasks(Protocol):
    """Masks by number: the same number is the same mask, whatever was asked for before."""

    def __len__(self) -> int:
        """How many there are."""
        ...

    def __getitem__(self, index: int) -> LabelledMask:
        """The mask of a number from 0."""
        ...

    def __iter__(self) -> Iterator[LabelledMask]:
        """All of them in order."""
        ...
