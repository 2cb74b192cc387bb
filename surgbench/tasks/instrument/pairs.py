"""What is measured of two arms in one picture beside the errors of each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from surgbench import metrics, pair_metrics
from surgbench.contract import Mask, all_but_same
from surgbench.geometry import FloatArray
from surgbench.references import reference_joint_errors
from surgbench.silhouette import Reference, VisibleScorer
from surgbench.tasks.instrument.records import (
    FAR_OFF_DOUBTED,
    HIDDEN_KNOWN,
    MASK_ARMS,
    OVERLAPS,
    RIGHT_WAY_ROUND,
    SWAPS,
)
from surgbench.tasks.instrument.units import UnitData

# The masks of a recording's arms are taken to be named wrongly where the other way round leaves so little of the error.
EXCHANGED_SHARE = 0.7
# Its readings likewise, where wrists are off by more than trackers that hold the right arm are.
EXCHANGED_READINGS_SHARE, OFF_RAD = 0.5, 0.15


def hidden(data: UnitData, frames: int) -> NDArray[np.bool_]:
    """In which of a unit's first frames wrist and jaws of an arm are hidden, ``(frames, arms)``.

    In none where the data do not say, and of an arm that is tracked alone.
    """
    told = [data.sequence.visibility(arm) for arm in data.unit.arms]
    return np.stack(
        [
            np.zeros(frames, dtype=bool)
            if one is None or len(told) == 1
            else one["tool_visible"][:frames] <= pair_metrics.HIDDEN_SHARE
            for one in told
        ],
        axis=1,
    )


def pair_errors(
    data: UnitData,
    states: FloatArray,
    tip_errors: FloatArray,
    lost: NDArray[np.bool_],
    confidence: FloatArray,
    away: NDArray[np.bool_],
) -> dict[str, FloatArray]:
    """What a pair's record has besides of a dataset with truth.

    Args:
        data: Of two arms, with truth.
        states: ``(T, 2, 9)`` estimates.
        tip_errors: ``(T, 2)`` metres.
        lost: ``(T, 2)``.
        confidence: ``(T, 2)``.
        away: ``(T, 2)`` out of view.
    """
    assert data.truth is not None
    behind = hidden(data, len(states))
    places = [
        np.stack([instrument.tips_cam(values[:, arm]) for arm, instrument in enumerate(data.instruments)], axis=1)
        for values in (states, data.truth[: len(states)])
    ]
    turned = pair_metrics.exchanged(pair_metrics.tip_distances(*places))
    counts = ~(away | behind).any(axis=1)
    out_of_it = pair_metrics.right_way_round(turned, away | behind)
    errors = {
        SWAPS: np.array([pair_metrics.swaps(turned, counts)], dtype=np.float64),
        OVERLAPS: np.array([len(out_of_it)], dtype=np.float64),
        FAR_OFF_DOUBTED: np.where(away, np.nan, pair_metrics.far_off_doubted(tip_errors, confidence, lost)),
    }
    if len(out_of_it):
        errors[RIGHT_WAY_ROUND] = out_of_it
    if behind.any():
        errors[HIDDEN_KNOWN] = pair_metrics.hidden_known(tip_errors, lost, behind & ~away)
    return errors


def exchanged_readings(data: UnitData, states: FloatArray, lost: NDArray[np.bool_]) -> str | None:
    """One line where the arms of a recording have each other's joint readings; ``None`` where nothing is odd.

    Args:
        data: A unit.
        states: ``(T, arms, 9)`` estimates.
        lost: ``(T, arms)``; these say nothing.
    """
    if data.truth is not None or len(data.unit.arms) != 2:
        return None
    readings = [own for own in map(data.sequence.readings, data.unit.arms) if own is not None]
    if len(readings) != 2:
        return None

    def off(order: tuple[int, int]) -> float:
        errors = []
        for place, (instrument, other) in enumerate(zip(data.instruments, order, strict=True)):
            own, read = ~lost[:, place], readings[other]
            found = reference_joint_errors(
                states[own, place],
                read[: len(states)][own],
                instrument.search_limits,
                instrument.observed,
                instrument.symmetry,
            )
            errors.append(found[:, :2].ravel())
        known = np.concatenate(errors)
        known = known[np.isfinite(known)]
        return float(known.mean()) if known.size else 0.0

    straight, turned = off((0, 1)), off((1, 0))
    if straight < OFF_RAD or turned > EXCHANGED_READINGS_SHARE * straight:
        return None
    return (
        f"the wrists' joint readings fit far better the other way round ({turned:.2f} rad off instead of "
        f"{straight:.2f}): left and right are exchanged, in the readings or in the masks"
    )


class OwnMasks:
    """Holds what is seen of each arm against its own mask: the clean one, or in a recording what somebody segmented.

    Args:
        data: A unit of two arms.
    """

    def __init__(self, data: UnitData) -> None:
        kinds = data.sequence.instance_kinds
        self._read: Callable[[str, int], Mask] = data.sequence.mask if data.truth is None else data.sequence.clean_mask
        self._kinds: tuple[str, ...] = kinds or ()
        self._scorer = VisibleScorer(data.instruments, data.camera)
        self._straight: dict[int, FloatArray] = {}
        self._turned: dict[int, FloatArray] = {}
        self._alike = self._shown = 0
        self._seen = np.zeros(2, dtype=bool)

    @classmethod
    def of(cls, data: UnitData) -> OwnMasks | None:
        """``None`` where there are no such masks."""
        two = len(data.unit.arms) == 2 and data.sequence.instance_kinds is not None
        return cls(data) if two else None

    def measure(self, frame: int, state: FloatArray) -> None:
        """One frame's estimate, ``(18,)``."""
        masks = [self._read(kind, frame) for kind in self._kinds]
        self._seen |= [bool(mask.mean() >= metrics.OUT_OF_VIEW_SHARE) for mask in masks]
        if any(mask.any() for mask in masks):
            self._shown += 1
            self._alike += all_but_same(*masks)
        for kept, order in ((self._straight, masks), (self._turned, masks[::-1])):
            references = [Reference(mask) for mask in order]
            score = self._scorer.score(state[None], references)
            areas = np.array([reference.area for reference in references])
            kept[frame] = metrics.mask_error(score.area[0], areas, score.overlap[0])

    def errors(self, away: NDArray[np.bool_]) -> dict[str, FloatArray]:
        """``(T, 2)``, NaN where an arm is out of view, and before tracking begins."""
        values = np.full(away.shape, np.nan)
        for frame, error in self._straight.items():
            values[frame] = error
        return {MASK_ARMS: np.where(away, np.nan, values)}

    def hint(self, arms: tuple[str, ...]) -> str | None:
        """One line on masks that cannot be meant as they are; ``None`` where nothing is odd."""
        if self._shown and self._alike == self._shown:
            return f"the masks of both arms are (nearly) the same in all {self._shown} frames: they tell no arms apart"
        unseen = [arm for arm, seen in zip(arms, self._seen, strict=True) if not seen]
        if self._shown and unseen:
            return f"the {unseen[0]} arm's own mask shows no instrument in any frame"
        if not self._shown:
            return None
        straight, turned = (float(np.mean([*values.values()])) for values in (self._straight, self._turned))
        if turned < EXCHANGED_SHARE * straight:
            return (
                f"the masks of the arms fit far better the other way round (mask error {turned:.2f} instead of "
                f"{straight:.2f}): left and right are exchanged, in the masks or in the start"
            )
        return None
