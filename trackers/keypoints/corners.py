"""The two strongest corners of the mask: what Hu et al. 2026 call "OpenCV kpt.", after Liang et al."""

from __future__ import annotations

from typing import ClassVar

import cv2
import numpy as np

from surgbench.contract import Mask, Observation, Plugin, Scene, View
from surgbench.geometry import FloatArray
from surgbench.trackers.keypoints.pairs import ArmTips

# Those of the released code of Liang et al. (arXiv:2503.05953).
QUALITY = 0.1
LEAST_DISTANCE_PX = 5
BLOCK_PX = 15


class CornersKeypoints(Plugin):
    """Shi and Tomasi's corners (CVPR 1994) of each arm's mask as OpenCV finds them; they need not be the tips."""

    name: ClassVar[str] = "corners"
    summary: ClassVar[str] = "the mask's two strongest corners (OpenCV), tips or not"

    def reset(self, scene: Scene) -> None:
        """Prepare to tell two arms apart."""
        self._arms = ArmTips(scene)

    def detect(self, observation: Observation, view: View) -> tuple[FloatArray | None, ...]:
        """Two corners per arm; ``None`` where there are not two, and for both where the arms cannot be told apart."""
        return self._arms.find(observation, view, _corners)


def _corners(mask: Mask) -> FloatArray | None:
    """``(2, 2)`` pixels (u, v), or ``None``."""
    image = np.where(mask, np.uint8(255), np.uint8(0))
    found = cv2.goodFeaturesToTrack(image, 2, QUALITY, LEAST_DISTANCE_PX, blockSize=BLOCK_PX)
    return None if found is None or len(found) != 2 else np.asarray(found, dtype=np.float64).reshape(2, 2)
