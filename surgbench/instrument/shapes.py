"""Parametric bodies: a :class:`Loft` of an instrument file as a closed triangle mesh."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.instrument.model import LinkMesh
from surgbench.instrument.spec import CrossSection, Loft

_AXES = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2)}


def _superellipse(angles_rad: NDArray[np.floating], exponent: float) -> FloatArray:
    """Points ``(N, 2)`` of ``|a|^n + |b|^n = 1`` at the angles of the usual parametrisation."""
    points = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=-1)
    curve: FloatArray = np.sign(points) * np.abs(points) ** (2.0 / exponent)
    return curve


def _perimeter(points: FloatArray) -> float:
    return float(np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1).sum())


@lru_cache(maxsize=1024)
def _unit_ring(sides: int, exponent: float, aspect: float) -> tuple[tuple[float, float], ...]:
    # A polygon inscribed in the curve looks too narrow. Its mean width over all directions is its perimeter / pi
    # (Cauchy), so it is grown to the curve's perimeter: a shaft of few sides casts a shadow of the right mean width.
    scale = np.array([1.0, aspect])
    corners = _superellipse((np.arange(sides) + 0.5) * (2 * np.pi / sides), exponent)
    curve = _superellipse(np.arange(2048) * (2 * np.pi / 2048), exponent)
    grown = corners * (_perimeter(curve * scale) / _perimeter(corners * scale))
    return tuple((float(a), float(b)) for a, b in grown)


def _ring(section: CrossSection, sides: int) -> FloatArray:
    """Corners ``(sides, 2)`` of one cross-section, metres along the two cross axes, counter-clockwise."""
    radii = np.array(section.radii_m)
    unit = np.array(_unit_ring(sides, section.exponent, section.radii_m[1] / section.radii_m[0]))
    ring: FloatArray = unit * radii + np.array(section.centre_m)
    return ring


def loft_mesh(loft: Loft) -> LinkMesh:
    """A loft as a closed, outward-facing mesh: one ring of corners per section, flat caps at both ends.

    Args:
        loft: The solid, metres in its link's frame.

    Returns:
        ``sides * sections`` vertices and ``2 * sides * (sections - 1) + 2 * (sides - 2)`` triangles.
    """
    sides, count = loft.sides, len(loft.sections)
    first, second, along = _AXES[loft.axis]
    vertices = np.empty((count, sides, 3))
    for ring, section in zip(vertices, loft.sections, strict=True):
        ring[:, [first, second]] = _ring(section, sides)
        ring[:, along] = section.at_m
    here = np.arange(sides)
    there = (here + 1) % sides
    faces = []
    for index in range(count - 1):
        low, high = index * sides, (index + 1) * sides
        faces.append(np.stack([low + here, low + there, high + there], axis=1))
        faces.append(np.stack([low + here, high + there, high + here], axis=1))
    # Caps as strips across the polygon rather than fans: fewer needle-like triangles.
    cap = np.array(strip(sides))
    faces.append(cap[:, ::-1])
    faces.append(cap + (count - 1) * sides)
    return LinkMesh(round_vertices(vertices.reshape(-1, 3)), np.concatenate(faces).astype(np.int32))


def strip(sides: int) -> list[tuple[int, int, int]]:
    """Triangles of a convex polygon with corners 0 … sides - 1, counter-clockwise."""
    triangles, low, high = [], 0, sides - 1
    while high - low > 1:
        triangles.append((low, low + 1, high))
        low += 1
        if high - low > 1:
            triangles.append((low, high - 1, high))
            high -= 1
    return triangles


def round_vertices(vertices_m: FloatArray) -> FloatArray:
    """Vertices rounded to float32 (kept as float64), so that a mesh read back from a file is the same mesh."""
    # Adding zero turns -0.0 into 0.0.
    rounded: FloatArray = vertices_m.astype(np.float32).astype(np.float64) + 0.0
    return rounded


def join_meshes(parts: Sequence[LinkMesh]) -> LinkMesh:
    """Several closed meshes as one; they may interpenetrate, the body is their union.

    Args:
        parts: At least one mesh, all in the same frame.

    Returns:
        Their vertices and faces one after the other.
    """
    starts = np.cumsum([0, *(len(part.vertices_m) for part in parts[:-1])])
    faces = [part.faces + np.int32(start) for part, start in zip(parts, starts, strict=True)]
    return LinkMesh(np.concatenate([part.vertices_m for part in parts]), np.concatenate(faces).astype(np.int32))
