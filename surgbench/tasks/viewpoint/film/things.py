"""What is in the scene, as meshes: the ring and the tool that holds it, the wire, the arm that holds the camera."""

from __future__ import annotations

from functools import cache

import numpy as np
import trimesh
from numpy.typing import NDArray

from surgbench.geometry import FloatArray
from surgbench.tasks.viewpoint.film.raster import Mesh, joined
from surgbench.viewpoint import kinematics
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.optics.grasp_object import Solid, Subject, grasp_object, holder, ring
from surgbench.viewpoint.trial import Wire

Colour = tuple[int, int, int]

RING: Colour = (222, 160, 40)
STEEL: Colour = (196, 200, 206)
DARK: Colour = (92, 96, 104)
WIRE: Colour = (70, 120, 200)
BODY: Colour = (60, 140, 90)
# The instrument's shaft, and the thinner camera head at its end.
SHAFT_RADIUS_M, HEAD_RADIUS_M = 0.0042, 0.0035
# How much of the shaft is shown beyond the remote centre.
BEYOND_M = 0.04
# What reflects less is drawn dark.
DARKER = 0.3


def _coloured(points_m: FloatArray, faces: NDArray[np.int32], colour: Colour) -> Mesh:
    return Mesh(points_m, faces, np.tile(np.array(colour, dtype=np.uint8), (len(faces), 1)))


@cache
def _unit(shape: str, sections: int) -> tuple[FloatArray, NDArray[np.int32]]:
    """Points and faces of a rod from 0 to 1 along z, or of a ball, of radius 1."""
    if shape == "rod":
        mesh = trimesh.creation.cylinder(1.0, segment=np.array([[0, 0, 0], [0, 0, 1.0]]), sections=sections)
    else:
        mesh = trimesh.creation.icosphere(2, 1.0)
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int32)


def rod(start: FloatArray, end: FloatArray, radius_m: float, colour: Colour, sections: int = 16) -> Mesh:
    """A cylinder between two points."""
    points, faces = _unit("rod", sections)
    along = end - start
    across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    across *= radius_m / max(float(np.linalg.norm(across)), 1e-12)
    other = np.cross(along / max(float(np.linalg.norm(along)), 1e-12), across)
    return _coloured(start + points @ np.stack([across, other, along]), faces, colour)


def ball(centre: FloatArray, radius_m: float, colour: Colour) -> Mesh:
    """A small sphere."""
    points, faces = _unit("ball", 0)
    return _coloured(centre + radius_m * points, faces, colour)


@cache
def held_ring() -> Mesh:
    """The ring, the object with its tags, and the tool that holds it, in the feature's frame."""
    held = grasp_object()
    parts = [_painted(solid, STEEL) for solid in held.solids]
    parts += [_painted(solid, DARK if solid.reflectance < DARKER else STEEL) for solid in holder()]
    return joined([*parts, _painted(ring(), RING), *_tags(held)])


def _painted(solid: Solid, colour: Colour) -> Mesh:
    points, faces = solid.mesh.vertices_m, solid.mesh.faces
    return _coloured(np.asarray(points, dtype=np.float64), np.asarray(faces, dtype=np.int32), colour)


def _tags(subject: Subject) -> list[Mesh]:
    """Every cell of every tag as two triangles."""
    meshes = []
    for panel in subject.panels:
        rows, columns = panel.texture.shape
        x = panel.size_m[0] * (np.arange(columns + 1) / columns - 0.5)
        y = panel.size_m[1] * (0.5 - np.arange(rows + 1) / rows)
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        points = np.column_stack([grid, np.zeros(len(grid))])
        corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
        one = np.stack([corner, corner + 1, corner + columns + 1], axis=1)
        other = np.stack([corner + 1, corner + columns + 2, corner + columns + 1], axis=1)
        grey = np.rint(255 * panel.texture.ravel())[:, None].repeat(3, axis=1).astype(np.uint8)
        mesh = Mesh(points, np.concatenate([one, other]).astype(np.int32), np.concatenate([grey, grey]))
        meshes.append(mesh.moved(panel.T_object_panel))
    return meshes


def wire_mesh(wire: Wire, sides: int = 8, step_m: float = 0.0015) -> Mesh:
    """The wire as a tube."""
    every = max(1, round(step_m / max(float(np.linalg.norm(np.diff(wire.points_m[:2], axis=0))), 1e-6)))
    places = np.unique(np.append(np.arange(0, len(wire.points_m), every), len(wire.points_m) - 1))
    centre = wire.points_m[places]
    tangent = np.gradient(centre, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.empty_like(tangent)
    across[0] = np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    for at in range(1, len(across)):  # a frame that does not turn about the wire
        across[at] = across[at - 1] - (across[at - 1] @ tangent[at]) * tangent[at]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(tangent, across)
    angle = 2 * np.pi * np.arange(sides) / sides
    around = np.cos(angle)[:, None, None] * across + np.sin(angle)[:, None, None] * other
    points = np.swapaxes(centre + wire.radius_m * around, 0, 1).reshape(-1, 3)
    place, side = (grid.ravel() for grid in np.meshgrid(np.arange(len(centre) - 1), np.arange(sides), indexing="ij"))
    a, b = place * sides + side, place * sides + (side + 1) % sides
    faces = np.concatenate([np.stack([a, b, a + sides], axis=1), np.stack([b, b + sides, a + sides], axis=1)])
    return Mesh(points, faces.astype(np.int32), np.tile(np.array(WIRE, dtype=np.uint8), (len(faces), 1)))


def arm_mesh(arm: CameraArm, joints: FloatArray, T_world_base: FloatArray, colour: Colour = BODY) -> Mesh:
    """Shaft, wrist and camera head of the camera arm, in the world; a ball in its remote centre."""
    unit = np.empty((5, 3))
    kinematics.axes(np.ascontiguousarray(joints, dtype=np.float64), unit)
    depth = float(joints[2] + arm.packed[0] + arm.packed[1])
    wrist = depth * unit[1]
    yaw = wrist + arm.packed[2] * unit[3]
    camera = arm.forward(joints)[:3, 3]
    parts = [
        rod(-BEYOND_M * unit[1], wrist, SHAFT_RADIUS_M, DARK, 20),
        rod(wrist, yaw, 0.9 * SHAFT_RADIUS_M, STEEL),
        rod(yaw, camera, HEAD_RADIUS_M, colour),
        ball(wrist, SHAFT_RADIUS_M, STEEL),
        ball(yaw, SHAFT_RADIUS_M, STEEL),
        ball(np.zeros(3), 0.007, STEEL),
    ]
    return joined(parts).moved(T_world_base)
