"""Mitsuba: its scalar variant, and its LLVM variant where there is an LLVM that it can live with."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np

from surgbench.camera import NEAR_M, Camera
from surgbench.comparison.peers.base import Peer
from surgbench.comparison.peers.body import Body
from surgbench.contract import Mask
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.rendering.backends import llvm_problem
from surgbench.rendering.depth import add_part, depth_view


class _Mitsuba(Peer):
    """The parts stay in their own frames; only their transforms change from state to state."""

    module: ClassVar[str] = "mitsuba"
    system: ClassVar[str] = "on Debian and Ubuntu: apt-get install libatomic1"
    variant: ClassVar[str]

    def prepare(self, instrument: Instrument, camera: Camera) -> None:
        """Build the scene."""
        import drjit
        import mitsuba

        super().prepare(instrument, camera)
        mitsuba.set_variant(self.variant)
        drjit.set_thread_count(1)
        self._mi: Any = mitsuba
        self._body = Body(instrument)
        self._names = {name: instrument.link_index[name] for name in instrument.meshes}
        scene: dict[str, Any] = {"type": "scene", **self._view()}
        for name, link in instrument.meshes.items():
            add_part(mitsuba, scene, name, link)
        self._scene = mitsuba.load_dict(scene)
        self._parameters = mitsuba.traverse(self._scene)
        self._image = np.empty((camera.height, camera.width), dtype=bool)

    def draw(self, transforms: FloatArray) -> Mask:
        """Move the parts and cast the rays of the window that they are seen in."""
        self._image[:] = False
        rows, columns = self._body.window(self._body.place(transforms), self.camera)
        if rows.start < rows.stop and columns.start < columns.stop:
            for name, link in self._names.items():
                self._parameters[f"place_{name}.to_world"] = self._mi.Transform4f(self._seen(transforms[link]))
            self._image[rows, columns] = self._cast(rows, columns)
        return self._image

    def _view(self) -> dict[str, Any]:
        """What the scene has beside the instrument."""
        return {}

    def _seen(self, transform: FloatArray) -> FloatArray:
        """Where a part is put, ``(4, 4)``."""
        return transform

    @abstractmethod
    def _cast(self, rows: slice, columns: slice) -> np.ndarray:
        """Which pixels of a window are covered, after an update of the scene."""


class MitsubaScalar(_Mitsuba):
    """``scalar_rgb``: a depth image, cropped to the window."""

    name: ClassVar[str] = "mitsuba-scalar"
    variant: ClassVar[str] = "scalar_rgb"

    def _view(self) -> dict[str, Any]:
        return depth_view(self._mi, self.camera)

    def _seen(self, transform: FloatArray) -> FloatArray:
        scaled = transform.copy()
        scaled[1] *= self.camera.fy / self.camera.fx
        return scaled

    def _cast(self, rows: slice, columns: slice) -> np.ndarray:
        mi, parameters = self._mi, self._parameters
        parameters["sensor.film.crop_offset"] = mi.Point2u(columns.start, rows.start)
        parameters["sensor.film.crop_size"] = mi.Vector2u(columns.stop - columns.start, rows.stop - rows.start)
        parameters.update()
        depth = np.asarray(mi.render(self._scene, spp=1))
        return np.asarray(depth[..., 0] > 0)


class MitsubaLLVM(_Mitsuba):
    """``llvm_ad_rgb``: rays of our own, so that two focal lengths are no matter."""

    name: ClassVar[str] = "mitsuba-llvm"
    variant: ClassVar[str] = "llvm_ad_rgb"

    @classmethod
    def problem(cls) -> str | None:
        """Mitsuba can't be loaded, or finds no LLVM, or one that would kill the process."""
        return super().problem() or llvm_problem()

    def _cast(self, rows: slice, columns: slice) -> np.ndarray:
        import drjit

        mi, camera = self._mi, self.camera
        self._parameters.update()
        width, height = columns.stop - columns.start, rows.stop - rows.start
        index = drjit.arange(mi.UInt32, width * height)
        # Opaque numbers keep the compiled kernel for windows of any size and place.
        across, left, top = (drjit.opaque(mi.UInt32, value) for value in (width, columns.start, rows.start))
        x = (mi.Float(index % across + left) - camera.cx) / camera.fx
        y = (mi.Float(index // across + top) - camera.cy) / camera.fy
        direction = mi.Vector3f(x, y, 1.0)
        hit = self._scene.ray_test(mi.Ray3f(mi.Point3f(NEAR_M * direction), direction))
        return np.asarray(hit).reshape(height, width)

    def remark(self) -> str:
        """Which LLVM."""
        import drjit

        return f"LLVM {'.'.join(map(str, drjit.detail.llvm_version()))}"
