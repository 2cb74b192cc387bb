"""Meshes of links as they are rendered: the same triangles, with normals and places in textures at each corner."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.instrument.model import LinkMesh

# Edges whose faces turn by less than this are round.
CREASE_RAD = 0.75
# What one repetition of a texture covers of a link but the shaft.
TILE_M = 0.012


@dataclass(frozen=True)
class Surface:
    """Triangles whose corners are nobody else's.

    Attributes:
        vertices_m: ``(3 F, 3)`` in the link's frame.
        normals: ``(3 F, 3)``.
        places: ``(3 F, 2)`` in the link's textures.
    """

    vertices_m: FloatArray
    normals: FloatArray
    places: FloatArray

    @property
    def faces(self) -> NDArray[np.uint32]:
        """``(F, 3)``."""
        return np.arange(len(self.vertices_m), dtype=np.uint32).reshape(-1, 3)


def link_surface(mesh: LinkMesh, *, shaft: bool) -> Surface:
    """A link's surface.

    Args:
        mesh: Of the link.
        shaft: Whether its texture is wound about the z axis, once around and once along; else it is laid on from the
            side that a face looks to.
    """
    corners = mesh.vertices_m[mesh.faces]
    normals = corner_normals(mesh)
    places = _wound(corners) if shaft else _laid_on(corners)
    return Surface(corners.reshape(-1, 3), normals.reshape(-1, 3), places.reshape(-1, 2))


def corner_normals(mesh: LinkMesh) -> FloatArray:
    """``(F, 3, 3)`` normals at each face's corners: the mean over the faces there that turn by less than a crease."""
    corners = mesh.vertices_m[mesh.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
    order = np.argsort(mesh.faces.ravel(), kind="stable")
    vertex = mesh.faces.ravel()[order]
    starts = np.flatnonzero(np.r_[True, vertex[1:] != vertex[:-1]])
    normals = np.empty((mesh.faces.size, 3))
    limit = np.cos(CREASE_RAD)
    for group in np.split(order, starts[1:]):
        faces = group // 3
        near = unit[faces] @ unit[faces].T >= limit
        normals[group] = near @ flat[faces]
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    result = np.where(lengths > 1e-30, normals / np.maximum(lengths, 1e-30), np.repeat(unit, 3, axis=0))
    return result.reshape(-1, 3, 3)


def _wound(corners: FloatArray) -> FloatArray:
    around = np.arctan2(corners[..., 1], corners[..., 0]) / (2 * np.pi)
    # A triangle across the seam: all of its corners on one side.
    around = around + np.round(around[:, :1] - around)
    low, high = corners[..., 2].min(), corners[..., 2].max()
    return np.stack([around, (corners[..., 2] - low) / (high - low)], axis=-1)


def _laid_on(corners: FloatArray) -> FloatArray:
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(flat).argmax(axis=1)
    others = np.array([[1, 2], [2, 0], [0, 1]])[axis]
    places = np.take_along_axis(corners, others[:, None, :], axis=2) / TILE_M + axis[:, None, None] * 0.37
    return np.asarray(places, np.float64)
