"""Where an instrument that was out of the picture may have come back: along its shaft, as far as the mask shows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surgbench.contract import Mask
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.state import ANGLES, POSITION
from surgbench.trackers.registration.proposals import shift_to_mask

SLIDES_M = np.linspace(-0.03, 0.09, 21)  # along the shaft, inwards
ROUNDS = 2


def at_distances(state: FloatArray, factors: Sequence[float]) -> FloatArray:
    """The state of one arm nearer and further away, where the wrist stays in the same place of the image.

    Args:
        state: ``(9,)``.
        factors: On its distance, k of them.

    Returns:
        ``(k, 9)``.
    """
    states: FloatArray = np.tile(state, (len(factors), 1))
    states[:, POSITION] *= np.array(factors)[:, None]
    return states


def arrive(state: FloatArray, evaluator: SilhouetteEvaluator, mask: Mask) -> FloatArray:
    """The state of one arm put in along its shaft until it covers as many pixels as a mask, and moved onto that.

    How far it is in shows by how much of it is seen. Moving its centre onto the mask's alone would put the wrist there.

    Args:
        state: ``(9,)`` where it was last seen, or is thought to be.
        evaluator: Of the view.
        mask: ``(H, W)`` observed, not empty.

    Returns:
        ``(9,)``, turned and opened as before.
    """
    moved = np.array(state)
    axis = look_at_rotation(state[ANGLES])[:, 2]
    reference = Reference(mask)
    for _ in range(ROUNDS):
        slid = np.tile(moved, (len(SLIDES_M), 1))
        slid[:, POSITION] += SLIDES_M[:, None] * axis
        score = evaluator.score(slid, reference)
        # Of equals the shortest way: an instrument that crosses the whole picture covers the same on and on.
        off = np.abs(score.area - reference.area) + 1e-3 * np.abs(SLIDES_M)
        moved = slid[int(np.argmin(off))]
        moved = shift_to_mask(moved, evaluator.mask(moved), mask, evaluator.camera)
    return moved
