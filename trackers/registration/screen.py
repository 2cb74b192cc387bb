"""What neither of two arms hides may be hidden all the same: by tissue, smoke, or whatever is not segmented.

Where an arm is expected, a large piece of it is not seen, and nothing is seen beside it that might be it instead,
something stands before it. Were that taken for the end of the arm, another state would be found that ends there.
"""

from __future__ import annotations

import cv2
import numpy as np

from surgbench.contract import Mask
from surgbench.trackers.registration.morphology import grown, opened

PIECE_PX = 9  # smallest side: what a prediction is off by is narrower
FEW_PIXELS = 150
SLIVER_PX = 3
SPECK_PX = 5  # likewise, of what is seen elsewhere
ELSEWHERE = 0.25  # of the missing piece's pixels, beyond which what is seen elsewhere may be the piece
MARGIN_PX = 3


class Screen:
    """Tells what is before one arm in one view, from the frame on after one that the arm did not fit."""

    def __init__(self) -> None:
        self._stands = False

    def __call__(self, silhouette: Mask, mask: Mask, hidden: Mask, both: Mask, *, unfit: bool) -> Mask:
        """What hides an arm.

        Args:
            silhouette: ``(H, W)`` where it is expected.
            mask: Likewise, where it is seen.
            hidden: Where the other arm may hide it.
            both: Where either is seen.
            unfit: The last frame did not fit, whatever the contour was moved by.

        Returns:
            ``(H, W)`` as ``hidden``, with what else hides it.
        """
        if not (unfit or self._stands):
            return hidden
        piece = missing_piece(silhouette, mask, hidden, both)
        self._stands = piece is not None
        if piece is None:
            return hidden
        return np.asarray(hidden | grown(piece, MARGIN_PX))


def missing_piece(silhouette: Mask, mask: Mask, hidden: Mask, both: Mask) -> Mask | None:
    """``(H, W)`` a large piece of an arm that is not seen, nor anything that might be it; as for :class:`Screen`."""
    gone = silhouette & ~both & ~hidden
    if np.count_nonzero(gone) < FEW_PIXELS:
        return None
    piece = opened(gone, PIECE_PX)
    missing = np.count_nonzero(piece)
    elsewhere = np.count_nonzero(opened(mask & ~silhouette & ~hidden, SPECK_PX))
    if missing < FEW_PIXELS or elsewhere > ELSEWHERE * missing:
        return None
    # With what hangs together with it, such as the ends of jaws, but for slivers along a shaft.
    _, parts = cv2.connectedComponents(opened(gone, SLIVER_PX).view(np.uint8))
    return np.isin(parts, np.unique(parts[piece]))
