"""Which of two arms pixels of a mask belong to that neither covers: the nearer one's."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

# Ways are measured in a picture of so many times fewer rows and columns.
COARSE = 4


def ways(covered: NDArray[np.bool_]) -> NDArray[np.float64]:
    """How far it is to each arm, in pixels of the smaller picture, ``(arms, H / 4, W / 4)`` rounded up.

    Args:
        covered: ``(arms, H, W)`` what each covers; to one that covers nothing it is infinitely far.

    Example:
        Two arms in the picture's first and last columns:

        >>> import numpy as np
        >>> from surgbench.search.nearer import ways
        >>> covered = np.zeros((2, 4, 20), dtype=bool)
        >>> covered[0, :, 0] = covered[1, :, 16:] = True
        >>> ways(covered).argmin(axis=0).tolist()
        [[0, 0, 0, 1, 1]]
    """
    coarse = covered[:, ::COARSE, ::COARSE]
    return np.array(
        [
            cv2.distanceTransform((~one).astype(np.uint8), cv2.DIST_L2, 3) if one.any() else np.full(one.shape, np.inf)
            for one in coarse
        ]
    )
