"""States that look the same: what cannot be seen of an instrument is nobody's error."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.state import ALPHA, ANGLES, BETA, GAMMA


def choose_seen_alike(estimate: FloatArray, truth: FloatArray, observed: ArrayLike) -> FloatArray:
    """Per state, of all that look the same as the estimate the one nearest to the truth.

    What cannot be seen of an instrument is nobody's error. A joint that it has not takes its true value; where a turn
    about the shaft (beta) is not seen, the instrument is turned to where the rotation errs least, so that what is left
    is the angle between the two shafts, and tips beside the axis do not count that turn either.

    Args:
        estimate: ``(..., 9)`` states of one arm.
        truth: Same shape.
        observed: ``(9,)`` bool, :attr:`surgbench.instrument.Instrument.observed`.

    Returns:
        Same shape; the estimate itself where everything can be seen.

    Example:
        A tube: its roll and joints are of no account, but it points 0.1 rad too far down.

        >>> import numpy as np
        >>> from surgbench.alike import choose_seen_alike
        >>> from surgbench.metrics import rotation_error
        >>> truth = np.array([0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.2, -0.1, 0.3])
        >>> observed = np.array([True, False, True, True, True, True, False, False, False])
        >>> estimate = truth + [0.1, 2.0, 0, 0, 0, 0, 1, 1, 1]
        >>> chosen = choose_seen_alike(estimate, truth, observed)
        >>> float(rotation_error(chosen[:3], truth[:3]).round(9)), chosen[6:]
        (0.1, array([ 0.2, -0.1,  0.3]))
    """
    estimate, truth = np.asarray(estimate, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    seen = np.asarray(observed, dtype=bool)
    if seen.all():
        return estimate
    chosen = estimate.copy()
    chosen[..., ~seen] = truth[..., ~seen]
    if not seen[BETA]:
        level = chosen[..., ANGLES].copy()
        level[..., BETA] = 0.0
        # R = A Rz(beta): the beta of the greatest trace of R*^T A Rz(beta), which is the least angle.
        between = np.swapaxes(look_at_rotation(truth[..., ANGLES]), -1, -2) @ look_at_rotation(level)
        chosen[..., BETA] = np.arctan2(between[..., 0, 1] - between[..., 1, 0], between[..., 0, 0] + between[..., 1, 1])
        same = (chosen[..., [ALPHA, GAMMA]] == truth[..., [ALPHA, GAMMA]]).all(axis=-1)
        chosen[..., BETA] = np.where(same, truth[..., BETA], chosen[..., BETA])  # without rounding
    return chosen
