"""Which of several arms is seen at each pixel, and how far away it is.

An arm's own silhouette is the evaluator's. Where silhouettes overlap, the arm whose surface is nearest there is
seen, pixel by pixel: arms may cross, or even run through each other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surgbench.camera import NEAR_M, Camera
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.silhouette.contour import place_links
from surgbench.silhouette.depths import nearest_surface, place_body
from surgbench.silhouette.evaluator import SilhouetteEvaluator
from surgbench.silhouette.layout import Lens, assemble, lens
from surgbench.state import STATE_SIZE, split_arms

Box = tuple[int, int, int, int]


class _Arm:
    """The silhouette of one arm alone, and where its body is."""

    def __init__(self, instrument: Instrument, camera: Camera, near_m: float) -> None:
        self.evaluator = SilhouetteEvaluator([instrument], camera, near_m=near_m)
        self._links, self.bodies, self.mesh = assemble([instrument])

    def place(self, state: FloatArray, lens: Lens) -> tuple[FloatArray, FloatArray]:
        """All vertices in the camera frame, ``(V, 3)`` metres, and as seen, ``(V, 3)`` pixels and inverse depth."""
        points, seen = np.empty((2, len(self.mesh.x), 3))
        pose = np.empty((len(self._links.parent), 3, 4))
        place_links(np.ascontiguousarray(state), self._links, pose)
        for b in range(len(self.bodies.link)):
            place_body(b, pose, self.bodies, self.mesh, lens, points, seen)
        return points, seen


class VisibilityEvaluator:
    """Tells the arms of one image apart.

    Args:
        instruments: One per arm; states have ``9 * len(instruments)`` components.
        camera: The view.
        near_m: Surfaces nearer to the camera plane are not seen. A solid that the near plane cuts is seen there.

    Attributes:
        arms: The silhouette and the body of each arm alone.
        lens: The camera, as compiled functions take it.

    Raises:
        ValueError: A link's mesh is not closed.

    Example:
        Two shafts that lie level across the whole image, one behind the other; the nearer one hides it.

        >>> import numpy as np
        >>> from surgbench.camera import Camera
        >>> from surgbench.instrument import load_instrument
        >>> from surgbench.silhouette import VisibilityEvaluator
        >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
        >>> visibility = VisibilityEvaluator([load_instrument("large_needle_driver")] * 2, camera)
        >>> states = [0, 0, np.pi / 2, 0.08, 0, 0.16, 0, 0, 0] + [0, 0, np.pi / 2, 0.08, 0, 0.13, 0, 0, 0]
        >>> visibility.silhouettes(states).sum(axis=(1, 2)), visibility.visible_masks(states).sum(axis=(1, 2))
        (array([1760, 2080]), array([   0, 2080]))
        >>> visibility.front_fractions(states)
        array([0., 1.])
    """

    def __init__(self, instruments: Sequence[Instrument], camera: Camera, near_m: float = NEAR_M) -> None:
        if not instruments:
            raise ValueError("at least one instrument is needed, one per arm")
        self.camera = camera
        self.arms = [_Arm(instrument, camera, near_m) for instrument in instruments]
        self.lens = lens(camera, near_m)

    def silhouettes(self, state: ArrayLike) -> NDArray[np.bool_]:
        """Each arm's silhouette as if it were alone.

        Args:
            state: ``(9 * arms,)``; one that is not finite covers nothing.

        Returns:
            ``(arms, H, W)``; their union is the mask of a :class:`SilhouetteEvaluator` of all arms.

        Raises:
            ValueError: Wrong shape.
        """
        states = self._split(state)
        if not np.isfinite(states).all():
            return np.zeros((len(states), self.camera.height, self.camera.width), dtype=bool)
        return np.stack([arm.evaluator.mask(own) for arm, own in zip(self.arms, states, strict=True)])

    def visible_masks(self, state: ArrayLike) -> NDArray[np.bool_]:
        """Where each arm is seen and not hidden by another.

        Args:
            state: ``(9 * arms,)``.

        Returns:
            ``(arms, H, W)``: no pixel belongs to two arms, and the union is that of the silhouettes. Of arms at the
            same depth the first is seen.

        Raises:
            ValueError: Wrong shape.
        """
        return self._resolve(self._split(state), self.silhouettes(state))

    def depths_m(self, state: ArrayLike) -> FloatArray:
        """Depth of each arm's nearest surface as if it were alone.

        Args:
            state: ``(9 * arms,)``.

        Returns:
            ``(arms, H, W)`` metres along the camera's z at the pixel centres, ``near_m`` where the ray enters the arm
            through the near plane, and inf outside the arm's silhouette.

        Raises:
            ValueError: Wrong shape.
        """
        silhouettes = self.silhouettes(state)
        everywhere = 0, self.camera.height, 0, self.camera.width
        return self._depths(self._split(state), silhouettes, everywhere)

    def front_fractions(self, state: ArrayLike) -> FloatArray:
        """The depth order in short: in which part of the pixels that several arms cover each arm is in front.

        Args:
            state: ``(9 * arms,)``.

        Returns:
            ``(arms,)``, sum 1; NaN where no two arms overlap.

        Raises:
            ValueError: Wrong shape.
        """
        silhouettes = self.silhouettes(state)
        in_front = self._resolve(self._split(state), silhouettes) & _overlap(silhouettes)
        pixels = np.count_nonzero(in_front, axis=(1, 2))
        return pixels / pixels.sum() if pixels.any() else np.full(len(pixels), np.nan)

    def _split(self, state: ArrayLike) -> FloatArray:
        array = np.asarray(state, dtype=np.float64)
        if array.shape != (STATE_SIZE * len(self.arms),):
            raise ValueError(f"state must have shape ({STATE_SIZE * len(self.arms)},); got {array.shape}")
        return split_arms(array)

    def _resolve(self, states: FloatArray, silhouettes: NDArray[np.bool_]) -> NDArray[np.bool_]:
        overlap = _overlap(silhouettes)
        box = _bounds(overlap)
        if box is None:
            return silhouettes
        window = slice(box[0], box[1]), slice(box[2], box[3])
        depths = self._depths(states, silhouettes & overlap, box)
        front = depths[(slice(None), *window)].argmin(axis=0)
        visible = silhouettes & ~overlap
        for arm, own in enumerate(visible):
            own[window] |= overlap[window] & (front == arm)
        return visible

    def _depths(self, states: FloatArray, wanted: NDArray[np.bool_], box: Box) -> FloatArray:
        """Depths at the wanted pixels of each arm's silhouette ``(arms, H, W)``, inf elsewhere in the box."""
        depths = np.empty(wanted.shape)
        room, corners = np.empty(wanted.shape[1:], np.int32), np.empty((4, 3))
        for arm, state, pixels, depth in zip(self.arms, states, wanted, depths, strict=True):
            if pixels.any():
                points, seen = arm.place(state, self.lens)
                cut = any(
                    bool((points[first:last, 2] <= self.lens.near).any())
                    for first, last in zip(arm.bodies.vertex_first, arm.bodies.vertex_last, strict=True)
                )
                nearest_surface(points, seen, arm.mesh.faces, cut, self.lens, pixels, box, room, corners, depth)
            else:
                depth[box[0] : box[1], box[2] : box[3]] = np.inf
        return depths


def _overlap(masks: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels ``(H, W)`` that several of the masks ``(arms, H, W)`` cover."""
    several = np.zeros(masks.shape[1:], dtype=bool)
    before = masks[0].copy()
    for mask in masks[1:]:
        several |= before & mask
        before |= mask
    return several


def _bounds(wanted: NDArray[np.bool_]) -> Box | None:
    """First row, row after the last, first column and column after the last that hold a wanted pixel, if any."""
    rows = np.flatnonzero(wanted.any(axis=1))
    if len(rows) == 0:
        return None
    columns = np.flatnonzero(wanted[rows[0] : rows[-1] + 1].any(axis=0))
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
