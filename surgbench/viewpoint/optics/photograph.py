"""Grey pictures as a camera with a distorting lens takes them.

Light comes from all sides alike, and a surface is as bright as it reflects; what something covers along its normal is
dark. Only the part of the picture that the subject covers is rendered (:mod:`surgbench.viewpoint.optics.raster`), by a
pinhole camera with ``OVERSAMPLE`` rays a pixel in each direction, and then bent: as many points of each pixel are
looked up in it, at the places which the lens sees there, and averaged. Mitsuba makes the same pictures but for single
pixels on edges (a test), and takes more than ten times as long.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from surgbench.camera import NEAR_M, Camera
from surgbench.geometry import FloatArray
from surgbench.viewpoint.optics.grasp_object import Subject
from surgbench.viewpoint.optics.raster import coverage, find_extent, find_nearest, shade
from surgbench.viewpoint.optics.triangles import lay_out

OVERSAMPLE = 2
# Beyond the subject's box, so that pixels on its border find the background.
MARGIN_PX = 2
# The picture is rendered in squares of so many pixels, as far as the subject is seen in them.
SQUARE_PX = 16
BACKGROUND = 0.3
NOISE = 0.006

# Of the normal distribution, so that two random bytes make a number of it.
_QUANTILES = ndtri((np.arange(1 << 16) + 0.5) / (1 << 16)).astype(np.float32)

Picture = NDArray[np.uint8]


class Photographer:
    """Takes pictures of one thing with one camera. Several threads may share it.

    Args:
        camera: Intrinsics and distortion.
        subject: What is photographed.
        background: Grey level behind it, 0 to 1.
        noise: Standard deviation of the sensor's noise, of the range from black to white.
    """

    def __init__(self, camera: Camera, subject: Subject, background: float = BACKGROUND, noise: float = NOISE) -> None:
        self.camera, self.background, self.noise = camera, background, noise
        self._triangles = lay_out(subject)
        self._covered = coverage(self._triangles)
        self._map, pinhole, self._blind = _bend(camera)
        self._intrinsics = np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy])
        self._squares = _squares(self._map)

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
        place = np.ascontiguousarray(T_cam_object, dtype=np.float64)
        box = self._box(place)
        if box is not None:
            low, pinhole = self._render(place, self._squares[box])
            top, bottom, left, right = (SQUARE_PX * bound for part in box for bound in (part.start, part.stop))
            part = slice(top * OVERSAMPLE, bottom * OVERSAMPLE), slice(left * OVERSAMPLE, right * OVERSAMPLE)
            columns, rows = (self._map[axis][part] - np.float32(low[axis]) for axis in (0, 1))
            bent = cv2.remap(pinhole, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            small = bent.shape[1] // OVERSAMPLE, bent.shape[0] // OVERSAMPLE
            picture[top:bottom, left:right] = cv2.resize(bent, small, interpolation=cv2.INTER_AREA)
        picture[self._blind] = 0.0
        if self.noise:
            drawn = np.frombuffer(rng.bytes(2 * picture.size), dtype="<u2").reshape(size)
            picture += np.float32(self.noise) * _QUANTILES[drawn]
        grey: Picture = np.rint(255.0 * picture.clip(0.0, 1.0)).astype(np.uint8)
        return grey

    def _box(self, T_cam_object: FloatArray) -> tuple[slice, slice] | None:
        """Rows and columns of the squares in which the subject may be seen; ``None`` where it is in none."""
        extent = np.empty((2, 2))
        find_extent(self._triangles, T_cam_object, self._intrinsics, NEAR_M, extent)
        low, high = extent[0] - MARGIN_PX * OVERSAMPLE, extent[1] + MARGIN_PX * OVERSAMPLE
        met = ((self._squares[..., 1, :] >= low) & (self._squares[..., 0, :] <= high)).all(axis=-1)
        if not met.any():
            return None
        rows, columns = (np.flatnonzero(met.any(axis=axis)) for axis in (1, 0))
        return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)

    def _render(self, T_cam_object: FloatArray, squares: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """The pinhole camera's picture where some squares look it up, and the pixel in its corner."""
        low = np.floor(squares[..., 0, :].min(axis=(0, 1))).astype(np.int64)
        columns, rows = np.ceil(squares[..., 1, :].max(axis=(0, 1))).astype(np.int64) + 1 - low
        inverse, face_of = np.zeros((rows, columns)), np.full((rows, columns), -1, dtype=np.int32)
        find_nearest(self._triangles, T_cam_object, self._intrinsics, NEAR_M, low, inverse, face_of)
        grey = np.full((rows, columns), self.background, dtype=np.float32)
        shade(self._triangles, self._covered, T_cam_object, self._intrinsics, low, inverse, face_of, grey)
        return low, grey


@cache
def _bend(camera: Camera) -> tuple[NDArray[np.float32], Camera, NDArray[np.bool_]]:
    """Where a pinhole camera sees what the lens sees in each of a pixel's points, and that pinhole camera.

    Returns:
        ``(2, OVERSAMPLE height, OVERSAMPLE width)`` columns and rows of the pinhole camera; it has ``OVERSAMPLE`` times
        the focal length and is wide enough. ``(height, width)`` pixels in which the lens sees nothing: they stay black.
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
    return np.ascontiguousarray(np.moveaxis(fine - low, -1, 0), dtype=np.float32), pinhole, whole


def _squares(grid: NDArray[np.float32]) -> FloatArray:
    """``(rows, columns, 2, 2)``: the lowest and highest pinhole pixels that each square of the picture looks up."""
    step = SQUARE_PX * OVERSAMPLE
    rows, columns = range(0, grid.shape[1], step), range(0, grid.shape[2], step)
    pieces = [[grid[:, row : row + step, column : column + step] for column in columns] for row in rows]
    return np.array([[[piece.min(axis=(1, 2)), piece.max(axis=(1, 2))] for piece in line] for line in pieces])
