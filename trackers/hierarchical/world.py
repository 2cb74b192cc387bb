"""A scene as the compiled code takes it: plain arrays, made once a trial."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surgbench.geometry import FloatArray, inverse_transform
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.placement import UP


@dataclass(frozen=True, eq=False)
class World:
    """Arm and rules.

    Attributes:
        arm: ``(3,)`` of the kinematics.
        reach_m: From tool to camera.
        limits: ``(2, 6)`` lower and upper joint limits.
        frames: ``(2, 4, 4)`` T_world_base and its inverse.
        faces: ``(n, 4)`` the no-go zone's, as :attr:`surgbench.viewpoint.workspace.NoGoZone.faces` has them: base, top,
            sides, the normals inwards.
        rules: ``(2, 4)`` the floor's plane; the side on which the camera must not be, and the proximity.
        up: ``(3,)`` the world's up in the frame of the base.
    """

    arm: FloatArray
    reach_m: float
    limits: FloatArray
    frames: FloatArray
    faces: FloatArray
    rules: FloatArray
    up: FloatArray

    @classmethod
    def of(cls, scene: ViewpointScene) -> World:
        """Those of a scene."""
        arm, workspace = scene.arm, scene.workspace
        return cls(
            arm=arm.packed,
            reach_m=arm.camera_m,
            limits=np.array([arm.lower, arm.upper]),
            frames=np.array([scene.T_world_base, inverse_transform(scene.T_world_base)]),
            faces=np.ascontiguousarray(workspace.zone.faces, dtype=np.float64),
            rules=np.array([workspace.floor, [*workspace.preferred_side, workspace.proximity_m]], dtype=np.float64),
            up=np.asarray(scene.T_world_base[:3, :3].T @ UP),
        )
