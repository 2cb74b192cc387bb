"""Which part of a mask of all instruments in the picture belongs to the arms that a tracker follows."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.camera.change_of_view import ChangeOfView
from surgbench.contract import Mask, Observation, Scene, View
from surgbench.geometry import FloatArray
from surgbench.mask_sources import Prompts
from surgbench.silhouette import SilhouetteEvaluator

# Lengths in thicknesses, which are those of shafts as a rule.
GATE = 0.2  # what is nearer to the silhouette is not looked at as another instrument
FAR = 0.6  # what reaches farther away is another instrument, if it has a shaft
FAR_TOO = 0.35  # and so is, where there is one, what reaches as far: its end on the silhouette's other side
LEAST_GATE_PX = 3.0
# Shares of the silhouette's area.
LEAST_OTHER = 0.06  # that another instrument covers, which is to be cut off
LEAST_COVERED = 0.05  # that the mask covers, where the prediction is to be believed
WELL_COVERED = 0.97  # of which a silhouette is not moved
MOSTLY = 0.5  # of a part that lies by the silhouette, if it is its arm's
LARGE = 0.1  # of the largest part's area
ALONG = 0.6  # of the silhouette's outline that lies along the mask's, if it is where the instrument is
ALONG_PX = 2.0
REACH = 0.06  # of the picture's width, by which a predicted silhouette is moved
GAIN = 0.03  # of the silhouette's area, that the mask covers more of it then
COARSE = 2  # pixels a cell where it is moved
WIDTH_PX = 350  # of the picture that all this is done in, and whose pixels are meant


class OwnArms:
    """Picks what belongs to the scene's arms out of a mask of all instruments; there is one for each view.

    A scene of two arms keeps everything. A scene of one keeps the connected parts by the silhouette of the predicted
    state. Where another instrument hangs on them, a large piece beyond the silhouette that comes from the border of the
    picture, each pixel goes to the nearer of the silhouette and that piece. The silhouette is moved by a few pixels
    first to where the mask covers most of it. Before there is a prediction, prompts decide, then what was picked last;
    where neither is there, nothing can be told and everything stays.

    Args:
        scene: The sequence's constants.
        view: The camera's view.
        prompts: Points in the first picture that say which instrument is meant.

    Example:
        Two bars, of which the points mean the upper one:

        >>> from dataclasses import replace
        >>> import numpy as np
        >>> from surgbench.mask_sources import Prompts
        >>> from surgbench.tasks.instrument.conformance.scenes import make_play
        >>> from surgbench.trackers.masks.own_arms import OwnArms
        >>> play = make_play(frames=1)
        >>> view = play.scene.views[0]
        >>> both = np.zeros_like(view.mask)
        >>> both[10:20] = both[40:50] = True
        >>> upper = Prompts([np.array([[30.0, 15.0]])], [np.array([True])])
        >>> first = replace(play.observations[0], start=np.zeros(9))
        >>> picked = OwnArms(play.scene, view, upper).pick(both, first, view)
        >>> bool(picked[10:20].all()), bool(picked[40:50].any())
        (True, False)
    """

    def __init__(self, scene: Scene, view: View, prompts: Prompts | None = None) -> None:
        self._all = scene.arms > 1
        self._silhouettes = SilhouetteEvaluator(scene.instruments, view.camera)
        self._change = ChangeOfView(view.T_view_cam)
        self._prompts = prompts
        self._last: Mask | None = None

    def pick(self, mask: Mask, observation: Observation, view: View) -> Mask:
        """What of a mask is the scene's.

        Args:
            mask: ``(height, width)`` bool: all instruments in the view's picture.
            observation: The frame; ``start`` all zeros or not finite says that there is no estimate yet.
            view: The view.

        Returns:
            ``(height, width)`` bool, part of the mask.
        """
        if self._all:
            return mask
        prompts, self._prompts = self._prompts, None
        predicted = self.predicted(observation)
        small = reduced(mask)
        picked = small
        if prompts is not None:
            scale = small.shape[1] / mask.shape[1]
            points = np.concatenate(list(prompts.points_px)) * scale
            picked = by_points(small, points, np.concatenate(list(prompts.inside)))
        if predicted is not None:
            picked = self._by_prediction(picked if picked.any() else small, reduced(predicted))
        elif prompts is None and self._last is not None:
            picked = by_silhouette(small, self._last)
        if picked.any():
            self._last = picked
        height, width = mask.shape
        kept = cv2.resize(picked.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
        return np.asarray(mask & (kept > 0))

    def predicted(self, observation: Observation) -> Mask | None:
        """The silhouette of the predicted state in this view, ``(height, width)``; ``None`` without an estimate."""
        start = np.asarray(observation.start, np.float64)
        if not start.any() or not np.isfinite(start).all():
            return None
        state: FloatArray = self._change.states(start[None])[0]
        return np.asarray(self._silhouettes.mask(state))

    def _by_prediction(self, mask: Mask, predicted: Mask) -> Mask:
        area = np.count_nonzero(predicted)
        if area:
            moved = moved_onto(predicted, mask)
            if np.count_nonzero(moved & mask) >= LEAST_COVERED * area:
                return by_silhouette(mask, moved)
        if self._last is not None:
            if (self._last & mask).any():
                return by_silhouette(mask, self._last)
            return nearest_parts(mask, self._last)
        return nearest_parts(mask, predicted) if area else np.zeros_like(mask)  # it is not in the picture


def reduced(mask: Mask) -> Mask:
    """A mask in so many times smaller a picture that this is about ``WIDTH_PX`` wide; a pixel is in it if a part is."""
    height, width = mask.shape
    step = max(1, round(width / WIDTH_PX))
    if step == 1:
        return mask
    size = -(-width // step), -(-height // step)
    return np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0)


def by_points(mask: Mask, points_px: FloatArray, inside: NDArray[np.bool_]) -> Mask:
    """Connected parts that have a point; of one with points of both kinds the pixels nearer to those inside.

    Args:
        mask: ``(height, width)``.
        points_px: ``(n, 2)`` pixels (u, v).
        inside: ``(n,)``: the point is on what is to be picked.

    Returns:
        ``(height, width)``; the part nearest to the points inside where they all miss the mask, and without any such
        point all parts that have none outside.
    """
    height, width = mask.shape
    count, labels = cv2.connectedComponents(mask.astype(np.uint8))
    pixels = np.rint(points_px).astype(int).clip(0, (width - 1, height - 1))
    own = {kind: labels[pixels[inside == kind, 1], pixels[inside == kind, 0]] for kind in (True, False)}
    refused = set(own[False][own[False] > 0].tolist())
    if not inside.any():
        return np.asarray(mask & ~np.isin(labels, list(refused)))
    meant = set(own[True][own[True] > 0].tolist())
    if not meant:
        away = np.ones(mask.shape, np.uint8)
        away[pixels[inside, 1], pixels[inside, 0]] = 0
        distance = cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        distance[~mask | np.isin(labels, list(refused))] = np.inf
        at = np.unravel_index(np.argmin(distance), distance.shape)
        return np.asarray((labels == labels[at]) & mask & np.isfinite(distance[at]))
    picked: Mask = np.isin(labels, list(meant))
    if meant & refused and count > 1:
        v, u = np.nonzero(np.isin(labels, list(meant & refused)))
        squares = ((np.stack([u, v], 1)[:, None] - points_px[None]) ** 2).sum(2)
        picked[v, u] = inside[squares.argmin(1)]
    return np.asarray(picked | _pieces_near(np.asarray(labels, np.int32), count, picked, points_px[~inside]))


def _pieces_near(labels: NDArray[np.int32], count: int, picked: Mask, refused_px: FloatArray) -> Mask:
    """Small parts by a picked one, as a joint or a marker cuts them off, that no point refuses."""
    if not picked.any():
        return picked
    sizes = np.bincount(labels.ravel(), minlength=count)
    near = np.bincount(labels[distance_px(picked) <= GATE * thickness_px(picked)], minlength=count) > 0
    near &= sizes < LARGE * np.count_nonzero(picked)
    u, v = np.rint(refused_px).astype(int).clip(0, np.array(labels.shape[::-1]) - 1).T
    near[labels[v, u]] = False
    near[0] = False
    return np.asarray(near[labels])


def by_silhouette(mask: Mask, silhouette: Mask) -> Mask:
    """The connected parts of a mask that lie by a silhouette, without what hangs on them of another instrument.

    Args:
        mask: ``(height, width)``.
        silhouette: ``(height, width)``, not empty: about where the instrument is.
    """
    area, thick = np.count_nonzero(silhouette), thickness_px(silhouette)
    gate = max(LEAST_GATE_PX, GATE * thick)
    distance = distance_px(silhouette)
    near = distance <= gate
    count, labels = cv2.connectedComponents(mask.astype(np.uint8))
    sizes = np.bincount(labels.ravel(), minlength=count)
    by = np.bincount(labels[near], minlength=count)
    covers = np.bincount(labels[silhouette], minlength=count)
    covers[0] = 0
    taken = by >= MOSTLY * sizes
    taken |= covers >= MOSTLY * area
    taken[np.argmax(covers)] = True
    taken[0] = False
    picked: Mask = taken[labels]
    if shafts(picked, gate) < 2 and along(silhouette, picked, ALONG_PX) < ALONG:
        return picked
    others = _others(picked & ~near, distance, thick, LEAST_OTHER * area)
    if others is None or np.count_nonzero(others) <= np.count_nonzero(silhouette & ~picked):
        return picked  # as much is missing: the silhouette is not where the instrument is
    own: Mask = picked & (distance <= distance_px(others))
    return own


def _others(beyond: Mask, distance: FloatArray, thick_px: float, least_px: float) -> Mask | None:
    """Pieces beyond the gate that are another instrument's."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(beyond.astype(np.uint8))
    farthest = np.zeros(count)
    for label in 1 + np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] >= least_px):
        farthest[label] = distance[labels == label].max()
    other = farthest > FAR * thick_px
    if not other.any():
        return None
    return np.asarray((farthest > FAR_TOO * thick_px)[labels])


