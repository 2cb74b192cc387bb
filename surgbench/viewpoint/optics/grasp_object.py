"""What is in the pictures of the stereo camera: the grasp object with its tags, and the checkerboard.

The tool holds the ring by a "stable grasp" object, on whose four chamfered edges the authors put one ArUco tag each
(article, Fig. 6). Its shape is not public; what is public is where the ring's centre is from each tag, as pure
translations in the tags' frames (DEV:camera_tracking_validation.py of the authors). Each tag may be turned about the
ring's centre at will without breaking its translation, so all four can be kept exactly. Here they are on the sides of a
lozenge prism along the tool, 22 degrees off the ring's plane: two look towards the ring's normal (ids 0 and 1), two
away from it (2 and 3). The authors' logs have ids 0, 1, 3 and 2 seen 2366, 1597, 128 and 0 times.

The tool is the project's own Large Needle Driver, straight, its jaws about the object's stem: the ring's centre is
33 mm along the tool's z from its wrist yaw axis (the published code). How the wrist was bent is in no trial, so that
where a bent tool's shaft would be is not known here.

Frames: that of the feature (origin in the ring's centre, y the ring's normal, z along the tool, so that the tool is at
negative z). A tag's origin is its first corner, x to its right, y up, z out of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from surgbench.geometry import FloatArray, rigid_transform, rotation_from_vector
from surgbench.instrument import load_instrument
from surgbench.instrument.model import LinkMesh
from surgbench.state import JOINTS, STATE_SIZE

DICTIONARY = cv2.aruco.DICT_4X4_1000
# Cells across a tag, its black border included, and the white ones around it.
TAG_CELLS, QUIET_CELLS = 6, 1
# The article's side; the published code takes 7.0 mm.
TAG_SIDE_M, TAG_SIDE_IN_CODE_M = 7.5e-3, 7.0e-3
CHAMFER_RAD = np.radians(22.0)
BLACK, WHITE = 0.05, 0.9
# The wire chaser's ring: of the circle in the middle of its tube, and of the tube.
RING_RADIUS_M, TUBE_RADIUS_M = 4.0e-3, 0.8e-3
# The ring's centre along the tool's z, from the wrist yaw axis (the published code).
RING_AHEAD_M = 0.033
INSTRUMENT = "large_needle_driver"
# What the jaws hold, from the ring to between them: its ends along z and its radius. And how far they open for it.
STEM_M, STEM_RADIUS_M, JAW_RAD = (-0.029, -RING_RADIUS_M - TUBE_RADIUS_M / 2), 1.0e-3, 0.14
REFLECTANCES = {"shaft": 0.15}
STEEL, PLASTIC = 0.5, 0.7

Texture = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Panel:
    """A flat rectangle with a picture on it.

    Attributes:
        T_object_panel: ``(4, 4)``; the panel's origin is its middle, x right, y up, z out of it.
        size_m: Width and height.
        texture: ``(rows, columns)`` reflectance of its cells, 0 to 1, top row first.
    """

    T_object_panel: FloatArray
    size_m: tuple[float, float]
    texture: Texture

    @property
    def corners_m(self) -> FloatArray:
        """``(4, 3)`` in the object's frame."""
        half = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * np.array([*self.size_m, 0.0]) / 2
        return np.asarray(half @ self.T_object_panel[:3, :3].T + self.T_object_panel[:3, 3])


@dataclass(frozen=True, eq=False)
class Solid:
    """A body of one colour: mesh in the object's frame, and reflectance."""

    mesh: LinkMesh
    reflectance: float


@dataclass(frozen=True, eq=False)
class Subject:
    """What is photographed, rigid.

    Attributes:
        panels: With pictures.
        solids: Without.
    """

    panels: tuple[Panel, ...]
    solids: tuple[Solid, ...] = ()

    @property
    def points_m(self) -> FloatArray:
        """``(n, 3)`` all corners, in the object's frame."""
        return np.concatenate([p.corners_m for p in self.panels] + [s.mesh.vertices_m for s in self.solids])


@dataclass(frozen=True)
class Tags:
    """The tags on the grasp object.

    Attributes:
        side_m: Of the black square.
        centre_m: By id, the ring's centre in the tag's frame.
        axes: By id, ``(3, 3)`` the tag's axes in the feature's frame, in columns.
    """

    side_m: float = TAG_SIDE_M
    centre_m: Mapping[int, tuple[float, float, float]] = field(
        default_factory=lambda: MappingProxyType({
            0: (-0.00519, 0.01334, -0.00612),
            1: (-0.00519, -0.02143, -0.00612),
            2: (-0.00490, 0.01334, -0.00612),
            3: (-0.01343, 0.00519, -0.00612),
        })
    )  # fmt: skip
    axes: Mapping[int, FloatArray] = field(
        default_factory=lambda: MappingProxyType({index: _axes(index) for index in range(4)})
    )

    def T_feature_tag(self, index: int) -> FloatArray:  # noqa: N802
        """``(4, 4)`` where a tag is, its origin the first corner."""
        return rigid_transform(self.axes[index], -self.axes[index] @ np.array(self.centre_m[index]))

    @property
    def corners_m(self) -> FloatArray:
        """``(4, 3)`` corners of any tag in its frame, in the order in which they are detected."""
        return self.side_m * np.array([[0.0, 0, 0], [1, 0, 0], [1, -1, 0], [0, -1, 0]])


