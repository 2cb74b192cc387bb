"""Whose track is whose: pure functions on what is estimated of two arms that cross and hide each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgbench.geometry import FloatArray
from surgbench.metrics import RECOVERED_M

# Wrist and jaws of which no more than this share is seen are hidden.
HIDDEN_SHARE = 0.1
# Tracks are exchanged that are for so many frames in which both arms are seen.
EXCHANGED_FRAMES = 10
# After an arm was hidden tracks have so many frames in which both are seen to come out right.
SETTLED_FRAMES = 30
# Who is this far off and sure of himself misleads.
FAR_OFF_M = 0.010
# Who is surer than this has not said that he may be wrong.
SURE = 0.5


def tip_distances(estimate_tips: ArrayLike, true_tips: ArrayLike) -> FloatArray:
    """Mean distance of each arm's estimated tips from each arm's true ones, under the better of the two pairings.

    Args:
        estimate_tips: ``(T, arms, 2, 3)`` in the camera frame, metres.
        true_tips: Same shape.

    Returns:
        ``(T, arms, arms)`` metres: of the estimate of the first arm from the truth of the second.

    Example:
        Each arm's estimate is where the other one is, 3 cm aside:

        >>> import numpy as np
        >>> from surgbench.pair_metrics import tip_distances
        >>> tips = np.zeros((1, 2, 2, 3))
        >>> tips[0, 1, :, 0] = 0.03
        >>> tip_distances(tips[:, ::-1], tips)[0]
        array([[0.03, 0.  ],
               [0.  , 0.03]])
    """
    estimate = np.asarray(estimate_tips, dtype=np.float64)[:, :, None]
    true = np.asarray(true_tips, dtype=np.float64)[:, None]
    straight = np.linalg.norm(estimate - true, axis=-1).mean(axis=-1)
    crossed = np.linalg.norm(estimate - true[..., ::-1, :], axis=-1).mean(axis=-1)
    nearer: FloatArray = np.minimum(straight, crossed)
    return nearer


def exchanged(distances: ArrayLike) -> NDArray[np.bool_]:
    """In which frames both estimates are nearer to the other arm than to their own, ``(T,)``.

    Args:
        distances: ``(T, 2, 2)`` from :func:`tip_distances`.

    Example:
        Both are, then the left one alone:

        >>> from surgbench.pair_metrics import exchanged
        >>> exchanged([[[0.03, 0.0], [0.0, 0.03]], [[0.03, 0.0], [0.03, 0.0]]])
        array([ True, False])
    """
    far = np.asarray(distances, dtype=np.float64)
    return np.asarray((far[:, 0, 1] < far[:, 0, 0]) & (far[:, 1, 0] < far[:, 1, 1]))


def swaps(exchanged: ArrayLike, counts: ArrayLike) -> int:
    """How often two tracks have exchanged their arms and stayed so.

    That is for :data:`EXCHANGED_FRAMES` frames in a row of those that count. Frames that do not are passed over: they
    neither begin nor end an exchange.

    Args:
        exchanged: ``(T,)`` bool, from :func:`exchanged`.
        counts: ``(T,)`` bool: frames in which both arms are seen.

    Example:
        Exchanged for 3 frames, then right, then exchanged for 12 between which one arm is hidden for 2:

        >>> from surgbench.pair_metrics import swaps
        >>> turned = [True] * 3 + [False] + [True] * 7 + [False] * 2 + [True] * 5
        >>> swaps(turned, [True] * 11 + [False] * 2 + [True] * 5)
        1
    """
    seen = np.asarray(exchanged, dtype=bool)[np.asarray(counts, dtype=bool)]
    return int(sum(last - first >= EXCHANGED_FRAMES for first, last in stretches(seen)))


def right_way_round(exchanged: ArrayLike, away: ArrayLike, least: int = 1) -> FloatArray:
    """Of each stretch of frames in which an arm is hidden: 1 where the tracks come out of it right, else 0.

    What counts is the :data:`SETTLED_FRAMES`-th frame afterwards in which both arms are seen, or the last one before
    the next such stretch. A stretch after which there is none says nothing, and so does one before which both are never
    seen.

    Args:
        exchanged: ``(T,)`` bool, from :func:`exchanged`.
        away: ``(T, 2)`` bool: an arm is hidden, or out of view.
        least: Frames of the shortest stretch that counts.

    Returns:
        ``(stretches,)``.

    Example:
        Hidden twice; out of the first the tracks come exchanged:

        >>> import numpy as np
        >>> from surgbench.pair_metrics import right_way_round
        >>> away = np.array([[0, 0], [0, 1], [0, 0], [1, 0], [0, 0]], dtype=bool)
        >>> right_way_round([False, False, True, True, False], away)
        array([0., 1.])
    """
    turned = np.asarray(exchanged, dtype=bool)
    gone: NDArray[np.bool_] = np.logical_or.reduce(np.asarray(away, dtype=bool), axis=1)
    found, away_in = [], stretches(gone)
    for place, (first, last) in enumerate(away_in):
        until = away_in[place + 1][0] if place + 1 < len(away_in) else len(gone)
        if first > 0 and last < until and last - first >= least:
            found.append(not turned[min(last + SETTLED_FRAMES, until) - 1])
    return np.array(found, dtype=np.float64)


def hidden_known(tip_errors: ArrayLike, lost: ArrayLike, hidden: ArrayLike) -> FloatArray:
    """Of the frames in which an arm is hidden: 1 where it is said to be lost or is right nevertheless, else 0.

    Right are tips no further off than :data:`surgbench.metrics.RECOVERED_M`.

    Args:
        tip_errors: ``(...)`` metres.
        lost: Same shape, bool.
        hidden: Same shape, bool.

    Returns:
        Same shape; NaN in all other frames.

    Example:
        >>> from surgbench.pair_metrics import hidden_known
        >>> hidden_known([0.02, 0.02, 0.001, 0.02], [True, False, False, False], [True, True, True, False])
        array([ 1.,  0.,  1., nan])
    """
    known = np.asarray(lost, dtype=bool) | (np.asarray(tip_errors, dtype=np.float64) <= RECOVERED_M)
    return np.where(np.asarray(hidden, dtype=bool), known.astype(np.float64), np.nan)


def far_off_doubted(tip_errors: ArrayLike, confidence: ArrayLike, lost: ArrayLike) -> FloatArray:
    """Of the frames in which an estimate is far off: 1 where it is said to be lost or doubtful, else 0.

    Far off are tips by more than :data:`FAR_OFF_M`, doubtful is a confidence below :data:`SURE`.

    Args:
        tip_errors: ``(...)`` metres.
        confidence: Same shape.
        lost: Same shape, bool.

    Returns:
        Same shape; NaN in all other frames.

    Example:
        >>> from surgbench.pair_metrics import far_off_doubted
        >>> far_off_doubted([0.02, 0.02, 0.001], [0.9, 0.3, 0.3], [False, False, False])
        array([ 0.,  1., nan])
    """
    doubted = np.asarray(lost, dtype=bool) | (np.asarray(confidence, dtype=np.float64) < SURE)
    far = np.asarray(tip_errors, dtype=np.float64) > FAR_OFF_M
    return np.where(far, doubted.astype(np.float64), np.nan)


def stretches(values: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First frame of each stretch of true values ``(T,)``, and the frame after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], values, [False]]).astype(np.int8)))
    return [(int(first), int(last)) for first, last in edges.reshape(-1, 2)]
