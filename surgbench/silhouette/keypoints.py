"""The tips of all arms in the image, and how they move with the state."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surgbench.camera import NEAR_M, Camera
from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.instrument.spec import LinkPoint
from surgbench.silhouette.boundary import map_links, pull_back, push
from surgbench.silhouette.contour import place_links
from surgbench.silhouette.layout import assemble_links, lens
from surgbench.state import STATE_SIZE


class KeypointProjector:
    """Projects the two tips of each arm for many states at once, and pulls derivatives back to the states.

    Or other points fixed to links: P of each arm.

    Args:
        instruments: One per arm; states have ``9 * len(instruments)`` components.
        camera: The view.
        points: Of each arm, P in place of its tips.

    Raises:
        ValueError: Arms differ in how many points they have.

    Example:
        Straight ahead, the closed jaws' tips are 0.4 mm to both sides of the axis, 148.1 mm away.

        >>> import numpy as np
        >>> from surgbench.camera import Camera
        >>> from surgbench.instrument import load_instrument
        >>> from surgbench.silhouette import KeypointProjector
        >>> camera = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
        >>> projector = KeypointProjector([load_instrument("large_needle_driver")], camera)
        >>> projector.project([[0, 0, 0, 0, 0, 0.13, 0, 0, 0]]).round(2)
        array([[[[80.  , 60.54],
                 [80.  , 59.46]]]])
    """

    def __init__(
        self,
        instruments: Sequence[Instrument],
        camera: Camera,
        points: Sequence[Sequence[LinkPoint]] | None = None,
    ) -> None:
        self.instruments = tuple(instruments)
        self.camera = camera
        self.points = tuple(tuple(one) for one in points or [each.tips for each in instruments])
        if len({len(one) for one in self.points}) != 1 or len(self.points) != len(self.instruments):
            raise ValueError(f"as many points of every arm, not {[len(one) for one in self.points]}")
        self._arms = len(instruments)
        self._links = assemble_links(instruments)
        self._lens = lens(camera, NEAR_M)
        first = np.cumsum([0, *(len(instrument.spec.links) for instrument in instruments)])
        tips = [(arm, tip) for arm, own in enumerate(self.points) for tip in own]
        self._tip_link = np.array([first[arm] + instruments[arm].link_index[tip.link] for arm, tip in tips])
        self._tip = np.array([tip.point_m for _, tip in tips], dtype=np.float64)
        self._lock = threading.Lock()
        self._pose = np.empty((len(self._links.parent), 3, 4))
        self._wrench = np.zeros((2, len(self._links.parent), 6))
        self._maps = np.zeros((len(self._links.parent), STATE_SIZE, 6))

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), (self.instruments, self.camera, self.points)

    def _batch(self, states: ArrayLike) -> FloatArray:
        batch = np.array(states, dtype=np.float64, order="C")
        if batch.ndim != 2 or batch.shape[1] != STATE_SIZE * self._arms:
            raise ValueError(f"states must be (N, {STATE_SIZE * self._arms}), got {batch.shape}")
        return batch

    def project(self, states: ArrayLike) -> FloatArray:
        """Points of ``(N, 9 * arms)`` states, ``(N, arms, P, 2)`` pixels; NaN at or behind the camera plane.

        Raises:
            ValueError: Wrong shape.
        """
        batch = self._batch(states)
        places = np.empty((len(batch), len(self._tip), 2))
        with self._lock:
            _project(batch, self._links, self._lens, self._tip_link, self._tip, self._pose, places)
        return places.reshape(len(batch), self._arms, -1, 2)

    def pull_back(self, states: ArrayLike, slopes: ArrayLike) -> FloatArray:
        """Derivative with respect to the states of a function of the projected points (the chain rule).

        Args:
            states: ``(N, 9 * arms)``.
            slopes: ``(N, arms, P, 2)`` derivative of the function with respect to each point's pixel.

        Returns:
            ``(N, 9 * arms)``; points behind the camera plane contribute nothing.

        Raises:
            ValueError: Wrong shape.
        """
        batch = self._batch(states)
        forces = np.array(slopes, dtype=np.float64, order="C")
        expected = (len(batch), self._arms, len(self.points[0]), 2)
        if forces.shape != expected:
            raise ValueError(f"slopes must be {expected}, got {forces.shape}")
        result = np.empty_like(batch)
        scratch = self._pose, self._wrench, self._maps
        forces = forces.reshape(len(batch), -1, 2)
        with self._lock:
            _pull_back(batch, self._links, self._lens, self._tip_link, self._tip, *scratch, forces, result)
        return result


@compiled(inline="always")
def _place(pose: Any, point: Any, axis: int) -> Any:
    return pose[axis, 0] * point[0] + pose[axis, 1] * point[1] + pose[axis, 2] * point[2] + pose[axis, 3]


@compiled
def _project(states: Any, links: Any, lens: Any, tip_link: Any, tip: Any, pose: Any, places: Any) -> Any:
    for s in range(states.shape[0]):
        place_links(states[s], links, pose)
        for k in range(tip.shape[0]):
            T = pose[tip_link[k]]
            x, y, z = _place(T, tip[k], 0), _place(T, tip[k], 1), _place(T, tip[k], 2)
            places[s, k, 0] = lens.fx * x / z + lens.cx if z > 0 else np.nan
            places[s, k, 1] = lens.fy * y / z + lens.cy if z > 0 else np.nan


@compiled
def _pull_back(
    states: Any, links: Any, lens: Any, tip_link: Any, tip: Any, pose: Any, wrench: Any, maps: Any, forces: Any,
    result: Any,
) -> Any:  # fmt: skip
    for s in range(states.shape[0]):
        place_links(states[s], links, pose)
        wrench[0] = 0.0
        for k in range(tip.shape[0]):
            T = pose[tip_link[k]]
            x, y, z = _place(T, tip[k], 0), _place(T, tip[k], 1), _place(T, tip[k], 2)
            if z > 0:
                u, v = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
                push(tip_link[k], u, v, z, forces[s, k, 0], forces[s, k, 1], 1.0, 0.0, lens, wrench)
        map_links(states[s], links, pose, maps)
        pull_back(links, maps, wrench[0], result[s])