def _axes(index: int) -> FloatArray:
    sin, cos = np.sin(CHAMFER_RAD), np.cos(CHAMFER_RAD)
    along = np.array([0.0, 0.0, 1.0])
    out = np.array([[-sin, cos, 0], [sin, cos, 0], [sin, -cos, 0], [-sin, -cos, 0]])[index]
    if index == 3:  # its x axis, not its y axis, is along the tool
        return np.stack([-along, np.cross(along, out), out], axis=1)
    up = -along if index == 1 else along
    return np.stack([np.cross(up, out), up, out], axis=1)


def tag_texture(index: int) -> Texture:
    """A tag and the white around it, one texel a cell."""
    bits = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(DICTIONARY), index, TAG_CELLS)
    padded = np.pad(bits > 0, QUIET_CELLS, constant_values=True)
    return np.where(padded, WHITE, BLACK).astype(np.float32)


def grasp_object(tags: Tags | None = None, tool: bool = False) -> Subject:
    """The object with its four tags, in the feature's frame.

    Args:
        tags: Where they are; as published unless told.
        tool: Also the ring (:func:`ring`), its stem and the tool that holds it.
    """
    tags = tags or Tags()
    size = tags.side_m * (TAG_CELLS + 2 * QUIET_CELLS) / TAG_CELLS
    middle = np.array([tags.side_m / 2, -tags.side_m / 2, 0.0])
    panels = []
    for index in sorted(tags.centre_m):
        pose = tags.T_feature_tag(index)
        pose[:3, 3] += pose[:3, :3] @ middle
        panels.append(Panel(pose, (size, size), tag_texture(index)))
    # The sides of the prism are just below the tags.
    below = 6.12e-3 - 0.05e-3
    flat, wide = below / np.cos(CHAMFER_RAD), below / np.sin(CHAMFER_RAD)
    across = np.array([[wide, 0], [0, flat], [-wide, 0], [0, -flat]])
    points = [np.column_stack([across, np.full(4, z)]) for z in (-0.0232, -0.0115)]
    solids = [_solid(trimesh.convex.convex_hull(np.concatenate(points)), WHITE)]
    if tool:
        solids += [ring(), *holder()]
    return Subject(tuple(panels), tuple(solids))


def ring() -> Solid:
    """The ring, about the feature's y axis."""
    mesh = trimesh.creation.torus(RING_RADIUS_M, TUBE_RADIUS_M, major_sections=32, minor_sections=8)
    mesh.apply_transform(rigid_transform(rotation_from_vector(np.array([np.pi / 2, 0.0, 0.0])), np.zeros(3)))
    return _solid(mesh, PLASTIC)


def holder() -> tuple[Solid, ...]:
    """The stem of the ring, and the instrument that holds it."""
    stem = trimesh.creation.cylinder(STEM_RADIUS_M, segment=[[0, 0, z] for z in STEM_M], sections=16)
    instrument = load_instrument(INSTRUMENT)
    state = np.zeros(STATE_SIZE)
    state[JOINTS] = [0.0, 0.0, JAW_RAD]
    places = instrument.link_transforms(state)
    # Jaws open along the ring's normal, either way: which of the two the frames' x axes point to does not show.
    places[:, 2, 3] -= RING_AHEAD_M + places[instrument.link_index["yaw"], 2, 3]
    parts = [_solid(stem, PLASTIC)]
    for name, mesh in instrument.meshes.items():
        T_feature_link = places[instrument.link_index[name]]
        vertices = mesh.vertices_m @ T_feature_link[:3, :3].T + T_feature_link[:3, 3]
        parts.append(Solid(LinkMesh(vertices, mesh.faces), REFLECTANCES.get(name, STEEL)))
    return tuple(parts)


def _solid(mesh: trimesh.Trimesh, reflectance: float) -> Solid:
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    return Solid(LinkMesh(vertices, np.asarray(mesh.faces, dtype=np.int32)), reflectance)


@dataclass(frozen=True)
class Checkerboard:
    """The authors' calibration board.

    Attributes:
        inner: Corners between squares, across and down.
        square_m: Side of a square.
    """

    inner: tuple[int, int] = (9, 10)
    square_m: float = 0.013

    @property
    def corners_m(self) -> FloatArray:
        """``(n, 3)`` the inner corners row by row from the top left, in the board's frame; its origin is the middle."""
        across, down = self.inner
        rows, columns = np.mgrid[:down, :across]
        x, y = columns - (across - 1) / 2, (down - 1) / 2 - rows
        return self.square_m * np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)

    def subject(self) -> Subject:
        """The board with a white border of one square."""
        across, down = (count + 3 for count in self.inner)
        rows, columns = np.mgrid[:down, :across]
        edge = (rows == 0) | (rows == down - 1) | (columns == 0) | (columns == across - 1)
        texture = np.where(edge | ((rows + columns) % 2 == 1), WHITE, BLACK).astype(np.float32)
        size = across * self.square_m, down * self.square_m
        return Subject((Panel(np.eye(4), size, texture),))
