"""What a camera should see of an instrument's painted markers: where, and how much of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgbench.camera import NEAR_M, Camera
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.instrument.model import LinkMesh
from surgbench.instrument.plausibility import least_distance, winding_numbers
from surgbench.instrument.spec import Marker

# Less than so much of a marker's paint, or so many pixels, is not looked for.
LEAST_SHOWN, LEAST_PX = 0.12, 12.0
# Triangles within reach of a marker are cut until their edges are shorter, as a share of the marker's radius.
FINEST = 0.4
# How far outside of the surface a place is held to be free, metres.
OUTSIDE_M = 2e-5


@dataclass(frozen=True)
class Shown:
    """What of each of P markers should show, as far as its own link's other side does not hide it.

    Attributes:
        places_px: ``(P, 2)`` middle of what shows; NaN where nothing does.
        points_m: ``(P, 3)`` the same in the link's frame.
        areas_px: ``(P,)``.
        shares: ``(P,)`` of the paint, as seen from straight above: 1 for a flat spot that faces the camera.
        sought: ``(P,)`` whether so much shows that it is worth looking for, in the image.
    """

    places_px: FloatArray
    points_m: FloatArray
    areas_px: FloatArray
    shares: FloatArray
    sought: NDArray[np.bool_]


class Patches:
    """The painted surface of an instrument's markers, in pieces.

    Args:
        instrument: With markers, each on a surface of its link.
    """

    def __init__(self, instrument: Instrument) -> None:
        markers = instrument.spec.markers
        pieces = [_pieces(instrument.meshes[marker.point.link], marker) for marker in markers]
        self._first = np.cumsum([0, *(len(points) for points, _ in pieces)])[:-1]
        self._owner = np.repeat(np.arange(len(markers)), [len(points) for points, _ in pieces])
        self._link = np.array([instrument.link_index[marker.point.link] for marker in markers])
        self._points = np.concatenate([points for points, _ in pieces])
        self._normals = np.concatenate([normals for _, normals in pieces])
        self._totals = np.array([np.linalg.norm(normals, axis=1).sum() for _, normals in pieces])

    def shown(self, T_cam_link: FloatArray, camera: Camera, nearest_m: FloatArray | None = None) -> Shown:
        """What a camera should see.

        A piece of area a and normal n at p, which faces the camera, covers ``-fx fy a (n . p) / z^3`` pixels.

        Args:
            T_cam_link: ``(L, 4, 4)`` of all links.
            camera: Pinhole.
            nearest_m: ``(height, width)`` depths behind which nothing shows, where they are known.
        """
        T = T_cam_link[self._link[self._owner]]
        points = (T[:, :3, :3] @ self._points[:, :, None])[..., 0] + T[:, :3, 3]
        normals = (T[:, :3, :3] @ self._normals[:, :, None])[..., 0]
        depth = np.maximum(points[:, 2], NEAR_M)
        towards = np.where(points[:, 2] > NEAR_M, np.maximum(-(normals * points).sum(axis=1), 0.0), 0.0)
        pixels = camera.project(points)
        if nearest_m is not None:
            inside = camera.contains(pixels)
            column, row = np.rint(np.where(inside[:, None], pixels, 0.0)).astype(int).T
            towards = np.where(inside & (points[:, 2] <= nearest_m[row, column]), towards, 0.0)
        covered = camera.fx * camera.fy * towards / depth**3
        areas = np.add.reduceat(covered, self._first)
        with np.errstate(invalid="ignore", divide="ignore"):
            middles = np.add.reduceat(covered[:, None] * self._points, self._first) / areas[:, None]
            places = np.add.reduceat(covered[:, None] * pixels, self._first) / areas[:, None]
        seen = np.add.reduceat(towards / np.linalg.norm(points, axis=1), self._first)
        shares = seen / self._totals
        sought = (areas >= LEAST_PX) & (shares >= LEAST_SHOWN)
        sought &= camera.contains(np.where(np.isfinite(places), places, -1.0))
        return Shown(places, middles, areas, shares, sought)


def _pieces(mesh: LinkMesh, marker: Marker) -> tuple[FloatArray, FloatArray]:
    """Middles ``(n, 3)`` of small triangles within a marker's reach, and their outward normals times their areas.

    What lies inside of another closed part of the same body is left out.
    """
    middle = np.array(marker.point.point_m)
    corners = mesh.vertices_m[mesh.faces]
    while True:
        corners = corners[least_distance(middle, corners) < marker.radius_m]
        edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        long = edges.max(axis=1) > FINEST * marker.radius_m
        if not long.any():
            break
        # Along the longest edge, whose ends become corners 0 and 1.
        order = (edges[long].argmax(axis=1)[:, None] + np.arange(3)) % 3
        cut = np.take_along_axis(corners[long], order[..., None], axis=1)
        half = (cut[:, 0] + cut[:, 1]) / 2
        halves = [np.stack([cut[:, 0], half, cut[:, 2]], axis=1), np.stack([half, cut[:, 1], cut[:, 2]], axis=1)]
        corners = np.concatenate([corners[~long], *halves])
    points = corners.mean(axis=1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    areas = np.linalg.norm(normals, axis=1)
    near = (np.linalg.norm(points - middle, axis=1) < marker.radius_m) & (areas > 0)
    points, normals, areas = points[near], normals[near], areas[near]
    outside = points + OUTSIDE_M * normals / areas[:, None]
    free = winding_numbers(mesh, outside) < 0.5
    if not free.any():  # a marker below its surface: where it is, at least
        return middle[None], np.zeros((1, 3))
    return points[free], normals[free]
