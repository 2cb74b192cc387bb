"""The share of a dataset that a row asks for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surgbench.suite.asked import RowRequest


def cut(row: RowRequest, lengths: Sequence[int]) -> int | None:
    """The row's limit of frames, where any unit is longer."""
    return row.frames if row.frames is not None and any(row.frames < length for length in lengths) else None


def spread(total: int, count: int | None) -> list[int]:
    """``count`` of ``total`` places, evenly from the first to the last; all where there are fewer, or for ``None``.

    On a dataset that ends with its fast sequences, and whose arms alternate, that takes some of each.
    """
    return sorted({round(place) for place in np.linspace(0, total - 1, min(count or total, total))})
