"""Which part of a mask belongs to which arm, for what looks at one arm at a time."""

from __future__ import annotations

import cv2
import numpy as np

from surgbench.contract import Mask, View

LEAST_SHARE = 0.1  # of the larger arm's pixels that the other arm has; less is a speck, and the arms are in one part


def mask_per_arm(view: View, arms: int) -> tuple[Mask, ...] | None:
    """One mask per arm: the mask, instance masks that differ, or the two largest connected parts from left to right.

    Args:
        view: Its mask and instance masks.
        arms: 1 or 2.

    Returns:
        ``arms`` masks ``(H, W)``, left arm first; ``None`` where the two arms touch or one is not seen, and in views
        that are not the reference camera's, in which the left arm need not be on the left.
    """
    if arms == 1:
        return (view.mask,)
    if (masks := view.told_apart) is not None:
        return masks
    if not np.array_equal(view.T_view_cam, np.eye(4)):
        return None
    count, labels, stats, centres = cv2.connectedComponentsWithStats(view.mask.astype(np.uint8))
    if count < 3:
        return None
    areas = stats[:, cv2.CC_STAT_AREA]
    first, second = 1 + np.argsort(-areas[1:], kind="stable")[:2]
    if areas[second] < LEAST_SHARE * areas[first]:
        return None
    return tuple(np.asarray(labels == label) for label in sorted((first, second), key=lambda label: centres[label][0]))
