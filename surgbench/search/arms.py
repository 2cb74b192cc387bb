"""How sure one may be of each of two arms: by what is seen of it, and how that fits the masks."""

from __future__ import annotations

from typing import NamedTuple

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
# Of the overlap of wrist and jaws, in the confidence.
TOOL_POWER = 4


class ArmFit(NamedTuple):
    """How each of two arms fits a frame, ``(2,)`` each.

    Attributes:
        overlap: Intersection over union of what is seen of it and its mask, 0 of one that is hidden.
        confidence: From 0 to 1, no more than that.
        hidden: Nothing tells of it.
    """

    overlap: FloatArray
    confidence: FloatArray
    hidden: NDArray[np.bool_]


def fit_of_arms(objective: PairObjective, state: FloatArray) -> ArmFit:
    """How well each arm's visible part fits, how sure one may be of it, and whether it is hidden.

    With a mask for each arm the overlap is that of both in the reference view. With one mask of both, pixels of it that
    no arm covers count for the arm that is nearer. An arm is hidden of whose silhouette less than a tenth is seen, or
    less than :data:`surgbench.metrics.OUT_OF_VIEW_SHARE` of the picture, or whose wrist and tips are all behind the
    other arm.

    A long shaft in its place overlaps well, wherever the jaws are. So the confidence goes by wrist and jaws: by the
    share of them that is seen, and by how well that overlaps what the rest of the arm leaves of its mask, which is
    below 0.84 in 19 of 20 frames whose tips are more than 10 mm off (:data:`TOOL_POWER` makes that 0.5).

    Args:
        objective: Has observed the frame.
        state: ``(18,)`` an estimate.
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
    overlap = np.where(hidden, 0.0, common / np.maximum(area + missing, 1))
    confidence = overlap.copy()
    for arm, tool in enumerate(objective.tools):
        if tool is not None and not hidden[arm]:
            shown, fits = _tool_fit(tool.mask(split_arms(own)[arm]), seen[arm], observed[arm].mask, int(missing[arm]))
            confidence[arm] = min(overlap[arm], shown * fits**TOOL_POWER)
    return ArmFit(overlap, confidence, hidden)


def _tool_fit(tool: Mask, seen: Mask, mask: Mask, missing: int) -> tuple[float, float]:
    """Share of wrist and jaws that is seen, and its overlap with what of a mask the arm's shaft does not cover.

    Args:
        tool: ``(H, W)`` wrist and jaws.
        seen: Likewise what is seen of the arm.
        mask: Observed.
        missing: So many pixels of the arm's mask it does not cover.
    """
    shown = tool & seen
    whole, area, common = (int(np.count_nonzero(pixels)) for pixels in (tool, shown, shown & mask))
    return area / max(whole, 1), common / max(area + missing, 1)


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
