"""Masks rendered with Mitsuba, exact to the pixel centre.

The sensor's rays pass through the pixel centres of an OpenCV camera: box filter, one unjittered sample per pixel,
and a principal point whose offset has the opposite sign of what one expects. The sensor takes one focal length, so
the geometry's camera-frame y is scaled by fy/fx, which leaves the silhouette as it is. Instruments move by updating
the transforms of their links; the scene is built once. Only the box around the instruments is rendered: the film is
cropped to it, which leaves the rays as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import NEAR_M, Camera
from surgbench.dataset.masks import Mask
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.rendering.depth import VARIANT, add_part, depth_view, load_mitsuba
from surgbench.state import split_arms

BOX_MARGIN_PX = 2


class MaskRenderer:
    """Renders the union of some instruments' silhouettes.

    Args:
        instruments: One or more.
        camera: Without distortion.
        threads: Threads for rendering, for the whole process; ``None`` leaves them as they are.

    Raises:
        SurgbenchError: Mitsuba cannot be loaded; one line that says what it lacks.
    """

    def __init__(self, instruments: Sequence[Instrument], camera: Camera, threads: int | None = None) -> None:
        self.camera = camera
        self.instruments = tuple(instruments)
        self._mi = load_mitsuba()
        if threads is not None:
            import drjit

            drjit.set_thread_count(threads)
        self._edges = {
            (arm, name): _edges(mesh.faces)
            for arm, instrument in enumerate(self.instruments)
            for name, mesh in instrument.meshes.items()
        }
        self._scene = self._mi.load_dict(self._describe())
        self._parameters = self._mi.traverse(self._scene)

    def mask(self, states: FloatArray) -> Mask:
        """Render one frame.

        Args:
            states: ``(9 * instruments,)`` or ``(instruments, 9)``.

        Returns:
            ``(height, width)`` bool: the pixels whose centre's ray meets an instrument.
        """
        mask: Mask = self.distance(states) > 0
        return mask

    def distance(self, states: FloatArray, window: tuple[int, int, int, int] | None = None) -> NDArray[np.float32]:
        """Render one frame.

        Args:
            states: ``(9 * instruments,)`` or ``(instruments, 9)``.
            window: First row, row after the last, first column and column after the last that are wanted; all unless
                told.

        Returns:
            ``(height, width)``: how far along the ray through a pixel's centre the nearest surface is, in units of that
            ray's own, the same for all states; 0 where there is none.
        """
        mi = self._mi
        if mi.variant() != VARIANT:
            mi.set_variant(VARIANT)
        arms = split_arms(np.asarray(states, dtype=np.float64).reshape(-1))
        boxes = []
        for arm, (instrument, state) in enumerate(zip(self.instruments, arms, strict=True)):
            transforms = instrument.link_transforms(state)
            for name, mesh in instrument.meshes.items():
                transform = transforms[instrument.link_index[name]]
                vertices = mesh.vertices_m @ transform[:3, :3].T + transform[:3, 3]
                boxes.append(visible_box(vertices, mesh.faces, self._edges[arm, name], self.camera))
                transform[1] *= self.camera.fy / self.camera.fx
                self._parameters[f"place_{arm}_{name}.to_world"] = mi.Transform4f(transform)
        distance = np.zeros((self.camera.height, self.camera.width), dtype=np.float32)
        low = np.min([box[0] for box in boxes], axis=0) - BOX_MARGIN_PX
        high = np.max([box[1] for box in boxes], axis=0) + BOX_MARGIN_PX
        if not (low < high).all():
            return distance
        left, top = (int(value) for value in np.maximum(np.floor(low), 0))
        right = min(int(np.ceil(high[0])) + 1, self.camera.width)
        bottom = min(int(np.ceil(high[1])) + 1, self.camera.height)
        if window is not None:
            top, bottom = max(top, window[0]), min(bottom, window[1])
            left, right = max(left, window[2]), min(right, window[3])
            if top >= bottom or left >= right:
                return distance
        self._parameters["sensor.film.crop_offset"] = mi.Point2u(left, top)
        self._parameters["sensor.film.crop_size"] = mi.Vector2u(right - left, bottom - top)
        self._parameters.update()
        distance[top:bottom, left:right] = np.asarray(mi.render(self._scene, spp=1))[..., 0]
        return distance

    def _describe(self) -> dict[str, Any]:
        scene: dict[str, Any] = {"type": "scene", **depth_view(self._mi, self.camera)}
        for arm, instrument in enumerate(self.instruments):
            for name, mesh in instrument.meshes.items():
                add_part(self._mi, scene, f"{arm}_{name}", mesh)
        return scene


def visible_box(
    vertices_cam: FloatArray, faces: NDArray[np.int32], edges: NDArray[np.int32], camera: Camera
) -> tuple[FloatArray, FloatArray]:
    """Bounding box of what a mesh covers of the image.

    What each triangle covers is a convex polygon. Its corners are ends of edges clipped to the image, or corners of
    the image.

    Args:
        vertices_cam: ``(V, 3)`` metres; may lie behind the camera.
        faces: ``(F, 3)``.
        edges: ``(E, 2)``.
        camera: Intrinsics.

    Returns:
        Lower and upper ``(2,)`` pixels (u, v); +inf and -inf where nothing is visible.
    """
    bounds = np.array([-0.5, -0.5]), np.array([camera.width - 0.5, camera.height - 0.5])
    ends = vertices_cam[edges]
    ends = ends[(ends[..., 2] > NEAR_M).any(axis=1)]
    # Cut at the near plane: the end behind it moves along the edge onto it.
    rise = ends[:, ::-1, 2] - ends[..., 2]
    share = np.where(ends[..., 2] < NEAR_M, (NEAR_M - ends[..., 2]) / np.where(rise == 0.0, 1.0, rise), 0.0)
    ends = ends + share[..., None] * (ends[:, ::-1] - ends)
    pixels = ends[..., :2] / ends[..., 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    # Cut at the image's borders (Liang and Barsky).
    start, way = pixels[:, 0], pixels[:, 1] - pixels[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = np.stack([(bound - start) / way for bound in bounds])
    still = way == 0.0
    outside = still & ((start < bounds[0]) | (start > bounds[1]))
    enter = np.where(still, 0.0, crossings.min(axis=0)).max(axis=1).clip(min=0.0)
    leave = np.where(still, 1.0, crossings.max(axis=0)).min(axis=1).clip(max=1.0)
    kept = (enter <= leave) & ~outside.any(axis=1)
    points = [start[kept] + part[kept, None] * way[kept] for part in (enter, leave)]

    corners = np.array([[u, v] for u in (bounds[0][0], bounds[1][0]) for v in (bounds[0][1], bounds[1][1])])
    rays = np.column_stack([(corners - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(4)])
    a, b, c = np.moveaxis(vertices_cam[faces], 1, 0)
    # A ray from the camera passes through the triangle on its inner side of all three planes through the camera.
    sides = np.stack([np.cross(one, two) @ rays.T for one, two in ((a, b), (b, c), (c, a))])
    covered = ((sides >= 0).all(axis=0) | (sides <= 0).all(axis=0)).any(axis=0)
    points.append(corners[covered])
    found = np.concatenate(points)
    return found.min(axis=0, initial=np.inf), found.max(axis=0, initial=-np.inf)


def _edges(faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """``(E, 2)`` edges of a mesh, each once."""
    every = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(every, axis=0)
