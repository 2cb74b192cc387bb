"""Mitsuba scenes whose depth images are masks, exact at pixel centres."""

from __future__ import annotations

from typing import Any

import numpy as np

from surgbench.camera import NEAR_M, Camera
from surgbench.errors import SurgbenchError
from surgbench.instrument.model import LinkMesh

FAR_M = 10.0
# The llvm variants need an LLVM of 17 or later (older ones kill the process) and are no faster on these scenes
# per core; this one always works and its masks are the same.
VARIANT = "scalar_rgb"


def load_mitsuba() -> Any:
    """Mitsuba, with :data:`VARIANT` set.

    Raises:
        SurgbenchError: It cannot be loaded; one line that says what it lacks.
    """
    try:
        import mitsuba

        mitsuba.set_variant(VARIANT)
    except (ImportError, NameError) as error:
        # Without libatomic1 the import fails with a NameError about its extension module.
        raise SurgbenchError(
            f"Mitsuba cannot be loaded ({' '.join(str(error).split())}); "
            "on Debian and Ubuntu: apt-get install libatomic1"
        ) from None
    return mitsuba


def depth_view(mi: Any, camera: Camera) -> dict[str, Any]:
    """Integrator and sensor of a scene whose image is positive where a pixel's centre sees a surface.

    One sample a pixel, no jitter, box filter: a ray through each centre. The principal point's offset has the opposite
    sign of what one expects. The sensor has one focal length, so parts must be placed with y scaled by ``fy / fx``,
    which leaves their silhouettes as they are.

    Args:
        mi: Mitsuba, its variant set.
        camera: Intrinsics.
    """
    return {
        "integrator": {"type": "depth"},
        "sensor": {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(np.degrees(2.0 * np.arctan(camera.width / (2.0 * camera.fx)))),
            "principal_point_offset_x": 0.5 - (camera.cx + 0.5) / camera.width,
            "principal_point_offset_y": 0.5 - (camera.cy + 0.5) / camera.height,
            "near_clip": NEAR_M,
            "far_clip": FAR_M,
            "to_world": mi.ScalarTransform4f(np.diag([-1.0, -1.0, 1.0, 1.0])),
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "pixel_format": "luminance",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "stratified", "sample_count": 1, "jitter": False},
        },
    }


def add_part(mi: Any, scene: dict[str, Any], name: str, part: LinkMesh) -> None:
    """Add a mesh to a scene in its own frame; the parameter ``place_<name>.to_world`` then places it."""
    mesh = mi.Mesh(name, len(part.vertices_m), len(part.faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = part.vertices_m.astype(np.float32).ravel()
    parameters["faces"] = part.faces.astype(np.uint32).ravel()
    parameters.update()
    scene[f"shape_{name}"] = {"type": "shapegroup", "mesh": mesh}
    scene[f"place_{name}"] = {"type": "instance", "shapegroup": {"type": "ref", "id": f"shape_{name}"}}
