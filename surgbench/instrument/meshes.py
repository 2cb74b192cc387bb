"""A user's own meshes: read, placed in the link frame, checked to be closed and to face outward."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.errors import ConfigError
from surgbench.extras import install
from surgbench.geometry import FloatArray
from surgbench.instrument.model import LinkMesh
from surgbench.instrument.shapes import round_vertices
from surgbench.instrument.spec import MeshFile
from surgbench.syntax import PARSING

Faces = NDArray[np.int32]

MESH_SUFFIXES = (".stl", ".obj", ".ply")
# Modules to the packages that they come with, where those are called otherwise.
PACKAGES = {"PIL": "pillow"}


@dataclass(frozen=True)
class EdgeDefects:
    """What keeps a mesh from being closed; all zero for a closed one.

    Attributes:
        open: Edges with a face on one side only.
        crowded: Edges shared by more than two faces.
        twisted: Edges whose two faces turn opposite ways.
        unpaired: Edges of any of these kinds that do not have as many faces running along them one way as the other.
    """

    open: int
    crowded: int
    twisted: int
    unpaired: int

    @property
    def closed(self) -> bool:
        """Whether every edge is shared by exactly two faces that are oriented alike."""
        return not (self.open or self.crowded or self.twisted)

    def __str__(self) -> str:
        """What is wrong: ``2 open edges, 1 edge with more than two faces``."""
        counts = {
            "open edge{}": self.open,
            "edge{} with more than two faces": self.crowded,
            "edge{} whose faces turn opposite ways": self.twisted,
        }
        return ", ".join(f"{n} {kind.format('s' if n > 1 else '')}" for kind, n in counts.items() if n)


def edge_defects(faces: Faces) -> EdgeDefects:
    """Count the edges that are not shared by exactly two consistently oriented faces.

    Args:
        faces: ``(F, 3)`` vertex indices.
    """
    start, end = faces.astype(np.int64).ravel(), faces[:, [1, 2, 0]].astype(np.int64).ravel()
    # One number an edge: numpy finds equal numbers much faster than equal rows.
    codes = np.minimum(start, end) * (start.max(initial=0) + 1) + np.maximum(start, end)
    _, inverse, uses = np.unique(codes, return_inverse=True, return_counts=True)
    forward = np.bincount(inverse, weights=start < end, minlength=len(uses))
    return EdgeDefects(
        open=int((uses == 1).sum()),
        crowded=int((uses > 2).sum()),
        twisted=int(((uses == 2) & (forward != 1)).sum()),
        unpaired=int((2 * forward != uses).sum()),
    )


def check_mesh(link: str, mesh: LinkMesh) -> None:
    """Refuse a mesh given in Python whose silhouette is not defined.

    Edges of four faces are let through where closed parts touch in them.

    Args:
        link: Name for the message.
        mesh: The link's body.

    Raises:
        ValueError: The mesh is not closed, refers to vertices it lacks, or has vertices that are not finite.
    """
    if not np.isfinite(mesh.vertices_m).all():
        raise ValueError(f"mesh of link '{link}' has vertices that are not finite numbers")
    count = len(mesh.vertices_m)
    if mesh.faces.min(initial=0) < 0 or mesh.faces.max(initial=-1) >= count:
        raise ValueError(f"mesh of link '{link}' has faces of other vertices than its {count} (numbered from 0)")
    defects = edge_defects(mesh.faces)
    if defects.unpaired:
        raise ValueError(
            f"mesh of link '{link}' is not closed ({defects}); mend it, for example with trimesh's merge_vertices, "
            "fill_holes and fix_normals, or load it from a file with 'close_holes: true' in the instrument file"
        )


def signed_volume(vertices_m: FloatArray, faces: Faces) -> float:
    """Volume enclosed by a closed mesh, cubic metres; negative where it faces inward."""
    a, b, c = (vertices_m[faces[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def load_mesh(entry: MeshFile, folder: Path, link: str) -> LinkMesh:
    """Read, place and check the mesh of one link.

    Vertices are merged where the file repeats them, parts that face inward are turned outward, and where the
    entry asks for it holes are closed and triangles reduced with pymeshlab.

    Args:
        entry: The link's ``mesh`` entry.
        folder: The instrument file's folder; the entry's path is relative to it.
        link: The link's name, for messages.

    Returns:
        A closed, outward-facing mesh in the link's frame.

    Raises:
        ConfigError: The file is missing, no mesh, or not closed; or pymeshlab is needed and cannot be used.
    """
    path = folder / entry.path
    vertices, faces = _read(path, link)
    vertices = (vertices * entry.scale) @ np.array(entry.rotation).T + np.array(entry.translation_m)
    vertices = round_vertices(vertices)
    if not edge_defects(faces).closed:
        # A file that is closed as it stands is left alone: parts that touch in a corner stay apart.
        vertices, faces = _merge(vertices, faces)
    defects = edge_defects(faces)
    mend = entry.close_holes and not defects.closed
    if mend or (entry.max_triangles is not None and len(faces) > entry.max_triangles):
        vertices, faces = _pymeshlab(vertices, faces, entry, path, mend)
        defects = edge_defects(faces)
    if len(faces) == 0:
        raise ConfigError(f"{path}: mesh of link '{link}' has no triangles")
    if not defects.closed:
        hint = (
            "'close_holes' left it so: delete stray faces and fill the holes in a mesh editor"
            if entry.close_holes
            else f"set 'close_holes: true' under 'mesh' of link '{link}' in the instrument file"
        )
        raise ConfigError(f"{path}: mesh of link '{link}' is not closed ({defects}); {hint}")
    faces = _outward(vertices, faces, path, link)
    return LinkMesh(vertices, faces)


def faces_inward(entry: MeshFile, folder: Path, link: str) -> bool:
    """Whether a mesh file, as it stands, is turned inside out: its volume is negative. For whoever looks at the file.

    Raises:
        ConfigError: It cannot be read.
    """
    vertices, faces = _read(folder / entry.path, link)
    return signed_volume(vertices - vertices.mean(axis=0), faces) < 0


def _read(path: Path, link: str) -> tuple[FloatArray, Faces]:
    import trimesh

    if path.suffix.lower() not in MESH_SUFFIXES:
        raise ConfigError(f"{path}: mesh of link '{link}' must be one of {', '.join(MESH_SUFFIXES)}")
    if not path.is_file():
        raise ConfigError(f"{path}: mesh file of link '{link}' is missing")
    suffix = path.suffix.lower()
    options: dict[str, Any] = {"process": False}
    source: Any = str(path)
    try:
        if suffix == ".obj":
            options.update(skip_materials=True, maintain_order=True, file_type="obj")
            source = io.StringIO(_bare_obj(path.read_text(encoding="utf-8", errors="replace")))
        with PARSING:  # in a PLY file's header, NumPy does
            mesh = trimesh.load_mesh(source, **options)
        if not isinstance(mesh, trimesh.Trimesh):
            mesh = mesh.to_mesh()
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        faces = np.asarray(mesh.faces, dtype=np.int32).reshape(-1, 3)
    except Exception as error:  # trimesh's readers raise whatever the broken bytes happen to cause
        reason = str(error).splitlines()[0] if str(error) else "damaged"
        if isinstance(error, ImportError):
            # Of a file that is what its name says, too, for example with a texture; or a reader tries another format.
            package = PACKAGES.get(error.name or "", error.name or "another package")
            reason = f"damaged, or of a kind that needs {package}, which is not installed: pip install {package}"
        raise ConfigError(f"{path}: cannot be read as a triangle mesh ({reason})") from None
    if not np.isfinite(vertices).all():
        raise ConfigError(f"{path}: mesh of link '{link}' has vertices that are not finite numbers")
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise ConfigError(f"{path}: cannot be read as a triangle mesh (no triangles, or vertices missing)")
    return vertices, faces


def _bare_obj(text: str) -> str:
    """An OBJ file's vertices and faces alone: what it says of textures takes another package to read."""
    kept = []
    for line in text.replace("\\\n", " ").splitlines():
        word, _, rest = line.strip().partition(" ")
        if word == "v":
            kept.append(line.strip())
        elif word == "f":
            kept.append("f " + re.sub(r"/\S*", "", rest))
    return "\n".join(kept) + "\n"


