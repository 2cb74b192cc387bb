"""The time from one frame to the next, which in recordings is not always the same."""

from __future__ import annotations

import itertools

import numpy as np

from surgbench.geometry import FloatArray

# Time stamps that differ by less than this share of a step are regular: they are rounded.
REGULAR = 1e-6
# A hand does not go on as it did for longer than this.
STEADY_S = 0.5


def step_s(before_s: float, now_s: float, dt_s: float) -> float:
    """Seconds from one frame to the next.

    Args:
        before_s: Time stamp of the one.
        now_s: Time stamp of the other.
        dt_s: Seconds between frames as a rule.

    Returns:
        ``dt_s`` itself where the frames are as far apart as that, or their time stamps do not increase.

    Example:
        >>> from surgbench.timing import step_s
        >>> step_s(0.1, 0.2, 0.1), step_s(0.0, 0.5, 0.1)
        (0.1, 0.5)
    """
    step = now_s - before_s
    return step if step > 0 and abs(step - dt_s) > REGULAR * dt_s else dt_s


def steps_s(times_s: FloatArray, dt_s: float) -> FloatArray:
    """:func:`step_s` of each frame to the next, ``(T - 1,)``, from ``(T,)`` time stamps.

    Example:
        >>> import numpy as np
        >>> from surgbench.timing import steps_s
        >>> steps_s(np.array([0.0, 0.1, 0.2, 0.5]), 0.1).round(9)
        array([0.1, 0.1, 0.3])
    """
    return np.array([step_s(before, now, dt_s) for before, now in itertools.pairwise(times_s.tolist())])


def carried_s(step_s: float, dt_s: float) -> float:
    """For how much of a step a velocity is believed to go on, seconds; at least ``dt_s``."""
    return min(step_s, max(STEADY_S, dt_s))
