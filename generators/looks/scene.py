"""Linear images of a sequence, rendered with Mitsuba from the same meshes and states as its masks.

Each sample of a pixel is a pass of its own over the whole image: with its own moment of the exposure, so that what
moves is blurred, and its own place of the light on the endoscope's tip, so that shadows are soft without noise. One
sample a pass also makes the sums the same whatever the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import NEAR_M, Camera
from surgbench.generators.looks.backdrop import make_backdrop
from surgbench.generators.looks.look import Look
from surgbench.generators.looks.markers import painted
from surgbench.generators.looks.materials import paint, shaft, steel
from surgbench.generators.looks.surface import Surface, link_surface
from surgbench.generators.looks.variants import use
from surgbench.geometry import FloatArray, inverse_transform
from surgbench.instrument import Instrument
from surgbench.rendering.depth import depth_view

Linear = NDArray[np.float32]
# What the light travels: the camera's light, and one reflection, so that steel shows what is around it.
MAX_DEPTH = 3
# Of one ray, against the mean over the image.
BRIGHTEST = 25.0
GOLDEN = 2.399963229728653


class PictureRenderer:
    """Renders the images of one sequence.

    Args:
        instrument: Of all arms; its markers are painted on it.
        count: How many arms there are.
        camera: Pinhole, of every eye.
        look: Of the sequence.
        variant: Of Mitsuba.
        samples: Rays a pixel.
        nearest_m: No part of the backdrop comes nearer; ``None`` for no backdrop.
        eyes: ``(4, 4)`` T_eye_cam of each.
    """

    def __init__(
        self,
        instrument: Instrument,
        count: int,
        camera: Camera,
        look: Look,
        variant: str,
        samples: int,
        nearest_m: float | None,
        eyes: Sequence[FloatArray] = (np.eye(4),),
    ) -> None:
        self._mi = use(variant)
        self._variant = variant
        self.instrument, self.count, self.camera, self.samples = instrument, count, camera, samples
        self._look = look
        self._squeeze = camera.fy / camera.fx
        backdrop = None if nearest_m is None else make_backdrop(self._mi, look, camera, nearest_m)
        self._backdrop = backdrop
        scene: dict[str, Any] = {"type": "scene"}
        for number, eye in enumerate(eyes):
            scene[f"eye_{number}"] = self._sensor(eye)
        for number, eye in enumerate(eyes):
            scene[f"exact_{number}"] = self._sensor(eye, exact=True)
        self._eyes = len(eyes)
        self._lights = self._light_places()
        intensity = np.array([look["light_red"], 1.0, 1.0 / look["light_red"]])
        scene["light"] = {
            "type": "point",
            "position": self._lights[0].tolist(),
            "intensity": {"type": "rgb", "value": intensity.tolist()},
        }
        surfaces = self._surfaces()
        materials = self._materials()
        spots = instrument.spec.markers
        for name, whole in surfaces.items():
            bare, paints = painted(whole, tuple(spot for spot in spots if spot.point.link == name))
            group: dict[str, Any] = {"type": "shapegroup", "bare": _part(self._mi, name, bare, materials[name])}
            for spot in spots:
                if spot.name in paints:
                    group[spot.name] = _part(self._mi, spot.name, paints[spot.name], paint(spot.colour))
            scene[f"shape_{name}"] = group
            for arm in range(count):
                scene[f"place_{arm}_{name}"] = {
                    "type": "instance",
                    "shapegroup": {"type": "ref", "id": f"shape_{name}"},
                }
        if backdrop is not None:
            rest = backdrop.vertices_m * [1.0, self._squeeze, 1.0]
            scene["backdrop"] = _mesh(self._mi, "backdrop", rest, backdrop.faces, backdrop.places, backdrop.bsdf)
        self._scene = self._mi.load_dict(scene)
        self._parameters = self._mi.traverse(self._scene)
        self._path = self._mi.load_dict({"type": "path", "max_depth": MAX_DEPTH})
        self._far = self._mi.load_dict({"type": "depth"})
        rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float64)
        across, down = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fx
        self._cosines = 1.0 / np.sqrt(1.0 + across**2 + down**2)

    def linear(
        self, states: FloatArray, steps: FloatArray, time_s: float, seed: int, eye: int = 0, samples: int | None = None
    ) -> Linear:
        """One frame.

        Args:
            states: ``(arms, 9)`` in the middle of the exposure.
            steps: ``(arms, 9)`` how they change while the shutter is open.
            time_s: Of the frame in its sequence, for the backdrop.
            seed: Of the rays; another for each frame and eye.
            eye: Which.
            samples: Rays a pixel; as many as all have unless told.

        Returns:
            ``(height, width, 4)``: linear red, green and blue, and the share of each pixel that is covered.
        """
        use(self._variant)
        self._move_backdrop(time_s)
        total = np.zeros((self.camera.height, self.camera.width, 4))
        moves = bool(np.abs(steps).max(initial=0.0) > 0.0)
        count = min(samples or self.samples, self.samples)
        for number in range(count):
            if number == 0 or moves:
                self._place(states + ((number + 0.5) / count - 0.5) * steps)
            self._parameters["light.position"] = self._mi.Point3f(*self._lights[number].tolist())
            self._parameters.update()
            light = self._render(eye, self._path, (seed + number) % (1 << 32))
            # Single rays by way of two mirrors would be bright dots.
            light[..., :3] = np.clip(light[..., :3], 0.0, BRIGHTEST * light[..., :3].mean())
            total += light
        return np.asarray(total / count, np.float32)

    def depth_m(self, states: FloatArray, time_s: float, eye: int = 0) -> FloatArray:
        """Depth along the optical axis at the pixels' centres, ``(height, width)`` metres; 0 where there is nothing."""
        use(self._variant)
        self._move_backdrop(time_s)
        self._place(states)
        self._parameters.update()
        along = self._render(self._eyes + eye, self._far, 0)[..., 0]
        return np.asarray(np.where(along > 0.0, along * self._cosines + NEAR_M, 0.0))

    def _render(self, eye: int, integrator: Any, seed: int) -> FloatArray:
        image = self._mi.render(self._scene, sensor=eye, integrator=integrator, spp=1, seed=seed)
        # What no material answers for (a ray along a surface) is black.
        return np.nan_to_num(np.asarray(image, np.float64), nan=0.0, posinf=0.0, neginf=0.0)

    def _place(self, states: FloatArray) -> None:
        transforms = self.instrument.link_transforms(states)
        for arm in range(self.count):
            for name in self.instrument.meshes:
                transform = transforms[arm, self.instrument.link_index[name]].copy()
                transform[1] *= self._squeeze
                self._parameters[f"place_{arm}_{name}.to_world"] = self._mi.Transform4f(transform)

    def _move_backdrop(self, time_s: float) -> None:
        if self._backdrop is not None:
            moved = self._backdrop.at(time_s) * [1.0, self._squeeze, 1.0]
            self._parameters["backdrop.vertex_positions"] = moved.astype(np.float32).ravel()

    def _light_places(self) -> FloatArray:
        """``(samples, 3)`` where the light leaves the endoscope in each pass: on two crescents beside the lens."""
        turn = GOLDEN * np.arange(self.samples)
        side = np.where(np.arange(self.samples) % 2, 0.0, np.pi)
        angle = side + 0.9 * np.sin(turn)
        reach = self._look["light_radius_m"] * (1.0 + 0.25 * np.cos(1.7 * turn))
        return np.stack([reach * np.cos(angle), reach * np.sin(angle), np.zeros(self.samples)], axis=1)

    def _sensor(self, T_eye_cam: FloatArray, *, exact: bool = False) -> dict[str, Any]:
        sensor = dict(depth_view(self._mi, self.camera)["sensor"])
        pose = inverse_transform(T_eye_cam) @ np.diag([-1.0, -1.0, 1.0, 1.0])
        pose[1, 3] *= self._squeeze
        sensor["to_world"] = self._mi.ScalarTransform4f(pose)
        sensor["film"] = {**sensor["film"], "pixel_format": "rgba"}
        if not exact:
            sensor["sampler"] = {"type": "independent", "sample_count": 1}
        return sensor

    def _surfaces(self) -> dict[str, Surface]:
        first = self.instrument.spec.links[0].name
        return {name: link_surface(mesh, shaft=name == first) for name, mesh in self.instrument.meshes.items()}

    def _materials(self) -> dict[str, Any]:
        first = self.instrument.spec.links[0].name
        metal = self._mi.load_dict(steel(self._mi, self._look))
        materials = dict.fromkeys(self.instrument.meshes, metal)
        if first in materials:
            along = self.instrument.meshes[first].vertices_m[:, 2]
            coated = shaft(self._mi, self._look, float(along.min()), float(along.max()))
            materials[first] = self._mi.load_dict(coated)
        return materials


def _part(mi: Any, name: str, surface: Surface, bsdf: Any) -> Any:
    return _mesh(mi, name, surface.vertices_m, surface.faces, surface.places, bsdf, surface.normals)


def _mesh(
    mi: Any,
    name: str,
    vertices: FloatArray,
    faces: NDArray[np.uint32],
    places: FloatArray,
    bsdf: Any,
    normals: FloatArray | None = None,
) -> Any:
    """A mesh with its material."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf) if isinstance(bsdf, dict) else bsdf
    mesh = mi.Mesh(
        name, len(vertices), len(faces), has_vertex_normals=True, has_vertex_texcoords=True, props=properties
    )
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = faces.ravel()
    if normals is not None:
        parameters["vertex_normals"] = normals.astype(np.float32).ravel()
    parameters["vertex_texcoords"] = places.astype(np.float32).ravel()
    parameters.update()
    return mesh
