"""Instrument files: the built-in ones, a user's own, and the copy that travels with a dataset."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from surgbench.config import locate, parse_model, read_yaml
from surgbench.errors import ConfigError
from surgbench.files import write_atomic
from surgbench.instrument.meshes import load_mesh
from surgbench.instrument.model import Instrument, LinkMesh
from surgbench.instrument.parts_mesh import parts_mesh
from surgbench.instrument.plausibility import check_instrument
from surgbench.instrument.shapes import join_meshes, loft_mesh
from surgbench.instrument.spec import InstrumentSpec, Link, MeshFile

INSTRUMENT_FILE = "instrument.yaml"


def load_instrument(name_or_path: str | Path) -> Instrument:
    """Load an instrument with its meshes.

    Args:
        name_or_path: A built-in name (see ``surgbench list instruments``), or the path of an instrument file:
            any ``Path``, or a string with a slash or ending in ``.yaml`` or ``.yml``.

    Raises:
        NotFoundError: No built-in instrument has this name.
        ConfigError: The file or one of its meshes is missing or wrong, or cannot be an instrument in metres; the
            message names file and key.

    Example:
        >>> from surgbench.instrument import load_instrument
        >>> driver = load_instrument("large_needle_driver")
        >>> [link.name for link in driver.spec.links]
        ['shaft', 'wrist', 'yaw', 'jaw_right', 'jaw_left']
        >>> driver.search_limits.upper_rad  # wrist pitch, wrist yaw, half jaw angle
        array([1.5707, 1.3963, 1.5707])
    """
    return _load_file(locate("instruments", "instrument", name_or_path))


def save_instrument(instrument: Instrument, folder: Path) -> list[Path]:
    """Write an instrument so that the folder alone is enough to load it again, with identical arrays.

    Args:
        instrument: The instrument.
        folder: Where ``instrument.yaml`` and one binary PLY per link with a body go; made where missing.

    Returns:
        The files written, ``instrument.yaml`` first. The same instrument gives the same bytes.
    """
    links, meshes = [], []
    for link in instrument.spec.links:
        mesh = instrument.meshes.get(link.name)
        entry = MeshFile(path=f"{link.name}.ply") if mesh is not None else None
        links.append(link.model_copy(update={"shapes": (), "parts": (), "mesh": entry}))
        if mesh is not None:
            meshes.append((folder / f"{link.name}.ply", mesh))
    spec = instrument.spec.model_copy(update={"links": tuple(links)})
    text = yaml.safe_dump(
        spec.model_dump(mode="json", exclude_defaults=True), sort_keys=False, allow_unicode=True, width=120
    )
    for path, mesh in meshes:
        write_atomic(path, _ply_bytes(mesh))
    write_atomic(folder / INSTRUMENT_FILE, text.encode())
    return [folder / INSTRUMENT_FILE, *(path for path, _ in meshes)]


def _load_file(path: Path) -> Instrument:
    spec = parse_model(InstrumentSpec, read_yaml(path, "instrument"), str(path))
    meshes: dict[str, LinkMesh] = {}
    for link in spec.links:
        mesh = link_body(link, path)
        if mesh is not None:
            meshes[link.name] = mesh
    if not meshes:
        raise ConfigError(f"{path}: 'links': no link has 'shapes', 'parts' or a 'mesh'")
    check_instrument(spec, meshes, path)
    return Instrument(spec, meshes)


def link_body(link: Link, path: Path) -> LinkMesh | None:
    """The body of one link of an instrument file, ``None`` where it has none.

    Raises:
        ConfigError: It is not closed, or its mesh cannot be read; the message names file and link.
    """
    if link.mesh is not None:
        return load_mesh(link.mesh, path.parent, link.name)
    if link.shapes:
        return join_meshes([loft_mesh(loft) for loft in link.shapes])
    if not link.parts:
        return None
    try:
        return parts_mesh(link.parts)
    except ValueError as error:
        raise ConfigError(f"{path}: link '{link.name}': {error}") from None


def _ply_bytes(mesh: LinkMesh) -> bytes:
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(mesh.vertices_m)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", (3,))])
    faces["count"] = 3
    faces["corners"] = mesh.faces
    return header.encode() + mesh.vertices_m.astype("<f4").tobytes() + faces.tobytes()
