"""Whether an instrument can be one: sizes in metres, angles in radians, tips on the body.

A file in millimetres or degrees loads without a complaint and makes masks that are white from edge to edge, so that
what cannot be is refused, with the key that makes it right.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray
from surgbench.instrument.model import LinkMesh
from surgbench.instrument.spec import InstrumentSpec, Link, LinkPoint, Marker

# A da Vinci instrument is 0.6 m long with all of its shaft, and goes through a cannula of 8 to 13 mm.
LONGEST_M = 1.0
THICKEST_M = 0.1
# The smallest part that anybody models, a needle's tip, is larger than this in one direction at least.
SMALLEST_M = 5e-4
# A tip lies on its link's body, or so far from it that it is still the same place for a keypoint.
TIP_TOLERANCE_M = 0.003


def check_instrument(spec: InstrumentSpec, meshes: dict[str, LinkMesh], path: object) -> None:
    """Refuse what cannot be an instrument in metres.

    Args:
        spec: The instrument file.
        meshes: Link name to body, in the link's frame.
        path: The file, for messages.

    Raises:
        ConfigError: A body, an offset or a tip cannot be where it is said to be; one line that says what would help.
    """
    for problem in problems(spec, meshes, path):
        raise ConfigError(problem)


def problems(spec: InstrumentSpec, meshes: dict[str, LinkMesh], path: object) -> Iterator[str]:
    """Why it cannot be an instrument in metres, a line each; see :func:`check_instrument`."""
    checks: list[Callable[[], None]] = []
    for link in spec.links:
        checks.append(partial(_check_offsets, link, path))
        if link.name in meshes:
            checks.append(partial(_check_size, link, meshes[link.name], path))
    checks += [partial(_check_tip, number, tip, meshes, path) for number, tip in enumerate(spec.tips, start=1)]
    checks += [partial(_check_marker, marker, meshes, path) for marker in spec.markers]
    for check in checks:
        try:
            check()
        except ConfigError as error:
            yield str(error)


def _check_marker(marker: Marker, meshes: dict[str, LinkMesh], path: object) -> None:
    if not on_body(marker, meshes):
        raise ConfigError(
            f"{path}: marker '{marker.name}' is further than its radius off the body of link "
            f"'{marker.point.link}'; 'point_m' is metres in the link's frame"
        )


def _check_offsets(link: Link, path: object) -> None:
    for key, value in (("a_m", link.a_m), ("d_m", link.d_m)):
        if abs(value) > LONGEST_M:
            raise ConfigError(
                f"{path}: link '{link.name}': '{key}' is {value:g} m, longer than any instrument; lengths are metres "
                f"({value / 1000:g} if it was millimetres)"
            )


def _check_size(link: Link, mesh: LinkMesh, path: object) -> None:
    extent = np.sort(np.ptp(mesh.vertices_m, axis=0))
    size = " x ".join(f"{length:.3g}" for length in np.ptp(mesh.vertices_m, axis=0))
    about = f"{path}: the body of link '{link.name}' is {size} m"
    scale = 1.0 if link.mesh is None else link.mesh.scale
    if extent[2] > LONGEST_M or extent[1] > THICKEST_M:
        if link.mesh is None:
            raise ConfigError(f"{about}, too large for an instrument; all its lengths are metres")
        raise ConfigError(
            f"{about}, too large for an instrument; if {link.mesh.path} is in millimetres, set "
            f"'scale: {scale / 1000:g}' under its 'mesh'"
        )
    if extent[2] < SMALLEST_M:
        if link.mesh is None:
            raise ConfigError(f"{about}, too small to be seen; all its lengths are metres")
        raise ConfigError(
            f"{about}, too small to be seen; if {link.mesh.path} is in metres, set 'scale: {scale * 1000:g}' under its "
            "'mesh'"
        )


def _check_tip(number: int, tip: LinkPoint, meshes: dict[str, LinkMesh], path: object) -> None:
    """A tip of a link without a body is only held to be at an instrument's distance."""
    point = np.array(tip.point_m)
    place = ", ".join(f"{value:g}" for value in tip.point_m)
    about = f"{path}: tip {number} at ({place}) m of link '{tip.link}'"
    if np.abs(point).max() > LONGEST_M:
        raise ConfigError(f"{about} is further off than any instrument is long; 'point_m' is metres")
    if tip.link not in meshes:
        return
    off = distance_to_body(meshes[tip.link], point)
    if off > TIP_TOLERANCE_M:
        raise ConfigError(
            f"{about} is {1000 * off:.1f} mm off that link's body; 'point_m' is metres in the link's frame"
        )


def on_body(marker: Marker, meshes: dict[str, LinkMesh]) -> bool:
    """Whether a marker's link has a body, with a surface so near that the marker may be on it."""
    mesh = meshes.get(marker.point.link)
    if mesh is None:
        return False
    distances = least_distance(np.array(marker.point.point_m), mesh.vertices_m[mesh.faces])
    return bool(distances.min() < marker.radius_m)


def least_distance(point: FloatArray, corners: FloatArray) -> FloatArray:
    """``(F,)`` lower bound of the distance from a point to triangles, ``(F, 3, 3)``: that to their bounding boxes."""
    outside = np.maximum(corners.min(axis=1) - point, point - corners.max(axis=1)).clip(min=0.0)
    return np.asarray(np.linalg.norm(outside, axis=1))


def distance_to_body(mesh: LinkMesh, point: FloatArray) -> float:
    """How far a point is from a closed body, at most, metres; 0 deep inside.

    Args:
        mesh: Closed, facing outward.
        point: ``(3,)`` metres, in the mesh's frame.
    """
    nearest = float(np.linalg.norm(mesh.vertices_m - point, axis=1).min())
    if nearest <= TIP_TOLERANCE_M:
        return nearest  # near enough as it is: no need of a library that takes long to load
    return exact_distance_to_body(mesh, point)


def exact_distance_to_body(mesh: LinkMesh, point: FloatArray) -> float:
    """How far a point is from a closed body, metres; 0 inside. Takes longer than :func:`distance_to_body`."""
    import trimesh
    from trimesh.proximity import closest_point_naive

    body = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    distance = float(closest_point_naive(body, point[None])[1][0])  # type: ignore[no-untyped-call]
    return 0.0 if distance == 0.0 or winding_number(mesh, point) > 0.5 else distance


def winding_number(mesh: LinkMesh, point: FloatArray) -> float:
    """How many of a mesh's closed parts hold a point, which is not on the surface; see :func:`winding_numbers`."""
    return float(winding_numbers(mesh, point[None])[0])


def winding_numbers(mesh: LinkMesh, points: FloatArray) -> FloatArray:
    """How many of a mesh's closed parts hold each of ``(n, 3)`` points, none of which is on the surface.

    The solid angle that the faces fill over 4 pi (van Oosterom and Strackee, 1983).
    """
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.faces] - points[:, None, None], 2, 0)
    la, lb, lc = (np.sqrt((corner**2).sum(axis=-1)) for corner in (a, b, c))
    triple = (a * np.cross(b, c)).sum(axis=-1)
    dots = (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return np.asarray(2 * np.arctan2(triple, la * lb * lc + dots).sum(axis=-1) / (4 * np.pi))
