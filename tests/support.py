"""Bodies and states that several tests use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh

from surgbench.camera import Camera
from surgbench.contract import Observation, Scene, View
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument, load_instrument
from surgbench.instrument.model import LinkMesh
from surgbench.instrument.spec import InstrumentSpec
from surgbench.silhouette import SilhouetteEvaluator


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


def scene_of(camera: Camera, arms: int = 1, speed: str = "nominal") -> Scene:
    """A scene with one or two needle drivers."""
    instrument = load_instrument("large_needle_driver")
    empty = np.zeros((camera.height, camera.width), dtype=bool)
    view = View(camera, np.eye(4), empty, keypoints=(None,) * arms)
    return Scene((instrument,) * arms, (view,), (instrument.search_limits,) * arms, 1 / 30, arms, speed)


def observe(scene: Scene, state: FloatArray, index: int = 0, joints: FloatArray | None = None) -> Observation:
    """The frame that a scene shows in a state; the search begins there too."""
    mask = SilhouetteEvaluator(scene.instruments, scene.views[0].camera).mask(state)
    view = replace(scene.views[0], mask=mask)
    return Observation(index, index * scene.dt_s, (view,), start=state.copy(), joints=joints)
