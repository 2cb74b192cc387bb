"""In what an instrument and a camera are not quite as declared, as far as contours tell: unknowns beside the state.

A shaft that is thicker than the model's, longer jaws, or pixels that are not as square as the calibration says shift
whole stretches of the contour, and a fit that knows of no such thing bends angles and joints to them. Each is a
constant of the recording: it is believed along with the state (:mod:`surgbench.trackers.registration.belief`), to be
next to nothing at first, and learned from all frames. The size of everything and the focal length are not among them,
for no silhouette tells either from the distance; nor is the wrist's thickness, to which the others are related.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surgbench.camera import Camera
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.silhouette import ContourPoints
from surgbench.state import POSITION, STATE_SIZE, split_arms

# Of each arm: how far the shaft's surface and the jaws' lie outside the modelled one, in relation to the wrist's, and
# how much longer the jaws are, metres; of the camera: by how much fx is larger and fy smaller than declared, a share.
OF_ARM = np.array([2e-4, 2e-4, 4e-4])
OF_CAMERA = np.array([1e-2])


class Shape:
    """Unknowns of a scene's instruments and of its reference camera, and how they move contours.

    Args:
        instruments: One per arm.

    Attributes:
        scale: ``(m,)`` natural step of each unknown, which is also its standard deviation before the first frame: three
            of each arm (OF_ARM), then OF_CAMERA.
    """

    def __init__(self, instruments: Sequence[Instrument]) -> None:
        self._instruments = tuple(instruments)
        self._jaws = [[one.link_index[tip.link] for tip in one.spec.tips] for one in instruments]
        self._tips_m = [np.array([tip.point_m for tip in one.spec.tips]) for one in instruments]
        self.scale: FloatArray = np.concatenate([*[OF_ARM] * len(instruments), OF_CAMERA])

    def jacobian(self, contour: ContourPoints, state: FloatArray, camera: Camera, *, reference: bool) -> FloatArray:
        """How far each unknown moves a contour along its normal.

        Args:
            contour: K points of a state.
            state: ``(9 * arms,)`` in the frame of the view whose contour it is.
            camera: Of that view.
            reference: Whether it is the camera that OF_CAMERA is about.

        Returns:
            ``(K, m)`` pixels per metre, or per share.
        """
        count, places = len(OF_ARM), split_arms(state)
        columns = np.zeros((len(contour.arm), len(self.scale)))
        gradient = contour.jacobian.reshape(len(columns), len(places), STATE_SIZE)[..., POSITION]
        for arm, one in enumerate(places):
            first = count * arm
            on_arm = contour.arm == arm
            on_shaft, on_jaws = contour.link == 0, np.isin(contour.link, self._jaws[arm])
            outward = _outward(gradient[:, arm])
            for column, part in enumerate((on_shaft, on_jaws)):
                columns[:, first + column] = np.where(on_arm & part, outward, 0.0)
            transforms = self._instruments[arm].link_transforms(one)
            for link, tip_m in zip(self._jaws[arm], self._tips_m[arm], strict=True):
                on_jaw = np.flatnonzero(on_arm & (contour.link == link))
                if not len(on_jaw):
                    continue
                length_m = float(np.linalg.norm(tip_m))
                origin, along = transforms[link][:3, 3], transforms[link][:3, :3] @ (tip_m / length_m)
                share = _share(contour.points_px[on_jaw], outward[on_jaw], camera, origin, along) / length_m
                columns[on_jaw, first + 2] = np.clip(share, 0.0, 1.0) * (gradient[on_jaw, arm] @ along)
        if reference:
            off = (contour.points_px - [camera.cx, camera.cy]) * contour.normals
            columns[:, -1] = off[:, 0] - off[:, 1]
        return columns


def _outward(gradient: FloatArray) -> FloatArray:
    """Pixels per metre that a surface seen edge-on moves as it grows: ``f / z`` of points whose gradients are these."""
    return np.asarray(np.hypot(gradient[:, 0], gradient[:, 1]))


def _share(
    points_px: FloatArray, outward: FloatArray, camera: Camera, origin: FloatArray, along: FloatArray
) -> FloatArray:
    """How far along an axis from its origin points lie, metres, from their pixels and their ``f / z``."""
    focal = np.array([camera.fx, camera.fy])
    depth = focal.mean() / outward
    places = np.column_stack([(points_px - [camera.cx, camera.cy]) / focal * depth[:, None], depth])
    return np.asarray((places - origin) @ along)
