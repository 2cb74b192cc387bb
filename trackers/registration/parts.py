"""Which part of an instrument a contour point lies on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surgbench.contract import Mask
from surgbench.geometry import FloatArray
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
            row[[one.link_index[tip.link] for tip in one.tips]] = False
        self._jaws = [[one.link_index[tip.link] for tip in one.tips] for one in instruments]

    def on_wrist(self, contour: ContourPoints) -> Mask:
        """``(K,)`` which of K points lie on a wrist."""
        return np.asarray(self._wrist[contour.arm, contour.link])

    def shows(self, contour: ContourPoints, arm: int, tips_px: FloatArray, within_px: float) -> Mask:
        """``(2,)`` which of an arm's tips, at ``(2, 2)``, the silhouette shows: the contour of their jaws passes there.

        A detector that has two tips to name takes something else for one that the other jaw or the wrist hides.
        """
        shown = np.zeros(len(tips_px), dtype=bool)
        for tip, link in enumerate(self._jaws[arm]):
            own = contour.points_px[(contour.arm == arm) & (contour.link == link)]
            off = own - tips_px[tip]
            shown[tip] = bool((np.hypot(off[:, 0], off[:, 1]) < within_px).any())
        return shown
