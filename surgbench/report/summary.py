"""Means over sequences, and how far they spread."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surgbench.geometry import FloatArray


@dataclass(frozen=True)
class Summary:
    """One error over all sequences; ``None`` where there is nothing to take it of.

    Attributes:
        mean: Mean of the per-sequence means.
        std: Standard deviation over all frames together (of the population, as NumPy's default).
        sem: Standard error of ``mean`` over the sequences (sample standard deviation / √n); ``None`` for one.
    """

    mean: float | None
    std: float | None
    sem: float | None


def summarise(sequences: Sequence[Sequence[FloatArray]]) -> Summary:
    """Mean of per-sequence means, with the spread over frames and over sequences.

    Args:
        sequences: Per sequence its repeats, each an array of per-frame values of any shape (arms count as
            frames of their own). NaN is "no value"; a sequence without values does not count.

    Returns:
        The summary. A sequence's mean is the mean of its repeats' means, so that every sequence weighs the same.

    Example:
        Two sequences, run once each, whose means are 2 and 5; a frame has no value.

        >>> import numpy as np
        >>> from surgbench.report.summary import summarise
        >>> summary = summarise([[np.array([1.0, 3.0])], [np.array([5.0, np.nan])]])
        >>> summary.mean, round(summary.sem, 9)
        (3.5, 1.5)
        >>> round(summary.std, 3)  # of 1, 3 and 5
        1.633
    """
    means, values = [], []
    for repeats in sequences:
        finite = [array[~np.isnan(array)] for array in (np.asarray(r, dtype=np.float64) for r in repeats)]
        finite = [array for array in finite if array.size]
        if finite:
            means.append(float(np.mean([array.mean() for array in finite])))
            values.extend(finite)
    if not means:
        return Summary(None, None, None)
    sem = float(np.std(means, ddof=1) / np.sqrt(len(means))) if len(means) > 1 else None
    return Summary(float(np.mean(means)), float(np.std(np.concatenate(values))), sem)
