"""The shaft as a cylinder, and the two lines that a camera sees of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from surgbench.camera import Camera
from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.state import STATE_SIZE

# A section belongs to the straight part while its widest point is at least this share of the radius from the axis.
STRAIGHT_SHARE = 0.98


@dataclass(frozen=True)
class Shaft:
    """The straight part of an instrument's shaft, along z of the wrist-pitch frame.

    Attributes:
        radius_m: Radius of the cylinder.
        axis_m: ``(2,)`` x and y of its axis.
        rear_m: z of its far end.
        front_m: z of its end towards the wrist, one radius short of where its body narrows.
    """

    radius_m: float
    axis_m: FloatArray
    rear_m: float
    front_m: float


def shaft_of(instrument: Instrument) -> Shaft:
    """The cylinder that the rear half of the instrument's first link is.

    Of a tube with few sides it is the cylinder whose shadow is as wide in the mean over all directions (Cauchy: the
    perimeter of the section divided by pi).

    Raises:
        ConfigError: The first link has no body.
    """
    first = instrument.spec.links[0].name
    if first not in instrument.meshes:
        raise ConfigError(
            f"instrument '{instrument.name}' has no body on its first link '{first}': no shaft to observe"
        )
    pose = instrument.link_transforms(np.zeros(STATE_SIZE))[0]
    vertices = instrument.meshes[first].vertices_m @ pose[:3, :3].T + pose[:3, 3]
    rear, end = vertices[:, 2].min(), vertices[:, 2].max()
    hull = ConvexHull(vertices[vertices[:, 2] <= (rear + end) / 2][:, :2])
    corners = hull.points[hull.vertices]
    axis = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius = hull.area / (2 * np.pi)  # a plane hull's "area" is its perimeter
    wide = np.linalg.norm(vertices[:, :2] - axis, axis=1) >= STRAIGHT_SHARE * radius
    return Shaft(float(radius), axis, float(rear), float(vertices[wide, 2].max() - radius))


def cylinder_edges(axis_points: FloatArray, directions: FloatArray, radius_m: float, camera: Camera) -> FloatArray:
    """The two lines that bound an infinite cylinder in the image.

    The planes through the camera's centre that touch the cylinder (point p, unit direction d, radius R) have the
    normals ``k = R a / sqrt(A) -+ p x d`` with ``a = p - (d . p) d`` and ``A = |a|^2 - R^2``; the line is where such a
    plane cuts the image.

    Args:
        axis_points: ``(..., 3)`` points of the axis, metres, camera frame.
        directions: ``(..., 3)`` unit vectors.
        radius_m: Radius.
        camera: Intrinsics.

    Returns:
        ``(..., 2, 3)``: n_u, n_v and rho of ``n . (u, v) = rho``, pixels, ``|n| = 1``, n away from the axis; NaN where
        the camera's centre lies inside the cylinder.
    """
    p, d = np.asarray(axis_points, dtype=np.float64), np.asarray(directions, dtype=np.float64)
    across = p - (p * d).sum(axis=-1, keepdims=True) * d
    beyond = (across**2).sum(axis=-1) - radius_m**2
    middle = across * (radius_m / np.sqrt(np.where(beyond > 0, beyond, np.nan)))[..., None]
    side = np.cross(p, d)
    k = np.stack([middle - side, middle + side], axis=-2)
    # k points towards the axis, n away from it.
    n = -k[..., :2] / np.array([camera.fx, camera.fy])
    rho = k[..., 2] + n @ np.array([camera.cx, camera.cy])
    # Seen end on from its axis a cylinder has edges at infinity: no line.
    length = np.linalg.norm(n, axis=-1)
    length = np.where(length > 0, length, np.nan)
    return np.concatenate([n / length[..., None], (rho / length)[..., None]], axis=-1)
