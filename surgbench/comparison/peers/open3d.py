"""Open3D's raycasting scene (Embree)."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from surgbench.camera import NEAR_M, Camera
from surgbench.comparison.peers.base import Peer
from surgbench.comparison.peers.body import Body, pixel_rays
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument


class Open3D(Peer):
    """A scene for every state, and a ray for every pixel of the window that the instrument is seen in."""

    name: ClassVar[str] = "open3d"
    module: ClassVar[str] = "open3d"
    system: ClassVar[str] = "on Debian and Ubuntu: apt-get install libusb-1.0-0 libegl1 libgl1 libx11-6 libidn2-0"

    def prepare(self, instrument: Instrument, camera: Camera) -> None:
        """Lay the meshes end to end and list the rays."""
        import open3d

        super().prepare(instrument, camera)
        self._open3d: Any = open3d
        self._body = Body(instrument)
        self._faces = open3d.core.Tensor(self._body.faces.astype(np.uint32))
        directions = pixel_rays(camera)
        self._rays = np.concatenate([np.zeros_like(directions), directions], axis=-1)
        self._image = np.empty((camera.height, camera.width), dtype=bool)

    def draw(self, transforms: FloatArray) -> Mask:
        """Build, cast."""
        core, geometry = self._open3d.core, self._open3d.t.geometry
        placed = self._body.place(transforms)
        window = self._body.window(placed, self.camera)
        self._image[:] = False
        rays = np.ascontiguousarray(self._rays[window])
        if rays.size:
            scene = geometry.RaycastingScene(nthreads=1)
            scene.add_triangles(core.Tensor.from_numpy(placed.astype(np.float32)), self._faces)
            # Directions have z = 1, so that distances along them are depths.
            hit = scene.test_occlusions(core.Tensor.from_numpy(rays), tnear=NEAR_M, nthreads=1)
            self._image[window] = hit.numpy()
        return self._image
