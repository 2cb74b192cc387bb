"""Objects of BOP: the links of instruments, their models in millimetres."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.tasks.instrument.dataset import InstrumentDataset

MM = 1e3


@dataclass(frozen=True)
class BopObject:
    """A link with a body.

    Attributes:
        id: From 1.
        instrument: Whose.
        link: Its name.
    """

    id: int
    instrument: Instrument
    link: str

    @cached_property
    def alone(self) -> Instrument:
        """The instrument with no other body than this one."""
        return replace(self.instrument, meshes={self.link: self.instrument.meshes[self.link]})

    @cached_property
    def centre_m(self) -> FloatArray:
        """``(3,)`` centre of the bounding box in the link's frame: BOP's models have their origin there."""
        vertices = self.instrument.meshes[self.link].vertices_m
        return 0.5 * np.asarray(vertices.min(axis=0) + vertices.max(axis=0))

    @cached_property
    def vertices_mm(self) -> FloatArray:
        """``(V, 3)`` in the model's frame."""
        return MM * (self.instrument.meshes[self.link].vertices_m - self.centre_m)

    def poses(self, states: FloatArray) -> FloatArray:
        """``(T, 4, 4)`` of ``(T, 9)`` states: from the model's frame to the camera's, millimetres."""
        poses = np.array(self.instrument.link_transforms(states)[:, self.instrument.link_index[self.link]])
        poses[:, :3, 3] = MM * (poses[:, :3, 3] + poses[:, :3, :3] @ self.centre_m)
        return poses

    def info(self) -> dict[str, Any]:
        """Bounding box and diameter, the largest distance of two vertices, millimetres; the symmetry of a tube."""
        low, high = self.vertices_mm.min(axis=0), self.vertices_mm.max(axis=0)
        corners = self.vertices_mm[ConvexHull(self.vertices_mm).vertices]  # the two lie on the hull
        box = {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
        box |= {f"size_{axis}": float(value) for axis, value in zip("xyz", high - low, strict=True)}
        info: dict[str, Any] = {"diameter": float(pdist(corners).max()), **box}
        if self.instrument.symmetry == "axis":
            info["symmetries_continuous"] = [{"axis": [0, 0, 1], "offset": (-MM * self.centre_m).tolist()}]
        return info

    def about(self) -> dict[str, Any]:
        """What BOP has no field for."""
        moved = (MM * self.centre_m).tolist()
        return {"instrument": self.instrument.name, "link": self.link, "link_from_model_mm": moved}


def objects_of(dataset: InstrumentDataset) -> list[BopObject]:
    """The links with a body of all of a dataset's instruments, numbered in the order of their names and files."""
    instruments = [dataset.instrument(name) for name in sorted(dataset.manifest.instruments)]
    links = [(one, link.name) for one in instruments for link in one.spec.links if link.name in one.meshes]
    return [BopObject(number, instrument, link) for number, (instrument, link) in enumerate(links, start=1)]


def write_models(folder: Path, objects: list[BopObject]) -> None:
    """Write ``obj_000001.ply``, ..., ``models_info.json``, and ``objects.json``, which says what each of them is."""
    folder.mkdir()
    for one in objects:
        (folder / f"obj_{one.id:06d}.ply").write_text(_ply(one), encoding="utf-8")
    for name, content in (("models_info", BopObject.info), ("objects", BopObject.about)):
        rows = {str(one.id): content(one) for one in objects}
        (folder / f"{name}.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def _ply(one: BopObject) -> str:
    """ASCII PLY with vertex normals, the means of the faces' normals weighted by their area."""
    faces = one.instrument.meshes[one.link].faces
    corners = one.vertices_mm[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(one.vertices_mm)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], across)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    header = ["ply", "format ascii 1.0", f"element vertex {len(normals)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    vertices = [" ".join(f"{value:.9g}" for value in row) for row in np.hstack([one.vertices_mm, normals])]
    return "\n".join([*header, *vertices, *(f"3 {a} {b} {c}" for a, b, c in faces)]) + "\n"