def _merge(vertices: FloatArray, faces: Faces) -> tuple[FloatArray, Faces]:
    """One vertex per place, in the order of first appearance, without triangles that have lost a corner."""
    _, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    merged = rank[inverse.ravel()][faces].astype(np.int32)
    whole = (merged[:, 0] != merged[:, 1]) & (merged[:, 1] != merged[:, 2]) & (merged[:, 2] != merged[:, 0])
    return vertices[first[order]], merged[whole]


def _outward(vertices: FloatArray, faces: Faces, path: Path, link: str) -> Faces:
    """Turn each part of a closed mesh that faces inward; a part is what hangs together by edges."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    # Each edge has two faces: sorted by edge, every two owners are neighbours.
    neighbours = (np.lexsort(edges.T) // 3).reshape(-1, 2).T
    graph = coo_array((np.ones(neighbours.shape[1], np.int8), tuple(neighbours)), shape=(len(faces),) * 2)
    parts, part_of_face = connected_components(graph, directed=False)
    turned = faces.copy()
    for part in range(parts):
        mine = part_of_face == part
        corners = vertices[faces[mine]]
        # About the part's own middle, so that rounding does not decide the sign for a part far from the origin.
        centre = corners.mean(axis=(0, 1))
        volume = signed_volume(vertices - centre, faces[mine])
        size = np.linalg.norm(np.ptp(corners, axis=(0, 1)))
        if abs(volume) <= 1e-12 * size**3:  # nothing but rounding
            x, y, z = centre
            raise ConfigError(
                f"{path}: mesh of link '{link}' has a part without volume ({mine.sum()} triangles about "
                f"({x:.4g}, {y:.4g}, {z:.4g}) m in the link's frame); delete it or give it thickness in a mesh editor"
            )
        if volume < 0:
            turned[mine] = faces[mine][:, ::-1]
    return turned


def _pymeshlab(vertices: FloatArray, faces: Faces, entry: MeshFile, path: Path, mend: bool) -> tuple[FloatArray, Faces]:
    """Close holes and reduce triangles; pymeshlab is imported only here."""
    try:
        import pymeshlab
    except ImportError as error:
        what = "'close_holes'" if mend else "'max_triangles'"
        if isinstance(error, ModuleNotFoundError) and error.name == "pymeshlab":
            raise ConfigError(f"{path}: {what} needs pymeshlab: {install('pymeshlab')}") from None
        raise ConfigError(
            f"{path}: {what} needs pymeshlab, which does not load ({error}): apt-get install libgl1 libopengl0"
        ) from None
    meshes = pymeshlab.MeshSet(verbose=False)
    # Millimetres: some of its filters compare with absolute lengths.
    meshes.add_mesh(pymeshlab.Mesh(vertices * 1e3, faces))
    try:
        if mend:
            meshes.meshing_merge_close_vertices(threshold=pymeshlab.PureValue(1e-3))
            meshes.meshing_remove_duplicate_faces()
            meshes.meshing_remove_null_faces()
            meshes.meshing_repair_non_manifold_edges()
            meshes.meshing_repair_non_manifold_vertices()
            meshes.meshing_re_orient_faces_coherently()
            meshes.meshing_close_holes(maxholesize=len(faces), newfaceselected=False)
        if entry.max_triangles is not None and meshes.current_mesh().face_number() > entry.max_triangles:
            meshes.meshing_decimation_quadric_edge_collapse(
                targetfacenum=entry.max_triangles, preservetopology=True, preservenormal=True
            )
    except pymeshlab.PyMeshLabException as error:
        raise ConfigError(f"{path}: pymeshlab could not mend it ({str(error).splitlines()[0]})") from None
    result = meshes.current_mesh()
    # Not merged again: where parts touch, pymeshlab has set their vertices apart.
    vertices = round_vertices(np.asarray(result.vertex_matrix()) / 1e3)
    return vertices, np.asarray(result.face_matrix(), dtype=np.int32).reshape(-1, 3)
