"""The instrument and camera that are really in a picture, where a preset wants them to differ from what is declared.

Trackers that render what was rendered to make their data look better than they are (the inverse crime).
"""

from __future__ import annotations

import numpy as np

from surgbench.camera import Camera
from surgbench.generators.sections import Mismatch
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.instrument.model import LinkMesh
from surgbench.instrument.spec import Link, LinkPoint

NO_MISMATCH = Mismatch()


def real_camera(camera: Camera, mismatch: Mismatch) -> Camera:
    """The camera that sees the scene, its lens's distortion included."""
    if mismatch == NO_MISMATCH:
        return camera
    across, down = mismatch.focal_scale
    right, below = mismatch.centre_offset_px
    changes = {"fx": camera.fx * across, "fy": camera.fy * down, "cx": camera.cx + right, "cy": camera.cy + below}
    return camera.model_copy(update={**changes, "distortion": tuple(mismatch.distortion)})


def real_instrument(instrument: Instrument, mismatch: Mismatch) -> Instrument:
    """The instrument in the scene: thicker shaft, larger wrist and jaws, longer jaws; the same joints and limits."""
    if mismatch == NO_MISMATCH:
        return instrument
    shaft = instrument.spec.links[0].name
    across = np.array([mismatch.shaft_radius_scale, mismatch.shaft_radius_scale, 1.0])

    def grown(points_m: FloatArray, link: str) -> FloatArray:
        if link == shaft:
            thicker: FloatArray = points_m * across
            return thicker
        larger: FloatArray = points_m * mismatch.body_scale
        tips = [np.array(tip.point_m) for tip in instrument.spec.tips if tip.link == link]
        if tips:
            # Along the jaw only what lies on the tip's side of its axis grows.
            along = int(np.argmax(np.abs(tips[0])))
            length_m = tips[0][along] * mismatch.body_scale
            share = np.maximum(larger[..., along] / length_m, 0.0)
            larger[..., along] += share * np.sign(length_m) * mismatch.jaw_extra_m
        return larger

    def moved(point: LinkPoint) -> LinkPoint:
        x, y, z = grown(np.array(point.point_m), point.link).tolist()
        return point.model_copy(update={"point_m": (x, y, z)})

    def stretched(link: Link) -> Link:
        if link.name == shaft:
            return link
        return link.model_copy(update={"a_m": link.a_m * mismatch.body_scale, "d_m": link.d_m * mismatch.body_scale})

    spec = instrument.spec.model_copy(
        update={
            "links": tuple(stretched(link) for link in instrument.spec.links),
            "tips": tuple(moved(tip) for tip in instrument.spec.tips),
            "markers": tuple(
                marker.model_copy(update={"point": moved(marker.point)}) for marker in instrument.spec.markers
            ),
            "skeleton": tuple((moved(one), moved(other)) for one, other in instrument.spec.skeleton),
        }
    )
    meshes = {
        name: LinkMesh(grown(mesh.vertices_m, name).astype(np.float32).astype(np.float64), mesh.faces)
        for name, mesh in instrument.meshes.items()
    }
    return Instrument(spec, meshes)
