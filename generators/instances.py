"""Masks of what is seen of each arm, as segmentations give them, and in which frames they confuse the arms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surgbench.generators.sections import Instances


def swapped_frames(settings: Instances, frames: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """In which frames the arms' masks are exchanged, ``(frames,)``.

    Runs of swapped frames alternate with runs of others, whose mean length makes the rate; a sequence begins anywhere
    in them.
    """
    swapped = np.zeros(frames, dtype=bool)
    if settings.swap_rate == 0.0:
        return swapped
    low, high = settings.swap_frames
    sound = 0.5 * (low + high) * (1.0 / settings.swap_rate - 1.0)
    # So far before the first frame that nothing of how it began is left.
    at = -20.0 * (high + sound)
    while at < frames:
        at += rng.exponential(sound)
        run = int(rng.integers(low, high, endpoint=True))
        swapped[max(round(at), 0) : max(round(at) + run, 0)] = True
        at += run
    return swapped


def told_apart(noisy: NDArray[np.bool_], clean: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.bool_]:
    """Masks of which no two have a pixel in common.

    Args:
        noisy: ``(2, height, width)``, which may.
        clean: ``(2, height, width)``, which do not. A pixel of both noisy masks goes to the arm that it is of; one
            of neither goes to one arm, the same in all of the frame.
        rng: The only source of randomness.
    """
    favoured = int(rng.integers(2))
    both = noisy[0] & noisy[1]
    owner = np.where(clean[0], 0, np.where(clean[1], 1, favoured))
    parted: NDArray[np.bool_] = noisy & ~(both & (owner != np.arange(2)[:, None, None]))
    return parted
