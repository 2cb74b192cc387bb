"""Grey pictures as a camera with a distorting lens takes them, rendered with Mitsuba.

Light comes from all sides alike, and a surface is as bright as it reflects; what something covers along its normal is
dark. Only the part of the picture that the subject covers is rendered, by a pinhole camera
with ``OVERSAMPLE`` rays a pixel in each direction, and then bent: as many points of each pixel are looked up in it, at
the places which the lens sees there, and averaged.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.camera import NEAR_M, Camera
from surgbench.geometry import FloatArray
from surgbench.rendering.depth import VARIANT, depth_view, load_mitsuba
from surgbench.viewpoint.optics.grasp_object import Panel, Solid, Subject

OVERSAMPLE = 2
# Beyond the subject's box, so that pixels on its border find the background.
MARGIN_PX = 2
BACKGROUND = 0.3
NOISE = 0.006

Picture = NDArray[np.uint8]


class Photographer:
    """Takes pictures of one thing with one camera.

    Args:
        camera: Intrinsics and distortion.
        subject: What is photographed.
        background: Grey level behind it, 0 to 1.
        noise: Standard deviation of the sensor's noise, of the range from black to white.

    Raises:
        SurgbenchError: Mitsuba cannot be loaded.
    """

    def __init__(self, camera: Camera, subject: Subject, background: float = BACKGROUND, noise: float = NOISE) -> None:
        self.camera, self.background, self.noise = camera, background, noise
        self._points_m = subject.points_m
        self._map, self._pinhole, self._blind = _bend(camera)
        self._mi = load_mitsuba()
        self._scene = self._mi.load_dict(self._describe(subject))
        self._parameters = self._mi.traverse(self._scene)

    def photograph(self, T_cam_object: FloatArray, rng: np.random.Generator) -> Picture:
        """Take one picture.

        Args:
            T_cam_object: ``(4, 4)`` where the subject is.
            rng: For the noise.

        Returns:
            ``(height, width)`` grey levels.
        """
        size = self.camera.height, self.camera.width
        picture = np.full(size, self.background, dtype=np.float32)
        points = self._points_m @ T_cam_object[:3, :3].T + T_cam_object[:3, 3]
        box = self._box(points)
        if box is not None:
            left, top, right, bottom = box
            grid = self._map[top * OVERSAMPLE : bottom * OVERSAMPLE, left * OVERSAMPLE : right * OVERSAMPLE]
            corner, pinhole = self._render(T_cam_object, grid)
            columns, rows = np.ascontiguousarray(np.moveaxis(grid - corner, -1, 0))
            bent = cv2.remap(pinhole, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            picture[top:bottom, left:right] = cv2.resize(
                bent, (right - left, bottom - top), interpolation=cv2.INTER_AREA
            )
        picture[self._blind] = 0.0
        if self.noise:
            picture += np.float32(self.noise) * rng.standard_normal(size, dtype=np.float32)
        grey: Picture = np.rint(255.0 * picture.clip(0.0, 1.0)).astype(np.uint8)
        return grey

    def _box(self, points_cam: FloatArray) -> tuple[int, int, int, int] | None:
        """Left, top, right and bottom of the pixels that points may cover; ``None`` where none can."""
        if (points_cam[:, 2] <= NEAR_M).all():
            return None
        whole = np.array([[0, 0], [self.camera.width, self.camera.height]])
        pixels = self.camera.see(points_cam)
        # Lines are seen bent: their middles too, as far as a box needs it.
        middles = self.camera.see((points_cam[:, None] + points_cam[None, :: max(1, len(points_cam) // 32)]) / 2)
        every = np.concatenate([pixels, middles.reshape(-1, 2)])
        if not np.isfinite(every).all():
            low, high = whole
        else:
            low = np.maximum(np.floor(every.min(axis=0)) - MARGIN_PX, whole[0]).astype(int)
            high = np.minimum(np.ceil(every.max(axis=0)) + 1 + MARGIN_PX, whole[1]).astype(int)
        if (low >= high).any():
            return None
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    def _render(
        self, T_cam_object: FloatArray, grid: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The pinhole camera's picture where a grid looks it up, and the pixel in its corner."""
        mi = self._mi
        if mi.variant() != VARIANT:
            mi.set_variant(VARIANT)
        low = np.floor(grid.min(axis=(0, 1))).astype(int)
        high = np.ceil(grid.max(axis=(0, 1))).astype(int) + 1
        place = T_cam_object.copy()
        place[1] *= self._pinhole.fy / self._pinhole.fx
        self._parameters["place.to_world"] = mi.Transform4f(place)
        self._parameters["sensor.film.crop_offset"] = mi.Point2u(*(int(value) for value in low))
        self._parameters["sensor.film.crop_size"] = mi.Vector2u(*(int(value) for value in high - low))
        self._parameters.update()
        seen = np.asarray(mi.render(self._scene, spp=1))
        grey = seen[..., 0] + (1.0 - seen[..., 1]) * self.background
        return low.astype(np.float32), np.ascontiguousarray(grey, dtype=np.float32)

    def _describe(self, subject: Subject) -> dict[str, Any]:
        mi = self._mi
        view = depth_view(mi, self._pinhole)
        view["sensor"]["film"]["pixel_format"] = "luminance_alpha"
        # One reflected ray finds the light or another part of the subject: along the normal, as nothing is jittered.
        view["integrator"] = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1, "hide_emitters": True}
        group: dict[str, Any] = {"type": "shapegroup"}
        for number, panel in enumerate(subject.panels):
            group[f"panel_{number}"] = _rectangle(mi, panel)
        for number, solid in enumerate(subject.solids):
            group[f"solid_{number}"] = _mesh(mi, solid)
        return {
            "type": "scene",
            **view,
            "light": {"type": "constant", "radiance": 1.0},
            "group": group,
            "place": {"type": "instance", "shapegroup": {"type": "ref", "id": "group"}},
        }


