"""The geometrically best place of the camera, and what the rules say against it.

The feature's frame has its origin in the ring's centre and its y axis along the ring's normal, towards the camera. The
camera looks along its z axis, and its x axis is level. World frame: z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surgbench.geometry import FloatArray, inverse_transform, rigid_transform
from surgbench.viewpoint.camera_arm import CameraArm
from surgbench.viewpoint.workspace import Workspace

DISTANCE_M = 0.11
UP = np.array([0.0, 0.0, 1.0])
# The normal of a feature counts as vertical where its level part is shorter.
_VERTICAL = 1e-9

CONSTRAINTS = ("no_go", "floor", "orientation", "proximity", "joint_limit")


def view_along(axis: FloatArray) -> FloatArray:
    """Orientations of cameras that look along unit vectors, their x axes level.

    ``x = (up x z) / |up x z|``, ``y = z x x``: the camera's y axis points up. Straight up or down, where no direction
    is more level than another, x is the world's -y.

    Args:
        axis: ``(..., 3)``.

    Returns:
        ``(..., 3, 3)``.
    """
    z = np.asarray(axis, dtype=np.float64)
    x = np.stack([-z[..., 1], z[..., 0], np.zeros_like(z[..., 0])], axis=-1)
    length = np.linalg.norm(x, axis=-1, keepdims=True)
    level = length > _VERTICAL
    x = np.where(level, x / np.where(level, length, 1.0), np.array([0.0, -1.0, 0.0]))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def look_at(position: FloatArray, point: FloatArray) -> FloatArray:
    """T_world_camera ``(..., 4, 4)`` of cameras at ``position`` that look at ``point`` (``(..., 3)``), level.

    A camera in the point itself looks straight down.
    """
    towards = np.asarray(point - position, dtype=np.float64)
    length = np.linalg.norm(towards, axis=-1, keepdims=True)
    apart = length > 1e-12
    axis = np.where(apart, towards / np.where(apart, length, 1.0), -UP)
    return rigid_transform(view_along(axis), position)


def naive_pose(T_world_feature: FloatArray, distance_m: float = DISTANCE_M) -> FloatArray:
    """The camera at a distance along the feature's normal, looking back along it, level.

    Args:
        T_world_feature: ``(..., 4, 4)``; the normal is its y axis.
        distance_m: d_t.

    Returns:
        ``(..., 4, 4)`` T_world_camera.
    """
    normal = T_world_feature[..., :3, 1]
    return rigid_transform(view_along(-normal), T_world_feature[..., :3, 3] + distance_m * normal)


@dataclass(frozen=True)
class Violations:
    """Which rules speak against poses; every one ``(...)`` bool.

    Attributes:
        no_go: Inside the no-go zone.
        floor: Below the floor.
        orientation: On the wrong side.
        proximity: Moved up onto the plane of the zone's top, where zone or floor demand that, it would be too near.
        joint_limit: Out of the arm's reach.
    """

    no_go: NDArray[np.bool_]
    floor: NDArray[np.bool_]
    orientation: NDArray[np.bool_]
    proximity: NDArray[np.bool_]
    joint_limit: NDArray[np.bool_]

    @property
    def any(self) -> NDArray[np.bool_]:
        """At least one."""
        return np.asarray(self.no_go | self.floor | self.orientation | self.proximity | self.joint_limit)

    @property
    def solver(self) -> NDArray[np.bool_]:
        """Those for which AutoCam needs its constrained optimiser: on the right side, but too near or out of reach."""
        return np.asarray((self.proximity | self.joint_limit) & ~self.orientation)

    def stacked(self) -> NDArray[np.bool_]:
        """``(..., 5)`` in the order of :data:`CONSTRAINTS`."""
        return np.stack([self.no_go, self.floor, self.orientation, self.proximity, self.joint_limit], axis=-1)


def violations(
    T_world_camera: FloatArray, feature_m: FloatArray, workspace: Workspace, arm: CameraArm, T_world_base: FloatArray
) -> Violations:
    """What the rules say against camera poses.

    Args:
        T_world_camera: ``(..., 4, 4)``.
        feature_m: ``(..., 3)`` the feature in the world.
        workspace: The rules.
        arm: Holds the camera.
        T_world_base: ``(4, 4)`` its base.
    """
    position = T_world_camera[..., :3, 3]
    no_go = workspace.zone.depth(position) >= 0
    floor = workspace.below_floor(position) > 0
    orientation = workspace.wrong_side(T_world_camera)
    raised = np.linalg.norm(workspace.zone.project_to_top(position) - feature_m, axis=-1)
    joints = arm.inverse(inverse_transform(T_world_base) @ T_world_camera)
    return Violations(
        no_go=np.asarray(no_go),
        floor=np.asarray(floor),
        orientation=orientation,
        proximity=np.asarray((no_go | floor) & ~orientation & (raised < workspace.proximity_m)),
        joint_limit=~arm.within_limits(joints),
    )