def moved_onto(silhouette: Mask, mask: Mask) -> Mask:
    """The silhouette where a mask covers most of it, moved by no more than ``REACH``."""
    if np.count_nonzero(silhouette & mask) >= WELL_COVERED * np.count_nonzero(silhouette):
        return silhouette
    height, width = mask.shape
    size = max(1, width // COARSE), max(1, height // COARSE)
    small = [cv2.resize(one.astype(np.float32), size, interpolation=cv2.INTER_AREA) for one in (silhouette, mask)]
    cells = max(1, round(REACH * size[0]))
    # What a shift moves out of the picture is not covered: else any silhouette would be best outside.
    framed = cv2.copyMakeBorder(small[1], cells, cells, cells, cells, cv2.BORDER_CONSTANT)
    covered = cv2.matchTemplate(framed, small[0], cv2.TM_CCORR)
    dv, du = np.mgrid[-cells : cells + 1, -cells : cells + 1]
    covered -= 0.02 * small[0].sum() * np.hypot(du, dv) / cells  # of places alike the nearest
    best = int(np.argmax(covered))
    if covered.flat[best] < covered[cells, cells] + GAIN * small[0].sum():
        return silhouette
    shift = np.array([[1, 0, COARSE * du.flat[best]], [0, 1, COARSE * dv.flat[best]]], np.float64)
    moved = cv2.warpAffine(
        silhouette.astype(np.uint8), shift, (width, height), flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(moved > 0)


def nearest_parts(mask: Mask, reference: Mask) -> Mask:
    """Of a mask's large parts that nearest to a reference, those from another side of the picture last.

    Args:
        mask: ``(height, width)``.
        reference: ``(height, width)``, not empty: where the instrument was, or was believed to be.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if count < 2:
        return mask
    distance = distance_px(reference)
    areas = stats[1:, cv2.CC_STAT_AREA]
    farness = np.full(count, np.inf)
    for label in 1 + np.flatnonzero(areas >= LARGE * areas.max()):
        part = labels == label
        farness[label] = distance[part].min()
        if not (sides(part) & sides(reference)).any():
            farness[label] += np.hypot(*mask.shape) / 2
    return np.asarray(labels == int(np.argmin(farness)))


def shafts(mask: Mask, gap_px: float) -> int:
    """At how many places a mask reaches the border of the picture, gaps of no more than some pixels not counted."""
    around = np.concatenate([mask[0], mask[1:, -1], mask[-1, -2::-1], mask[-2:0:-1, 0]])
    at = np.flatnonzero(around)
    gaps = np.diff(at, append=at[:1] + len(around)) if len(at) else at
    return max(int(np.count_nonzero(gaps > gap_px + 1)), min(len(at), 1))


def along(silhouette: Mask, mask: Mask, within_px: float) -> float:
    """Share of a silhouette's outline that has an outline of a mask nearby, the picture's border not counted."""
    own, other = outline(silhouette), outline(mask)
    if not own.any() or not other.any():
        return 0.0
    return float((distance_px(other)[own] <= within_px).mean())


def outline(mask: Mask) -> Mask:
    """``(height, width)`` the pixels of a mask that have a neighbour in the picture that is none of its."""
    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8))  # as if the mask went on beyond the picture
    return np.asarray(mask & (inner == 0))


def sides(mask: Mask) -> NDArray[np.bool_]:
    """Whether a mask reaches the left, right, upper and lower border of the picture."""
    return np.array([mask[:, 0].any(), mask[:, -1].any(), mask[0].any(), mask[-1].any()])


def distance_px(mask: Mask) -> FloatArray:
    """``(height, width)`` pixels to the nearest pixel of a mask that is not empty; 0 in it."""
    away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(away, np.float64)


def thickness_px(mask: Mask) -> float:
    """Diameter of the largest disc in a mask, pixels; what lies beyond the picture counts as mask."""
    return 2.0 * float(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5).max())
