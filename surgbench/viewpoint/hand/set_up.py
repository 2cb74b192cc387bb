"""Where a person sets up a camera that is not going to move: near, with the whole wire in both pictures."""

from __future__ import annotations

import numpy as np

from surgbench.errors import SurgbenchError
from surgbench.geometry import FloatArray, inverse_transform
from surgbench.viewpoint.contract import ViewpointScene
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO
from surgbench.viewpoint.placement import look_at, violations

# Directions tried, spread evenly over the sphere, and distances from the middle of the wire.
DIRECTIONS = 1500
DISTANCES_M = np.arange(0.11, 0.301, 0.01)
# Of the wire's points, those that are looked at.
EVERY = 8


def set_up_joints(
    scene: ViewpointScene, T_world_base: FloatArray, wire_m: FloatArray, normal_m: FloatArray
) -> FloatArray:
    """Joints ``(6,)`` of a camera arm that is set up to look at the whole of a wire.

    The nearest distance at which any place will do, and there the place that looks most along the ring's mean normal.
    Rules are kept as they are known; whether the wire is in the pictures, the person sees.

    Args:
        scene: The arm as registered, and its rules.
        T_world_base: ``(4, 4)`` where its base is in truth.
        wire_m: ``(n, 3)``.
        normal_m: ``(3,)`` unit vector.

    Raises:
        SurgbenchError: There is no such place; one line.
    """
    middle, some = (wire_m.min(axis=0) + wire_m.max(axis=0)) / 2, wire_m[::EVERY]
    height = 1.0 - (2.0 * np.arange(DIRECTIONS) + 1.0) / DIRECTIONS
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(DIRECTIONS)
    level = np.sqrt(1.0 - height**2)
    directions = np.stack([level * np.cos(angle), level * np.sin(angle), height], axis=1)
    directions = directions[np.argsort(-directions @ normal_m, kind="stable")]
    for distance in DISTANCES_M:
        poses = look_at(middle + distance * directions, middle)
        broken = violations(
            poses, np.broadcast_to(middle, (len(poses), 3)), scene.workspace, scene.arm, scene.T_world_base
        )
        for pose in poses[~broken.any]:
            joints = scene.arm.clip(scene.arm.inverse(inverse_transform(scene.T_world_base) @ pose))
            true = T_world_base @ scene.arm.forward(joints)
            _, inside = AUTOCAM_STEREO.see(np.broadcast_to(true, (len(some), 4, 4)), some)
            if inside.all():
                return joints
    raise SurgbenchError("a camera that is not to move: no allowed place has the whole wire in both pictures")
