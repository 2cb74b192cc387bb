"""How well a detector finds tips, by numbers that mean the same for every detector.

A *pair* is what a detector returns. It is *right* if both points lie within 10 px of the tips, in an image 700 pixels
wide, and *false* otherwise. Masks are of two sorts: those on which a detector should find both tips (both show and are
at least 8 px apart), and the others, on which the tips cross, one is hidden, or one is outside the image. There no pair
is asked for; one that is right does no harm, and one that is false does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from surgbench.geometry import FloatArray
from surgbench.keypoints.labelled import LabelledMask

REFERENCE_WIDTH = 700
APART_PX = 8.0
RIGHT_PX = 10.0


@dataclass(frozen=True)
class Outcome:
    """What a detector made of one mask; pixels are those of an image 700 wide.

    Attributes:
        asked: Both tips show and are apart.
        errors_px: ``(2,)`` distance of each point from its tip, in the better of the two pairings; ``None`` without a
            pair.
    """

    asked: bool
    errors_px: FloatArray | None

    @property
    def right(self) -> bool:
        """A pair, and both points are near."""
        return self.errors_px is not None and bool((self.errors_px <= RIGHT_PX).all())

    @property
    def false(self) -> bool:
        """A pair that is not right."""
        return self.errors_px is not None and not self.right


@dataclass(frozen=True)
class Accuracy:
    """A summary.

    Attributes:
        masks: How many on which both tips are asked for.
        detected_percent: Share of these with a right pair.
        median_error_px: Over all points of the pairs on these masks, right or false.
        p95_error_px: The same, 95th percentile.
        other_masks: How many others.
        false_pair_percent: Share of the others with a false pair.
        all_false_pair_percent: Share of all masks with a false pair.
    """

    masks: int
    detected_percent: float | None
    median_error_px: float | None
    p95_error_px: float | None
    other_masks: int
    false_pair_percent: float | None
    all_false_pair_percent: float | None

    def as_dict(self) -> dict[str, float | int | None]:
        """Keys and values, numbers rounded to four digits."""
        return {key: round(value, 4) if isinstance(value, float) else value for key, value in asdict(self).items()}


def is_asked(example: LabelledMask) -> bool:
    """Whether a detector should find both tips: they show, and are apart."""
    scale = REFERENCE_WIDTH / example.mask.shape[1]
    return example.both_show and scale * example.apart_px >= APART_PX


def outcome(example: LabelledMask, pair: FloatArray | None) -> Outcome:
    """Compare a detector's answer with the truth.

    Args:
        example: The mask and its tips.
        pair: ``(2, 2)`` pixels of the mask, or ``None``.
    """
    scale = REFERENCE_WIDTH / example.mask.shape[1]
    return Outcome(is_asked(example), None if pair is None else scale * pair_errors(pair, example.tips_px))


def pair_errors(pair: FloatArray, tips_px: FloatArray) -> FloatArray:
    """Distance of each of two points from its tip, ``(2,)``, in the pairing with the smaller sum.

    A tip at or behind the camera plane (NaN) is infinitely far.
    """
    distances = np.linalg.norm(pair[:, None] - tips_px[None], axis=2)
    distances = np.where(np.isnan(distances), np.inf, distances)
    straight, crossed = distances[[0, 1], [0, 1]], distances[[0, 1], [1, 0]]
    return np.asarray(straight if straight.sum() <= crossed.sum() else crossed)


def accuracy(outcomes: Sequence[Outcome]) -> Accuracy:
    """Summarise outcomes; numbers of which there is nothing to take are ``None``."""
    asked = [one for one in outcomes if one.asked]
    others = [one for one in outcomes if not one.asked]
    errors = [one.errors_px for one in asked if one.errors_px is not None]
    pooled = np.concatenate(errors) if errors else None
    return Accuracy(
        masks=len(asked),
        detected_percent=_percent([one.right for one in asked]),
        median_error_px=None if pooled is None else float(np.median(pooled)),
        p95_error_px=None if pooled is None else float(np.percentile(pooled, 95)),
        other_masks=len(others),
        false_pair_percent=_percent([one.false for one in others]),
        all_false_pair_percent=_percent([one.false for one in outcomes]),
    )


def _percent(flags: Sequence[bool]) -> float | None:
    return 100.0 * float(np.mean(flags)) if flags else None
