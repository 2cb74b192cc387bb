"""Which part of an instrument a contour point lies on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surgbench.contract import Mask
from surgbench.instrument import Instrument
from surgbench.silhouette import ContourPoints


class Parts:
    """The shaft is the first link, jaws are links with tips, and the wrist is what lies between them.

    Args:
        instruments: One per arm.

    Attributes:
        shape: ``(arms, links)`` of arrays with a number for each link.
    """

    def __init__(self, instruments: Sequence[Instrument]) -> None:
        self.shape = len(instruments), max(len(one.spec.links) for one in instruments)
        self._wrist: Mask = np.ones(self.shape, dtype=bool)
        self._wrist[:, 0] = False
        for row, one in zip(self._wrist, instruments, strict=True):
            row[[one.link_index[tip.link] for tip in one.spec.tips]] = False

    def on_wrist(self, contour: ContourPoints) -> Mask:
        """``(K,)`` which of K points lie on a wrist."""
        return np.asarray(self._wrist[contour.arm, contour.link])
