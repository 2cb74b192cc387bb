"""Time lost and regained: from when an estimate is far off until it is right again, whatever its tracker says."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surgbench.report.column import Column
from surgbench.report.field import count, keys, number
from surgbench.report.row import Row

LOSS_COLUMNS = (*number("time_lost_share"), *count("losses", "regained"), *number("frames_to_regain"))
# Columns that tables are read by, where anything was lost.
SHOWN_LOSSES = (
    Column("time_lost_share", "time lost", "%", 1, 100.0, short="lost\n%", best=True, unless_zero=True),
    Column("frames_to_regain", "frames to regain", "", 1, short="to\nregain"),
)


@dataclass(frozen=True)
class Losses:
    """What was lost in one run.

    Attributes:
        frames: How many have an error.
        lost: In how many of these it is lost.
        taken: Frames with an error of each loss, from the first that is far off to before the first that is right, or
            to the last: a lower bound then.
        regained: How many losses ended.
    """

    frames: int
    lost: int
    taken: tuple[int, ...]
    regained: int


def losses(errors: ArrayLike, beyond: float, within: float) -> Losses:
    """When something is lost, and regained.

    Args:
        errors: ``(T,)``; frames without a value (NaN) are passed over.
        beyond: Lost from the first frame whose error is above this ...
        within: ... to before the next one whose error is no larger than this.

    Returns:
        Counts of frames.

    Example:
        Lost in the second frame, still not right in the third, regained in the fifth, lost again in the last:

        >>> from surgbench.report.losses import losses
        >>> losses([1, 12, 8, float("nan"), 4, 8, 11], beyond=10, within=5)
        Losses(frames=6, lost=3, taken=(2, 1), regained=1)
    """
    values = np.asarray(errors, dtype=np.float64)
    known = values[~np.isnan(values)]
    taken: list[int] = []
    lost, regained = False, 0
    for value in known:
        if lost and value <= within:
            lost, regained = False, regained + 1
        elif not lost and value > beyond:
            lost = True
            taken.append(0)
        if lost:
            taken[-1] += 1
    return Losses(len(known), sum(taken), tuple(taken), regained)


def loss_row(sequences: Iterable[Sequence[Losses]]) -> Row:
    """A row's ``LOSS_COLUMNS``; empty where no frame has an error.

    Args:
        sequences: Of each sequence its runs: repeats, and arms of each.
    """
    found = [known for own in sequences if (known := [one for one in own if one.frames])]
    if not found:
        return dict.fromkeys(keys(LOSS_COLUMNS))
    taken = [[float(np.median(one.taken)) for one in own if one.taken] for own in found]
    means = [float(np.mean(own)) for own in taken if own]
    return {
        "time_lost_share": float(np.mean([np.mean([one.lost / one.frames for one in own]) for own in found])),
        "losses": sum(len(one.taken) for own in found for one in own),
        "regained": sum(one.regained for own in found for one in own),
        "frames_to_regain": float(np.mean(means)) if means else None,
    }
