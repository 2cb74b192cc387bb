"""How sure one may be of each of two arms: by what is seen of it, and how that fits the masks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.metrics import OUT_OF_VIEW_SHARE
from surgbench.pair_objective import PairObjective
from surgbench.search.nearer import COARSE, ways
from surgbench.state import split_arms

# An arm of whose silhouette less is seen is behind the other: nothing tells of it.
LEAST_SEEN = 0.1


def arm_confidence(objective: PairObjective, state: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """How well each arm's visible part fits, and whether the arm is hidden.

    With a mask for each arm it is the intersection over union of both in the reference view. With one mask of both,
    pixels of it that no arm covers count for the arm that is nearer. It is 0 of an arm that is hidden: of whose
    silhouette less than a tenth is seen, or less than :data:`surgbench.metrics.OUT_OF_VIEW_SHARE` of the picture, or
    whose wrist and tips are all behind the other arm.

    Args:
        objective: Has observed the frame.
        state: ``(18,)`` an estimate.

    Returns:
        ``(2,)`` from 0 to 1, and ``(2,)`` bool.
    """
    view, scorer, camera = objective.views[0], objective.scorers[0], objective.camera
    own = view.change.states(state)
    observed = objective.own_masks(0) if objective.tells_apart else (view.reference,) * 2
    score = scorer.score(own[None], observed)
    area, common, whole = score.area[0], score.overlap[0], score.silhouette[0]
    seen = scorer.visibility.visible_masks(own)
    least = OUT_OF_VIEW_SHARE * camera.width * camera.height
    hidden = area < np.maximum(LEAST_SEEN * whole, least)
    hidden |= _tool_behind(objective, own, seen)
    if objective.tells_apart:
        areas = np.array([reference.area for reference in observed])
        missing = areas - common
        hidden |= areas / (camera.width * camera.height) < OUT_OF_VIEW_SHARE
    else:
        missing = np.array(_shared_out(observed[0].mask & ~(seen[0] | seen[1]), seen))
    confidence = common / np.maximum(area + missing, 1)
    return np.where(hidden, 0.0, confidence), hidden


def _tool_behind(objective: PairObjective, state: FloatArray, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether the pixels of an arm's wrist and of both of its tips, as far as in the picture, show the other arm."""
    behind = np.zeros(2, dtype=bool)
    camera = objective.camera
    for arm, own in enumerate(split_arms(state)):
        points = np.concatenate([objective.scene.instruments[arm].tips_cam(own), own[None, 3:6]])
        pixels = camera.project(points)
        pixels = np.rint(pixels[camera.contains(pixels)]).astype(int)
        rows, columns = np.minimum(pixels[:, 1], camera.height - 1), np.minimum(pixels[:, 0], camera.width - 1)
        behind[arm] = len(pixels) > 0 and bool(seen[1 - arm][rows, columns].all())
    return behind


def _shared_out(unexplained: Mask, seen: NDArray[np.bool_]) -> list[int]:
    """How many of the pixels of a mask that no arm explains are nearer to each arm."""
    coarse = unexplained[::COARSE, ::COARSE]
    if not coarse.any():
        return [0, 0]
    left, right = ways(seen)
    share = float((left <= right)[coarse].mean())
    total = int(np.count_nonzero(unexplained))
    return [round(share * total), round((1 - share) * total)]
