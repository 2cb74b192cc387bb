"""Lenses: where a pinhole camera's pixels are seen through one, and back, for points, masks and pictures alike.

Two models, both OpenCV's, and each with as many coefficients as OpenCV takes:

- ``opencv``: (k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, tau_x, tau_y]]]]), a rational radial part of the
  ray's tangent, decentring, thin prism and tilt. ROS says ``plumb_bob`` and ``rational_polynomial``.
- ``fisheye``: (k1, k2, k3, k4), a polynomial of the ray's angle to the axis (Kannala and Brandt 2006). ROS says
  ``equidistant``.
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.camera.radial import Radial
from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray

DistortionModel = Literal["opencv", "fisheye"]
COEFFICIENTS: dict[DistortionModel, tuple[int, ...]] = {"opencv": (0, 4, 5, 8, 12, 14), "fisheye": (4,)}

# A lens is looked at to this far from its axis, as a tangent, and as an angle in a fisheye, short of the 90 degrees
# beyond which no pinhole camera sees.
WIDEST, _WIDEST_RAD = 20.0, math.atan(1000.0)
# OpenCV's inverse, a fixed-point iteration, is taken where it comes as near as this, pixels.
_FIXED_POINT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 60, 1e-10)
_NEAR_PX = 1e-6
# Elsewhere Newton's method goes on from the radial part's inverse; what it finds must be as near as this.
_NEWTON, _HALVINGS, _GAIN, _FOUND_PX = 60, 8, 0.9, 1e-4
# OpenCV's function gives derivatives with respect to everything: for so many points at once that memory stays small.
_AT_ONCE = 1 << 15
# Outside of every picture, where nothing is seen.
_NOWHERE = -1000.0


def coefficients_problem(model: DistortionModel, coefficients: tuple[float, ...]) -> str | None:
    """What is wrong with the number of coefficients, in words; ``None`` if nothing is."""
    if len(coefficients) in COEFFICIENTS[model]:
        return None
    *few, most = COEFFICIENTS[model]
    right = "4 coefficients, k1 to k4, with distortion_model 'fisheye'"
    if model == "opencv":
        right = f"{', '.join(str(count) for count in few if count)} or {most} coefficients (OpenCV's order)"
    return f"'distortion' must have {right}, not {len(coefficients)}"


class Lens:
    """The lens of one camera: from the pixels of the pinhole camera with the same intrinsics to those seen, and back.

    Args:
        matrix: ``(3, 3)`` intrinsic matrix.
        size: Width and height of the picture.
        coefficients: Of the model.
        model: Which.

    Attributes:
        widest: Tangent of the angle to the axis up to which the lens sees: beyond, the radial part of its model no
            longer grows and would fold the picture over. Nothing is drawn or accepted there.

    Raises:
        ConfigError: The model has no such number of coefficients.
    """

    def __init__(
        self, matrix: FloatArray, size: tuple[int, int], coefficients: tuple[float, ...], model: DistortionModel
    ) -> None:
        if problem := coefficients_problem(model, coefficients):
            raise ConfigError(f"camera has {len(coefficients)} distortion coefficients ({problem})")
        self._matrix, self._size, self._model = matrix, size, model
        self._coefficients = np.array(coefficients, dtype=np.float64)
        self._centre, self._focal = matrix[:2, 2].copy(), np.diag(matrix)[:2].copy()
        self._radial: Radial | None = None
        self.widest = math.inf
        if model == "fisheye":
            self._radial = Radial([1.0, *coefficients], [1.0], _WIDEST_RAD)
            self.widest = math.tan(self._radial.limit)
        elif any(coefficients):
            # OpenCV's order: the third and fourth are tangential, and those after the eighth not radial either.
            k1, k2, _, _, k3, k4, k5, k6 = (*coefficients, *(0.0,) * 8)[:8]
            self._radial = Radial([1.0, k1, k2, k3], [1.0, k4, k5, k6], WIDEST)
            self.widest = self._radial.limit

    def distort(self, pixels: FloatArray) -> FloatArray:
        """Where what a pinhole camera has at pixels is seen through the lens.

        Args:
            pixels: ``(..., 2)``, inside the picture or not.

        Returns:
            ``(..., 2)``; NaN beyond :attr:`widest` and where ``pixels`` are NaN.
        """
        straight = np.asarray(pixels, dtype=np.float64)
        if self._radial is None or straight.size == 0:
            return straight
        rays = (straight - self._centre) / self._focal
        return self._bend(rays.reshape(-1, 2)).reshape(straight.shape)

    def undistort(self, pixels: FloatArray) -> FloatArray:
        """Where the pinhole camera has what is seen through the lens at pixels: the inverse of :meth:`distort`.

        Args:
            pixels: ``(..., 2)``.

        Returns:
            ``(..., 2)``, inside the picture or not, such that :meth:`distort` leads back within 0.0001 px; NaN where
            the lens sees nothing and where ``pixels`` are NaN.
        """
        seen = np.asarray(pixels, dtype=np.float64)
        if self._radial is None or seen.size == 0:
            return seen
        flat = seen.reshape(-1, 2)
        straight = np.full_like(flat, np.nan)
        known = np.flatnonzero(np.isfinite(flat).all(axis=1))
        if self._model == "opencv" and len(known):
            guess = _fixed_point(flat[known], self._matrix, self._coefficients)
            near = self._off(guess, flat[known]) <= _NEAR_PX
            straight[known[near]] = guess[near]
            known = known[~near]
        if len(known):
            rays = self._unbend(flat[known])
            guess = rays * self._focal + self._centre
            guess[~(self._off(guess, flat[known]) <= _FOUND_PX)] = np.nan
            straight[known] = guess
        return straight.reshape(seen.shape)

    @cached_property
    def maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Where a picture without the lens finds its pixels in the one taken through it, as ``cv2.remap`` takes it.

        Returns:
            Columns and rows, ``(height, width)`` each; outside of the picture where the lens does not see.
        """
        width, height = self._size
        columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        seen = np.nan_to_num(self.distort(np.stack([columns, rows], axis=-1)), nan=_NOWHERE)
        return np.ascontiguousarray(seen[..., 0], np.float32), np.ascontiguousarray(seen[..., 1], np.float32)

    def shares(self, step_px: int = 16) -> tuple[float, float]:
        """How much of the picture can be undistorted, of its pixels looked at every so many.

        Returns:
            The share where the lens sees something, and the share that an undistorted picture of the same size and
            intrinsics holds.
        """
        width, height = self._size
        columns, rows = np.meshgrid(*(np.arange(0.0, size, step_px) for size in (width, height)))
        straight = self.undistort(np.stack([columns, rows], axis=-1))
        held = (straight >= -0.5) & (straight <= np.array([width, height]) - 0.5)
        return float(np.isfinite(straight[..., 0]).mean()), float(held.all(axis=-1).mean())

    def _off(self, straight: FloatArray, seen: FloatArray) -> FloatArray:
        """How far from ``seen`` the lens shows ``straight``, both ``(n, 2)``; NaN where it does not."""
        return np.asarray(np.linalg.norm(self.distort(straight) - seen, axis=1))

    def _bend(self, rays: FloatArray) -> FloatArray:
        """Pixels ``(n, 2)`` of rays ``(x/z, y/z)``, NaN beyond the widest."""
        inside = np.where((np.hypot(rays[:, 0], rays[:, 1]) <= self.widest)[:, None], rays, np.nan)
        if self._model == "opencv":
            parts = range(0, len(inside), _AT_ONCE)
            return np.concatenate([self._project(inside[start : start + _AT_ONCE])[0] for start in parts])
        assert self._radial is not None
        tangent = np.hypot(inside[:, 0], inside[:, 1])
        angle = self._radial(np.arctan(tangent))
        scale = np.divide(angle, tangent, out=np.ones_like(tangent), where=tangent > 0)
        return np.asarray(inside * scale[:, None] * self._focal + self._centre)

    def _project(self, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """OpenCV's: pixels ``(n, 2)`` and their derivatives ``(n, 2, 2)`` with respect to the rays' x and y."""
        none = np.zeros(3)
        points = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
        seen, derivatives = cv2.projectPoints(points.reshape(-1, 1, 3), none, none, self._matrix, self._coefficients)
        # Columns 3 and 4: to move a point of depth 1 is to move its ray.
        moved = np.asarray(derivatives, dtype=np.float64).reshape(len(rays), 2, -1)[:, :, 3:5]
        return np.asarray(seen, dtype=np.float64).reshape(-1, 2), moved

    def _unbend(self, seen: FloatArray) -> FloatArray:
        """Rays ``(n, 2)`` that the lens shows at pixels, or nearly; the caller looks whether it does."""
        assert self._radial is not None
        bent = (seen - self._centre) / self._focal
        if len(self._coefficients) == 14:
            bent = self._untilted(bent)
        radius = np.hypot(bent[:, 0], bent[:, 1])
        t = self._radial.inverse(radius)
        tangent = np.tan(t) if self._model == "fisheye" else t
        rays = bent * np.divide(tangent, radius, out=np.ones_like(radius), where=radius > 0)[:, None]
        if self._model == "opencv":
            for start in range(0, len(rays), _AT_ONCE):
                part = slice(start, start + _AT_ONCE)
                rays[part] = self._newton(rays[part], seen[part])
        return rays

    def _untilted(self, bent: FloatArray) -> FloatArray:
        """What the tilt of the sensor does, undone (OpenCV's ``computeTiltProjectionMatrix``)."""
        across, down = self._coefficients[12:]
        sx, cx, sy, cy = math.sin(across), math.cos(across), math.sin(down), math.cos(down)
        about_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
        about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
        turned = about_y @ about_x
        onto = np.array([[turned[2, 2], 0, -turned[0, 2]], [0, turned[2, 2], -turned[1, 2]], [0, 0, 1.0]])
        back = np.concatenate([bent, np.ones((len(bent), 1))], axis=1) @ np.linalg.inv(onto @ turned).T
        return np.asarray(back[:, :2] / back[:, 2:])

    def _newton(self, rays: FloatArray, seen: FloatArray) -> FloatArray:
        """Rays moved until the lens shows them at ``seen``; each step is halved until it comes nearer, or given up."""
        rays = self._within(rays)
        pixels, slopes = self._project(rays)
        off = np.linalg.norm(pixels - seen, axis=1)
        going = off > _NEAR_PX
        for _ in range(_NEWTON):
            at_work = np.flatnonzero(going)
            if not len(at_work):
                break
            here, target = rays[at_work], seen[at_work]
            step = _solved(slopes[at_work], target - pixels[at_work])
            share = np.ones(len(at_work))
            for _ in range(_HALVINGS):
                there = self._within(here + share[:, None] * step)
                new_pixels, new_slopes = self._project(there)
                new_off = np.linalg.norm(new_pixels - target, axis=1)
                worse = ~(new_off < _GAIN * off[at_work])
                if not worse.any():
                    break
                share[worse] /= 2
            going[at_work[worse]] = False
            better, gained = at_work[~worse], ~worse
            rays[better], off[better] = there[gained], new_off[gained]
            pixels[better], slopes[better] = new_pixels[gained], new_slopes[gained]
            going &= off > _NEAR_PX
        return rays

    def _within(self, rays: FloatArray) -> FloatArray:
        """Rays beyond the widest are drawn back to it."""
        tangent = np.hypot(rays[:, 0], rays[:, 1])
        return np.asarray(rays * np.minimum(1.0, self.widest / np.maximum(tangent, 1e-300))[:, None])


def _solved(slopes: FloatArray, wanted: FloatArray) -> FloatArray:
    """``(n, 2)`` steps that change pixels by ``wanted``; none where ``(n, 2, 2)`` slopes are singular."""
    (a, b), (c, d) = np.moveaxis(slopes, 0, -1)
    u, v = wanted.T
    size = a * d - b * c
    steps = np.stack([d * u - b * v, a * v - c * u], axis=-1)
    return np.asarray(np.divide(steps, size[:, None], out=np.zeros_like(steps), where=size[:, None] != 0))


@lru_cache(maxsize=16)
def lens(
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int],
    coefficients: tuple[float, ...],
    model: DistortionModel,
) -> Lens:
    """The lens of a camera with intrinsics fx, fy, cx, cy; the same object for the same camera.

    Raises:
        ConfigError: The model has no such number of coefficients.
    """
    fx, fy, cx, cy = intrinsics
    return Lens(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), size, coefficients, model)


def _fixed_point(pixels: FloatArray, matrix: FloatArray, coefficients: FloatArray) -> FloatArray:
    """``(N, 2)`` of ``(N, 2)``: OpenCV's inverse of a lens, iterated until it stands still, whether or not it does."""
    points = pixels.reshape(-1, 1, 2)
    older = getattr(cv2, "undistortPointsIter", None)  # until 4, criteria were another function's
    if older is not None:
        found = older(points, matrix, coefficients, np.eye(3), matrix, _FIXED_POINT)
    else:
        found = cv2.undistortPoints(points, matrix, coefficients, P=matrix, criteria=_FIXED_POINT)
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)
