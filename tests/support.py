"""Bodies and states that several tests use."""

from __future__ import annotations

import numpy as np
import trimesh

from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument
from surgbench.instrument.model import LinkMesh
from surgbench.instrument.spec import InstrumentSpec


def rigid_instrument(mesh: trimesh.Trimesh) -> Instrument:
    """An instrument of one link, whose body is ``mesh`` in the wrist-pitch frame."""
    joint = {"search_rad": (-1.0, 1.0), "generate_rad": (-1.0, 1.0)}
    tip = {"link": "body", "point_m": (0.0, 0.0, 0.0)}
    spec = InstrumentSpec.model_validate(
        {
            "format": "surgbench-instrument-1",
            "name": "rigid",
            "title": "One rigid body",
            "joints": {"wrist_pitch": joint, "wrist_yaw": joint, "jaw": joint},
            "links": [{"name": "body"}],
            "tips": [tip, tip],
        }
    )
    body = LinkMesh(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int32))
    return Instrument(spec, {"body": body})


def resting_state(z_m: float = 0.13) -> FloatArray:
    """A state in front of the camera, shaft coming from the left."""
    return np.array([0.3, 0.4, 0.8, 0.0, 0.0, z_m, 0.3, -0.2, 0.3])
