"""Points on a sequence's first picture: read from a file, or taken from where an estimate puts the instruments."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from surgbench.camera import Camera
from surgbench.camera.change_of_view import ChangeOfView
from surgbench.contract import Mask, Scene, View
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.mask_sources import Prompts
from surgbench.prompts_file import OWN_VIEW, Pictures, read_prompts
from surgbench.silhouette import SilhouetteEvaluator, VisibilityEvaluator
from surgbench.state import split_arms

__all__ = ["OWN_VIEW", "Pictures", "check_on_instrument", "prompts_from_state", "read_prompts"]

# A link of which less than this shows around a pixel gets no point: its edge is as near as an estimate may be off.
LEAST_DEPTH_PX = 2.0
# A state of which no camera near the reference camera sees anything: straight ahead, a long way behind it.
_NOT_SEEN = np.array([0, 0, 0, 0, 0, -10.0, 0, 0, 0])
# Pixels that lie so deep, as a share of the deepest, are taken to be in a link's middle.
_DEEP = 0.9


def prompts_from_state(scene: Scene, view: View, state: FloatArray) -> Prompts:
    """Points where an estimate puts the arms in a view: one on each link, in the middle of what shows of it alone.

    They lie at least ``LEAST_DEPTH_PX`` from the outline of what shows of their arm and from the picture's border, so
    that an estimate may be off by as much.

    Args:
        scene: Gives the instruments.
        view: Gives the camera and where it is.
        state: ``(9 * arms,)`` in the frame of the reference camera.

    Returns:
        Points of each arm, all inside; none of an arm that the view does not show, or only a sliver of, or whose state
        is not finite.

    Raises:
        ValueError: The state is of another number of arms.

    Example:
        >>> import numpy as np
        >>> from surgbench.prompts import prompts_from_state
        >>> from surgbench.tasks.instrument.conformance.scenes import make_play
        >>> play = make_play()
        >>> prompts = prompts_from_state(play.scene, play.scene.views[0], play.truth[0])
        >>> u, v = prompts.points_px[0].astype(int).T
        >>> bool(play.observations[0].mask[v, u].all())
        True
    """
    arms = split_arms(state)
    known = np.isfinite(arms).all(axis=1, keepdims=True)
    here = ChangeOfView(view.T_view_cam).states(np.where(known, arms, _NOT_SEEN).ravel())
    visible = VisibilityEvaluator(scene.instruments, view.camera).visible_masks(here)
    points = [
        _on_links(instrument, view.camera, own, mask)
        for instrument, own, mask in zip(scene.instruments, split_arms(here), visible, strict=True)
    ]
    return Prompts(points, [np.ones(len(one), dtype=bool) for one in points])


def check_on_instrument(prompts: Prompts, mask: Mask, instance_masks: Sequence[Mask] | None = None) -> str | None:
    """Whether points that are said to be on an arm are, where it is known.

    Args:
        prompts: The points.
        mask: ``(height, width)`` bool: what truly shows of the instruments.
        instance_masks: What truly shows of each arm, where that is known too.

    Returns:
        One line on the first point that is on something else; ``None`` where there is none.

    Example:
        >>> import numpy as np
        >>> from surgbench.mask_sources import Prompts
        >>> from surgbench.prompts import check_on_instrument
        >>> mask = np.zeros((120, 160), dtype=bool)
        >>> mask[50:70] = True
        >>> points = [np.array([[80.0, 60], [80, 75]])]
        >>> check_on_instrument(Prompts(points, [np.array([True, False])]), mask) is None
        True
        >>> check_on_instrument(Prompts(points, [np.array([True, True])]), mask)
        'the point (80, 75) of arm 1 lies on the background'
    """
    height, width = mask.shape
    for arm, (points, inside) in enumerate(zip(prompts.points_px, prompts.inside, strict=True)):
        for u, v in np.asarray(points)[np.asarray(inside, dtype=bool)]:
            # Half-way between two pixels a point is of the one to the left, or above.
            column, row = (min(max(math.ceil(x - 0.5), 0), size - 1) for x, size in ((u, width), (v, height)))
            if not mask[row, column]:
                return f"the point ({u:g}, {v:g}) of arm {arm + 1} lies on the background"
            if instance_masks is not None and not instance_masks[arm][row, column]:
                return f"the point ({u:g}, {v:g}) of arm {arm + 1} lies on the other arm"
    return None


def _on_links(instrument: Instrument, camera: Camera, state: FloatArray, visible: Mask) -> FloatArray:
    """A point ``(n, 2)`` on each link of an arm, where no other link is; if that is too little, one on the whole."""
    links = [
        SilhouetteEvaluator([Instrument(instrument.spec, {name: mesh})], camera).mask(state)
        for name, mesh in instrument.meshes.items()
    ]
    alone = np.sum(links, axis=0) == 1
    points = [point for link in links if (point := _middle(visible & link & alone)) is not None]
    whole = _middle(visible)
    if not points and whole is not None:
        points = [whole]
    return np.array(points, dtype=np.float64).reshape(-1, 2)


def _middle(mask: Mask) -> tuple[float, float] | None:
    """The pixel (u, v) in the middle of the deepest of a mask: all along a shaft's axis they are as deep.

    ``None`` where none is deep enough.
    """
    # With a border of nothing, so that the middle of what the picture cuts off is a middle in the picture.
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    if depth.max() < LEAST_DEPTH_PX:
        return None
    rows, columns = np.nonzero(depth >= _DEEP * depth.max())
    nearest = int(np.argmin((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2))
    return float(columns[nearest]), float(rows[nearest])
