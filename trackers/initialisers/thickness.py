"""A loss in which thin parts of the mask weigh more than thick ones.

A jaw seen end-on is a few hundred pixels beside a shaft of ten thousands, so that plain pixel counts rank a
pose with one jaw missing among the best. Here a pixel weighs more the thinner the part that it is in: with the square
root of the mask's largest inscribed radius over that of the largest disc in the mask that covers the pixel. (With the
ratio itself a jaw of a quarter of the shaft's width counts like the shaft, and so does what is wrong with its edge: of
real masks one in ten then fits best with the wrist bent to its limit.)
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from surgbench.contract import Mask, Observation, Scene
from surgbench.geometry import FloatArray
from surgbench.objective import LossWeights, Objective
from surgbench.silhouette import RowSums

STEPS = 10  # radii at which the local thickness is told apart
REACH_PX = 10.0  # how far the weight of a thin part reaches outside the mask
UNIT = 16  # weights are integers in sixteenths, so that sums are exact


def thickness_weights(mask: Mask) -> FloatArray:
    """Weight of each pixel, ``(H, W)``, at least 1.

    Args:
        mask: ``(H, W)``, not empty.

    Returns:
        Inside the mask, square root of largest radius over local radius; outside, the nearest inside weight, fading
        to 1.
    """
    inside = mask.astype(np.uint8)
    depth = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    largest = float(depth.max())
    radius = np.ones(mask.shape)
    for step in np.geomspace(1.0, max(largest, 1.0), STEPS):
        core = (depth >= step).astype(np.uint8)
        covered = cv2.distanceTransform(1 - core, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= step
        radius[covered & mask] = step
    weights = np.sqrt(np.maximum(largest / radius, 1.0))
    distance, labels = cv2.distanceTransformWithLabels(1 - inside, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    by_label = np.ones(int(labels.max()) + 1)
    by_label[labels[mask]] = weights[mask]
    outside = 1.0 + (by_label[labels] - 1.0) * np.exp(-distance / REACH_PX)
    return np.where(mask, weights, outside)


class ThicknessObjective(Objective):
    """The tracking loss with the pixel mismatch weighted by :func:`thickness_weights`; of the reference view alone."""

    def __init__(self, scene: Scene, weights: LossWeights) -> None:
        super().__init__(replace(scene, views=scene.views[:1]), weights.model_copy(update={"appearance": 0.0}))

    def observe(self, observation: Observation) -> None:
        """Take the frame that the next calls score against."""
        super().observe(replace(observation, views=observation.views[:1]))
        weights = np.round(UNIT * thickness_weights(observation.mask)).astype(np.int32)
        self._uncovered = int(weights[observation.mask].sum(dtype=np.int64))
        self._gain = RowSums(np.where(observation.mask, -weights, weights))

    def mismatch(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Weighted mismatch instead of the plain one; overlaps as they are."""
        overlaps = super().mismatch(states)[1]
        _, gains = self.evaluator.sum_over(states, self._gain)
        return (self._uncovered + gains) / UNIT, overlaps