def _bend(camera: Camera) -> tuple[NDArray[np.float32], Camera, NDArray[np.bool_]]:
    """Where a pinhole camera sees what the lens sees in each of a pixel's points, and that pinhole camera.

    Returns:
        ``(OVERSAMPLE height, OVERSAMPLE width, 2)`` pixels of the pinhole camera; it has ``OVERSAMPLE`` times the
        focal length and is wide enough. ``(height, width)`` pixels in which the lens sees nothing: they stay black.
    """
    size = camera.height * OVERSAMPLE, camera.width * OVERSAMPLE
    rows, columns = np.mgrid[: size[0], : size[1]]
    seen = (np.stack([columns, rows], axis=-1) + 0.5) / OVERSAMPLE - 0.5
    seen = camera.lens.undistort(seen)
    blind = np.isnan(seen[..., 0])
    # Anywhere: what is looked up there is not shown.
    seen[blind] = [camera.cx, camera.cy]
    fine = (seen + 0.5) * OVERSAMPLE - 0.5
    low = np.floor(fine.min(axis=(0, 1))) - 1
    width, height = (int(value) for value in np.ceil(fine.max(axis=(0, 1))) + 2 - low)
    pinhole = Camera(
        width=width,
        height=height,
        fx=camera.fx * OVERSAMPLE,
        fy=camera.fy * OVERSAMPLE,
        cx=(camera.cx + 0.5) * OVERSAMPLE - 0.5 - float(low[0]),
        cy=(camera.cy + 0.5) * OVERSAMPLE - 0.5 - float(low[1]),
    )
    whole = np.asarray(blind.reshape(camera.height, OVERSAMPLE, camera.width, OVERSAMPLE).any(axis=(1, 3)))
    return (fine - low).astype(np.float32), pinhole, whole


def _rectangle(mi: Any, panel: Panel) -> dict[str, Any]:
    # Mitsuba's rectangle reaches from -1 to 1.
    half = np.diag([panel.size_m[0] / 2, panel.size_m[1] / 2, 1.0, 1.0])
    # And its texture starts at the bottom.
    bitmap = mi.Bitmap(np.ascontiguousarray(panel.texture[::-1, :, None]))
    picture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest", "wrap_mode": "clamp"}
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(panel.T_object_panel @ half),
        "bsdf": {"type": "diffuse", "reflectance": picture},
    }


def _mesh(mi: Any, solid: Solid) -> Any:
    properties = mi.Properties()
    colour = {"type": "uniform", "value": solid.reflectance}
    properties["bsdf"] = mi.load_dict({"type": "twosided", "inside": {"type": "diffuse", "reflectance": colour}})
    properties["face_normals"] = True
    mesh = mi.Mesh("solid", len(solid.mesh.vertices_m), len(solid.mesh.faces), props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = solid.mesh.vertices_m.astype(np.float32).ravel()
    parameters["faces"] = solid.mesh.faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh
