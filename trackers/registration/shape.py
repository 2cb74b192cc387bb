"""In what an instrument and a camera are not quite as declared, as far as contours tell: unknowns beside the state.

A shaft that is thicker than the model's, longer jaws, or pixels that are not as square as the calibration says shift
whole stretches of the contour, and a fit that knows of no such thing bends angles and joints to them. Each is a
constant of the recording: it is believed along with the state (:mod:`surgbench.trackers.registration.belief`), to be
next to nothing at first, and learned from all frames. The size of everything and the focal length are not among them,
for no silhouette tells either from the distance; nor is the wrist's thickness, to which the others are related.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from surgbench.camera import Camera
from surgbench.compiled import compiled
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.silhouette import ContourPoints
from surgbench.state import POSITION, STATE_SIZE, split_arms

X = POSITION.start

# Of each arm: how far the shaft's surface and the jaws' lie outside the modelled one, in relation to the wrist's, and
# how much longer the jaws are, metres; of the camera: by how much fx is larger and fy smaller than declared, a share.
OF_ARM = np.array([2e-4, 2e-4, 4e-4])
OF_ARM_COUNT = len(OF_ARM)
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
        self._jaws = [[one.link_index[tip.link] for tip in one.tips] for one in instruments]
        self._links = np.array(self._jaws)
        self._tips_m = [np.array([tip.point_m for tip in one.tips]) for one in instruments]
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
        places = split_arms(state)
        # Where each jaw begins in the view's frame, which way it goes, and how far to its tip.
        jaws = np.empty((len(places), len(self._jaws[0]), 7))
        for arm, one in enumerate(places):
            transforms = self._instruments[arm].link_transforms(one)
            for jaw, (link, tip_m) in enumerate(zip(self._jaws[arm], self._tips_m[arm], strict=True)):
                length_m = math.sqrt(tip_m @ tip_m)
                jaws[arm, jaw, :3] = transforms[link][:3, 3]
                jaws[arm, jaw, 3:6] = transforms[link][:3, :3] @ (tip_m / length_m)
                jaws[arm, jaw, 6] = length_m
        columns = np.zeros((len(contour.arm), len(self.scale)))
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        _fill(contour.points_px, contour.normals, contour.arm, contour.link, contour.jacobian, self._links, jaws, lens,
              reference, columns)  # fmt: skip
        return columns


@compiled(makes_arrays=True)
def _fill(
    points: Any, normals: Any, arms: Any, links: Any, gradient: Any, jaw_links: Any, jaws: Any, lens: Any,
    reference: bool, columns: Any,
) -> None:  # fmt: skip
    fx, fy, cx, cy = lens
    last = columns.shape[1] - 1
    for k in range(points.shape[0]):
        arm, link, u, v = arms[k], links[k], points[k, 0] - cx, points[k, 1] - cy
        first, place = OF_ARM_COUNT * arm, STATE_SIZE * arm + X
        gx, gy, gz = gradient[k, place], gradient[k, place + 1], gradient[k, place + 2]
        outward = np.hypot(gx, gy)  # f / z, for the normal is of unit length
        if link == 0:
            columns[k, first] = outward
        for jaw in range(jaw_links.shape[1]):
            if link != jaw_links[arm, jaw]:
                continue
            columns[k, first + 1] = outward
            x, y, z, dx, dy, dz, length_m = jaws[arm, jaw]
            depth = 0.5 * (fx + fy) / outward
            along_m = (u / fx * depth - x) * dx + (v / fy * depth - y) * dy + (depth - z) * dz
            share = min(max(along_m / length_m, 0.0), 1.0)  # a longer jaw moves most at its tip
            columns[k, first + 2] = share * (gx * dx + gy * dy + gz * dz)
        if reference:
            columns[k, last] = u * normals[k, 0] - v * normals[k, 1]
