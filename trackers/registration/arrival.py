"""An instrument that went out of the picture: where it was last seen, and where it may have come back."""

from __future__ import annotations

import numpy as np

from surgbench.contract import Mask
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.metrics import OUT_OF_VIEW_SHARE
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.state import ANGLES, POSITION
from surgbench.trackers.registration.proposals import shift_to_mask

DISTANCES = (1.0, 0.85, 1.18)  # of where it was: what changes most unseen, and shows least in a few pixels
SLIDES_M = np.linspace(-0.03, 0.09, 21)  # along the shaft, inwards
ROUNDS = 2
TELLING_SHARE = 0.01  # of the image, beyond which what is seen tells all of the state
STEADY = 3  # frames in a row that fit, and are telling, for it to have been found again
FRESH = 10  # frames after which one that was found again is followed as if it had never been lost
PATIENCE = 30  # frames after which what does not fit well is taken for all that there is: a recording never fits


class Whereabouts:
    """Keeps where an instrument was last seen for sure, and whether it has yet to be found again.

    Args:
        state: ``(n,)`` of the first frame.

    Attributes:
        sure: ``(n,)`` where it was last seen for sure.
        lost: It was lost, and has not been seen for sure since.
        unseen: Next to nothing was in the last mask.
        doubted: It is lost, or has slipped so lately that edges which do not fit say nothing of the instrument.
    """

    def __init__(self, state: FloatArray) -> None:
        self.sure: FloatArray = np.array(state)
        self.lost = self.unseen = self.doubted = False
        self._steady = 0  # frames in a row
        self._since = FRESH  # frames since it was found again
        self._doubtful = 0  # frames since it fitted, without those in which it was lost

    @property
    def fresh(self) -> bool:
        """Whether it is lost, or was found again so lately that how fast it moves is hardly known."""
        return self._since < FRESH

    def note(self, state: FloatArray, share: float, *, lost: bool, fits: bool) -> None:
        """Take in a frame.

        Args:
            state: ``(n,)`` the estimate.
            share: Of the image that the mask covers.
            lost: The estimate is said to be lost.
            fits: Its edges are those of the mask.
        """
        self.unseen = share < OUT_OF_VIEW_SHARE
        if lost:
            self.lost = self.doubted = True
            self._steady = self._since = 0
            return
        # What has just come back shows so little that much fits it, and moves so fast that it is soon lost again.
        self._steady = self._steady + 1 if fits and share >= TELLING_SHARE else 0
        fits = fits and (not self.lost or self._steady >= STEADY)
        self._doubtful = 0 if fits else self._doubtful + 1
        self.doubted = 0 < self._doubtful <= PATIENCE
        if not self.lost:
            self._since += 1
        if not self.doubted:
            self.lost, self.sure = False, np.array(state)


def arrivals(state: FloatArray, evaluator: SilhouetteEvaluator, mask: Mask) -> FloatArray:
    """Where one arm may have come back: put in along its shaft until it covers as many pixels as a mask.

    How far it is in shows by how much of it is seen. Were only its centre moved onto the mask's, an instrument of which
    nothing shows would come to lie with its wrist there.

    Args:
        state: ``(9,)`` where it was last seen.
        evaluator: Of the view.
        mask: ``(H, W)`` observed, not empty.

    Returns:
        ``(k, 9)``, turned and opened as before: at the distance where it was, nearer, and further away.
    """
    axis = look_at_rotation(state[ANGLES])[:, 2]
    reference = Reference(mask)
    states: FloatArray = np.tile(state, (len(DISTANCES), 1))
    for one, factor in zip(states, DISTANCES, strict=True):
        one[POSITION] *= factor  # the wrist stays in the same place of the image
        for _ in range(ROUNDS):
            slid = np.tile(one, (len(SLIDES_M), 1))
            slid[:, POSITION] += SLIDES_M[:, None] * axis
            # Of equals the shortest way: an instrument that crosses all of the picture covers the same on and on.
            off = np.abs(evaluator.score(slid, reference).area - reference.area) + np.abs(SLIDES_M)
            nearest = slid[int(np.argmin(off))]
            one[:] = shift_to_mask(nearest, evaluator.mask(nearest), mask, evaluator.camera)
    return states
