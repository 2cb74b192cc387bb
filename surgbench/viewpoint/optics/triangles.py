"""What is photographed as triangles laid end to end, for compiled code: of meshes and of pictured rectangles alike."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray, inverse_transform
from surgbench.viewpoint.optics.grasp_object import Panel, Solid, Subject

# The two triangles of a panel's corners.
_HALVES = np.array([[0, 1, 2], [0, 2, 3]])
# So many triangles that follow each other in a mesh, and so lie together, have a box of their own.
PIECE = 8


class Triangles(NamedTuple):
    """Triangles in the object's frame, part by part."""

    corners: FloatArray  # (F, 3, 3) metres, counter-clockwise seen from outside
    normal: FloatArray  # (F, 3) of unit length, outwards
    part: NDArray[np.int32]  # (F,) which part it belongs to
    box: FloatArray  # (B, 2, 3) each part's lower and upper corner
    piece_first: NDArray[np.int32]  # (N + 1,) its pieces: where each begins, and where the last one ends
    piece_of: NDArray[np.int32]  # (B + 1,) each part's first piece
    piece_box: FloatArray  # (N, 2, 3)
    reflectance: FloatArray  # (B,) of parts of one colour
    panel: NDArray[np.int32]  # (B,) number of a pictured part, -1 of others
    T_panel_object: FloatArray  # (P, 4, 4) its frame
    size: FloatArray  # (P, 2) width and height, metres
    cells: NDArray[np.int32]  # (P, 2) rows and columns of its picture
    texture: NDArray[np.float32]  # (P, rows, columns) reflectances, padded to the largest


def lay_out(subject: Subject) -> Triangles:
    """All of a subject: its panels first, in their order, then its solids."""
    parts = [panel.corners_m[_HALVES] for panel in subject.panels] + [corners_of(solid) for solid in subject.solids]
    corners = np.ascontiguousarray(np.concatenate(parts)) if parts else np.empty((0, 3, 3))
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    counts = [len(part) for part in parts]
    pictured = len(subject.panels)
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    pieces = [np.arange(start, end, PIECE) for start, end in pairwise(first.tolist())]
    piece_first = np.concatenate([*pieces, [len(corners)]]).astype(np.int32)
    return Triangles(
        corners=corners,
        normal=normal / np.where(length > 0, length, 1.0),
        part=np.repeat(np.arange(len(parts)), counts).astype(np.int32),
        box=_boxes(corners, first),
        piece_first=piece_first,
        piece_of=np.concatenate([[0], np.cumsum([len(piece) for piece in pieces])]).astype(np.int32),
        piece_box=_boxes(corners, piece_first),
        reflectance=np.array([0.0] * pictured + [solid.reflectance for solid in subject.solids]),
        panel=np.array([*range(pictured), *[-1] * len(subject.solids)], dtype=np.int32),
        **_pictures(subject.panels),
    )


def corners_of(solid: Solid) -> FloatArray:
    """``(F, 3, 3)`` corners of a solid's triangles, metres."""
    return np.asarray(solid.mesh.vertices_m[solid.mesh.faces])


def _boxes(corners: FloatArray, first: NDArray[np.int32]) -> FloatArray:
    parts = (corners[start:end] for start, end in pairwise(first.tolist()))
    return np.array([[part.min(axis=(0, 1)), part.max(axis=(0, 1))] for part in parts]).reshape(-1, 2, 3)


def _pictures(panels: tuple[Panel, ...]) -> dict[str, np.ndarray]:
    cells = np.array([panel.texture.shape for panel in panels], dtype=np.int32).reshape(-1, 2)
    rows, columns = cells.max(axis=0, initial=1)
    texture = np.zeros((len(panels), rows, columns), dtype=np.float32)
    for place, panel in zip(texture, panels, strict=True):
        place[: panel.texture.shape[0], : panel.texture.shape[1]] = panel.texture
    return {
        "T_panel_object": np.array([inverse_transform(panel.T_object_panel) for panel in panels]).reshape(-1, 4, 4),
        "size": np.array([panel.size_m for panel in panels]).reshape(-1, 2),
        "cells": cells,
        "texture": texture,
    }
