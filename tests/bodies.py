"""Bodies, poses and cameras that tests of the silhouette engine share."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from hypothesis import strategies as st
from support import resting_state

from surgbench.camera import Camera
from surgbench.geometry import FloatArray
from surgbench.silhouette import Reference, SilhouetteEvaluator


def bodies() -> dict[str, Any]:
    box = trimesh.creation.box((0.02, 0.03, 0.05))
    ring = trimesh.creation.torus(0.02, 0.006, major_sections=12, minor_sections=8)
    rod = trimesh.creation.cylinder(0.004, 0.3, sections=9)
    crossing = trimesh.util.concatenate([box, rod, trimesh.creation.icosphere(1, 0.018)])
    touching: Any = trimesh.util.concatenate([box, box.copy().apply_translation((0.02, 0, 0))])
    touching.merge_vertices()
    return {"box": box, "ring": ring, "rod": rod, "crossing": crossing, "touching": touching}


BODIES = bodies()
angle = st.floats(-np.pi, np.pi)
poses = st.tuples(angle, angle, angle, st.floats(-0.08, 0.08), st.floats(-0.08, 0.08), st.floats(-0.05, 0.25)).map(
    lambda pose: np.array([*pose, 0.0, 0.0, 0.0])
)
joints = st.tuples(st.floats(-1.57, 1.57), st.floats(-1.39, 1.39), st.floats(0.0, 1.57))
needle_driver_states = st.tuples(poses, joints).map(lambda both: np.array([*both[0][:6], *both[1]]))


def bounding_box(mask: np.ndarray) -> list[int]:
    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        return [0, 0, 0, 0]
    return [int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1]


def assert_counts_belong_to_mask(evaluator: SilhouetteEvaluator, state: FloatArray, image: np.ndarray) -> None:
    stripes = (np.indices(image.shape).sum(axis=0) // 2) % 2 == 0
    score = evaluator.score(state[None], Reference(stripes))
    assert score.area[0] == np.count_nonzero(image)
    assert score.overlap[0] == np.count_nonzero(image & stripes)
    assert score.box[0].tolist() == bounding_box(image)


def with_split_edges(mesh: trimesh.Trimesh, splits: int) -> trimesh.Trimesh:
    """The same body with a vertex amid some edges that one of the two faces does not know of.

    A face of no area closes the mesh there, as in files from CAD programs.
    """
    vertices, faces = mesh.vertices.tolist(), mesh.faces.tolist()
    for k in range(splits):
        a, b, c = faces[k]
        vertices.append([(2 * p + q) / 3 for p, q in zip(vertices[a], vertices[b], strict=True)])
        middle = len(vertices) - 1
        faces[k] = [a, middle, c]
        faces += [[middle, b, c], [a, b, middle]]
    return trimesh.Trimesh(vertices, faces, process=False)


def with_corners_drawn_together(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A box as a pyramid: its top is four vertices in one place, with faces of no area between them."""
    vertices = mesh.vertices.copy()
    vertices[vertices[:, 2] > 0] = [0.003, 0.002, 0.02]
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


DEGENERATE: dict[str, Any] = {
    "split box": with_split_edges(trimesh.creation.box((0.02, 0.03, 0.05)), 8),
    "split sphere": with_split_edges(trimesh.creation.icosphere(1, 0.02), 30),
    "pyramid": with_corners_drawn_together(trimesh.creation.box((0.02, 0.03, 0.05))),
    "sheet": trimesh.creation.box((0.02, 0.03, 0.0)),
    "needle": trimesh.creation.box((1e-9, 0.03, 1e-9)),
    "touching": BODIES["touching"],
    "one in the other": trimesh.util.concatenate([BODIES["box"], BODIES["box"].copy().apply_scale(0.5)]),
    "twice": trimesh.util.concatenate([BODIES["ring"], BODIES["ring"].copy()]),
}
cameras = st.builds(
    Camera,
    width=st.integers(1, 70),
    height=st.integers(1, 70),
    fx=st.floats(5.0, 400.0),
    fy=st.floats(5.0, 400.0),
    cx=st.floats(-40.0, 110.0),
    cy=st.floats(-40.0, 110.0),
)


def zigzag(legs: int, width_m: float, pitch_m: float, height_m: float) -> trimesh.Trimesh:
    """One connected bar that goes up and down from left to right: a row crosses it ``legs`` times, in a single body."""
    corners = [
        (pitch_m * k + x, height_m * (k % 2), z)
        for k in range(legs + 1)
        for x, z in [(0.0, 0.0), (width_m, 0.0), (width_m, width_m), (0.0, width_m)]
    ]
    faces: list[tuple[int, ...]] = [(0, 2, 1), (0, 3, 2)]
    for ring in range(0, 4 * legs, 4):
        for side in range(4):
            a, b = ring + side, ring + (side + 1) % 4
            faces += [(a, b, b + 4), (a, b + 4, a + 4)]
    last = 4 * legs
    faces += [(last, last + 1, last + 2), (last, last + 2, last + 3)]
    mesh = trimesh.Trimesh(np.array(corners) - np.mean(corners, axis=0), faces, process=False)
    mesh.fix_normals()
    assert mesh.is_watertight
    return mesh


def two_arm_states(count: int) -> FloatArray:
    states = np.tile(resting_state(), (count, 2))
    states[:, 9 + 2] *= -1
    noise = np.random.default_rng(1).normal(0, 0.05, states.shape) * np.tile([1, 5, 1, 0.1, 0.1, 0.1, 3, 3, 3], 2)
    return np.asarray(states + noise)
