"""The silhouette engine itself, measured in the same way as the others."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import Camera
from surgbench.comparison.peers.base import Contestant
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.silhouette import Reference, SilhouetteEvaluator


class SilhouetteEngine(Contestant):
    """Counts without an image.

    Args:
        threads: That share a generation.
    """

    name: ClassVar[str] = "surgbench"
    module: ClassVar[str] = "surgbench"

    def __init__(self, threads: int = 1) -> None:
        self._threads = threads

    def prepare(self, instrument: Instrument, camera: Camera) -> None:
        """Assemble the contour's tables."""
        super().prepare(instrument, camera)
        self._evaluator = SilhouetteEvaluator([instrument], camera, threads=self._threads)

    def aim(self, mask: Mask) -> None:
        """Sum the mask's rows."""
        self._reference = Reference(mask)

    def silhouette(self, state: FloatArray) -> Mask:
        """The silhouette of one state ``(9,)``, ``(H, W)``."""
        return self._evaluator.mask(state)

    def score(self, states: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Area and overlap of ``(N, 9)`` states, ``(N,)`` and ``(N,)`` pixels."""
        return self._evaluator.sum_over(states, self._reference)
