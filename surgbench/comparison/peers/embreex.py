"""Embree by embreex, the ray caster behind trimesh."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from surgbench.camera import NEAR_M, Camera
from surgbench.comparison.peers.base import Peer
from surgbench.comparison.peers.body import Body, pixel_rays
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument


class Embreex(Peer):
    """A scene for every state, and a ray for every pixel of the window that the instrument is seen in."""

    name: ClassVar[str] = "embreex"
    module: ClassVar[str] = "embreex"

    def prepare(self, instrument: Instrument, camera: Camera) -> None:
        """Lay the meshes end to end and list the rays."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        super().prepare(instrument, camera)
        self._scene_class: Any = EmbreeScene
        self._mesh_class: Any = TriangleMesh
        self._body = Body(instrument)
        self._rays = pixel_rays(camera)
        self._image = np.empty((camera.height, camera.width), dtype=bool)

    def draw(self, transforms: FloatArray) -> Mask:
        """Build, cast."""
        placed = self._body.place(transforms)
        window = self._body.window(placed, self.camera)
        self._image[:] = False
        directions = np.ascontiguousarray(self._rays[window])
        if directions.size:
            # Without the robust flag rays may slip through between two triangles.
            scene = self._scene_class(robust=True)
            self._mesh_class(scene, placed.astype(np.float32), self._body.faces)
            flat = directions.reshape(-1, 3)
            # Directions have z = 1: the rays begin on the near plane.
            hit = scene.run(np.float32(NEAR_M) * flat, flat, query="OCCLUDED")
            self._image[window] = (hit >= 0).reshape(directions.shape[:2])
        return self._image
